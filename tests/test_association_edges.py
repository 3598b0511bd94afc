"""Edges between chunks: the truth is recovered past movers, and every degenerate case has its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from list3r.association.overlap.overlap_edge import EdgeEnd, EdgeSettings, MeasuredEdge, measure_edge
from list3r.instances.overlays import draw_support, write_support
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameSamples
from tests.association_scenes import BOXES, CAMERA, MOVER, Thing, film

S_U = Sim3.exp([0.4, -0.2, 0.7, 0.3, -0.5, 0.2, 0.4])
S_V = Sim3.exp([-0.3, 0.6, 0.1, -0.2, 0.4, 0.9, -0.3])
S_V_U = S_V @ S_U.inverse()
LARGE = Thing(MOVER, (-0.6, 0.2, 1.7), (0.75, 1.2), (0.03, 0.0, 0.0))


def off(S_v_u: Sim3, truth: Sim3 = S_V_U) -> float:
    return float(np.abs((S_v_u.inverse() @ truth).log()).max())


def edge_between(
    u: FrameSamples,
    v: FrameSamples,
    u_id: int,
    v_id: int,
    *chosen: Any,
    dynamic_u: Sequence[int] = (),
    dynamic_v: Sequence[int] = (),
    **named: Any,
) -> MeasuredEdge:
    """The edge of two chunks by their samples and ids."""
    return measure_edge(EdgeEnd(u_id, u, dynamic_u), EdgeEnd(v_id, v, dynamic_v), *chosen, **named)


def pair(things: tuple[Thing, ...] = BOXES, noise: float = 0.005, **kwargs: float) -> tuple[FrameSamples, FrameSamples]:
    u = film(things, S_U, noise=noise, seed=1, mover_depth=kwargs.get("depth_u", 1.0))
    return u, film(things, S_V, noise=noise, seed=2, mover_depth=kwargs.get("depth_v", 1.0))


@pytest.mark.parametrize("method", ["instances", "plain", "paper"])
def test_a_similarity_is_recovered(method: str) -> None:
    measured = edge_between(*pair(noise=0.0), 3, 4, CAMERA, False, EdgeSettings(method=method))
    edge = measured.edge
    assert (edge.u, edge.v, edge.kind, edge.accepted, edge.frames) == (3, 4, "adjacent", True, None)
    assert off(edge.S_v_u) < 1e-4
    assert edge.covariance is not None
    assert edge.covariance.shape == (7, 7)
    assert measured.moving_u == measured.moving_v == frozenset()
    assert edge.scores["shared_frames"] == 24


def test_a_rigid_edge_between_metric_chunks() -> None:
    T_u, T_v = (replace(S, scale=np.ones(())) for S in (S_U, S_V))
    u, v = film(S_chunk_world=T_u), film(S_chunk_world=T_v)
    edge = edge_between(u, v, 0, 1, CAMERA, True, kind="loop").edge
    assert float(edge.S_v_u.scale) == 1.0
    assert (edge.kind, edge.frames) == ("loop", None)
    assert off(edge.S_v_u, T_v @ T_u.inverse()) < 1e-4


def test_a_calm_scene_keeps_all_its_things() -> None:
    measured = edge_between(*pair(noise=0.01), 0, 1, CAMERA, False)
    assert measured.moving_u == measured.moving_v == frozenset()
    assert not measured.support.removed.any()
    assert off(measured.edge.S_v_u) < 0.01


@pytest.mark.parametrize(("depth_u", "depth_v"), [(1.0, 1.25), (0.85, 1.0)])
def test_a_mover_over_half_of_the_picture_is_left_out(depth_u: float, depth_v: float) -> None:
    u, v = pair((*BOXES, LARGE), depth_u=depth_u, depth_v=depth_v)
    assert (u.instance == MOVER).mean() > 0.4
    measured = edge_between(u, v, 0, 1, CAMERA, False)
    assert measured.moving_u == measured.moving_v == {MOVER}
    assert measured.support.removed.mean() > 0.4
    assert "move" in measured.edge.reason
    assert off(measured.edge.S_v_u) < 0.015
    plain = edge_between(u, v, 0, 1, CAMERA, False, EdgeSettings(method="plain"))
    assert off(measured.edge.S_v_u) <= off(plain.edge.S_v_u) + 0.005


def test_a_mover_displaced_across_the_ray_is_left_out() -> None:
    u, v = pair((*BOXES, LARGE))
    aside = (v.instance == MOVER)[:, None] * (float(S_V.scale) * S_V.rotation @ [0.25, 0.0, 0.0])
    measured = edge_between(u, replace(v, points=(v.points + aside).astype(np.float32)), 0, 1, CAMERA, False)
    assert measured.moving_u == {MOVER}
    assert off(measured.edge.S_v_u) < 0.015


def test_a_mover_without_a_mask_is_left_out_block_by_block() -> None:
    u, v = pair((*BOXES, replace(LARGE, half=(0.4, 1.2))), depth_v=1.3)
    u, v = (replace(s, instance=np.full_like(s.instance, -1)) for s in (u, v))
    assert off(edge_between(u, v, 0, 1, CAMERA, False).edge.S_v_u) < 0.02


def test_instances_known_to_move_are_left_out() -> None:
    measured = edge_between(*pair((*BOXES, LARGE)), 0, 1, CAMERA, False, dynamic_u=[MOVER], dynamic_v=[MOVER])
    u, _ = pair((*BOXES, LARGE))
    assert not measured.support.kept[u.instance == MOVER].any()
    assert off(measured.edge.S_v_u) < 0.015


def test_a_third_of_the_frames_misplaced_together_does_not_bend_it() -> None:
    u, v = pair()
    late = v.frame >= 16
    moved = v.points + late[:, None] * np.array([0.3, 0.1, -0.2])
    T = v.T_chunk_cam.copy()
    T[16:, :3, 3] += [0.3, 0.1, -0.2]
    measured = edge_between(u, replace(v, points=moved.astype(np.float32), T_chunk_cam=T), 0, 1, CAMERA, False)
    assert measured.edge.accepted
    assert off(measured.edge.S_v_u) < 0.02
    assert measured.moving_u == frozenset()


@pytest.mark.parametrize("labels", ["none", "one"])
def test_chunks_with_no_instance_and_with_one(labels: str) -> None:
    u, v = (replace(s, instance=np.full_like(s.instance, -1 if labels == "none" else 0)) for s in pair())
    assert off(edge_between(u, v, 0, 1, CAMERA, False).edge.S_v_u) < 0.01


def test_all_points_on_one_plane_are_enough() -> None:
    u, v = pair(())
    wall_u, wall_v = (only(s, s.instance == 0) for s in (u, v))
    assert off(edge_between(wall_u, wall_v, 0, 1, CAMERA, False).edge.S_v_u) < 0.02


def test_points_that_are_not_finite_are_left_out() -> None:
    u, v = pair()
    points = v.points.copy()
    points[::3] = np.nan
    assert off(edge_between(u, replace(v, points=points), 0, 1, CAMERA, False).edge.S_v_u) < 0.01


def test_movers_everywhere_are_no_accepted_edge() -> None:
    u, v = pair()
    rng = np.random.default_rng(0)
    wild = (v.points + rng.normal(size=v.points.shape)).astype(np.float32)
    try:
        edge = edge_between(u, replace(v, points=wild), 0, 1, CAMERA, False).edge
    except DegenerateError:
        return
    assert not edge.accepted
    assert edge.weight == 0


def only(samples: FrameSamples, mask: np.ndarray) -> FrameSamples:
    fields = {n: getattr(samples, n)[mask] for n in ("frame", "pixel", "points", "confidence", "instance")}
    return replace(samples, **fields)


def test_degenerate_overlap_has_a_name() -> None:
    u, v = pair()
    cases = {
        "share 0 frames": (u, replace(v, frame=v.frame + 100, camera_frames=v.camera_frames + 100)),
        "both chunks posed": (u, replace(v, T_chunk_cam=np.full_like(v.T_chunk_cam, np.nan))),
        "finite": (u, replace(v, points=np.full_like(v.points, np.nan))),
        "confidence above zero": (u, replace(v, confidence=np.zeros_like(v.confidence))),
        "at least 60": (only(u, u.frame == 0), only(v, (v.frame == 0) & (v.pixel < 2000))),
    }
    for reason, (a, b) in cases.items():
        for method in ("instances", "plain"):
            with pytest.raises(DegenerateError, match=f"chunks 7 and 8 cannot be aligned.*{reason}"):
                edge_between(a, b, 7, 8, CAMERA, False, EdgeSettings(method=method))
    with pytest.raises(DegenerateError):
        edge_between(FrameSamples.empty(), FrameSamples.empty(), 7, 8, CAMERA, False)
    with pytest.raises(DegenerateError, match="static"):
        edge_between(u, v, 7, 8, CAMERA, False, dynamic_u=range(10))


def test_the_picture_shows_what_was_removed_and_kept(tmp_path: object) -> None:
    measured = edge_between(*pair((*BOXES, LARGE), depth_v=1.25), 5, 6, CAMERA, False)
    picture = draw_support(np.full((120, 160, 3), 96, np.uint8), measured, 12)
    assert (np.abs(picture.astype(int) - [255, 30, 30]).max(axis=-1) < 40).sum() > 100
    assert (np.abs(picture.astype(int) - [0, 230, 255]).max(axis=-1) < 40).sum() > 100
    path = write_support(measured, (), CAMERA, tmp_path)  # type: ignore[arg-type]
    assert path.parts[-2:] == ("edges", "5-6.png")
    assert cv2.imread(str(path)).shape == picture.shape
