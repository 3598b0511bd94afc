"""Pictures of revisits: what agrees is cyan, what contradicts red, and a view without a picture is grey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from list3r.association.revisits.loop_overlay import compare, draw_loop, write_loop
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, FrameSamples, Keyframe
from tests.association_scenes import CAMERA, film

S_V_U = Sim3.exp([0.3, -0.2, 0.5, 0.1, 0.4, -0.2, 0.3])


def keyframe(frame: int, jpeg: bytes = b"") -> Keyframe:
    none = np.zeros((0, 2), np.float32)
    return Keyframe(frame, np.eye(4), none.ravel(), none, none.astype(np.uint8), none, none, (1.0, 1.0, 0.0, 0.0), jpeg)


def edge(S_v_u: Sim3) -> Edge:
    return Edge(1, 7, "loop", S_v_u, 0.9, 0.9, 100, 0.01, True, "because", frames=(3, 12))


def test_points_of_the_right_relation_agree_and_of_a_wrong_one_do_not() -> None:
    u, v = film(frames=20), film(S_chunk_world=S_V_U, first=8, frames=16)
    pixel, agrees = compare(u, 3, v, 12, S_V_U.inverse(), CAMERA)
    assert len(pixel) > 100 and agrees.mean() > 0.9
    nearer = Sim3.exp([0, 0, -0.8, 0, 0, 0, 0]) @ S_V_U.inverse()
    assert compare(u, 3, v, 12, nearer, CAMERA)[1].mean() < 0.5
    assert len(compare(u, 99, v, 12, S_V_U.inverse(), CAMERA)[0]) == 0
    assert len(compare(FrameSamples.empty(), 3, v, 12, S_V_U.inverse(), CAMERA)[0]) == 0


def test_both_ends_are_drawn(tmp_path: Path) -> None:
    u, v = film(frames=20), film(S_chunk_world=S_V_U, first=8, frames=16)
    broken = v.points.copy()
    broken[::7] = np.nan
    white = cv2.imencode(".jpg", np.full((120, 160, 3), 255, np.uint8))[1].tobytes()
    ends = (u, keyframe(3, white), CAMERA), (replace(v, points=broken), keyframe(12), CAMERA)
    picture = draw_loop(edge(S_V_U), *ends)
    assert picture.shape == (2 * 120 + 63, 4 * 160 + 4, 3)
    assert (picture == (0, 230, 255)).all(axis=2).sum() > 100
    assert (picture[:240, :320] == 255).all(axis=2).any() and (picture[:240, 330:] == 96).all(axis=2).any()
    path = write_loop(edge(S_V_U), *ends, tmp_path)
    assert path.name == "loop-1-7-3-12.png" and cv2.imread(str(path)).shape == picture.shape
