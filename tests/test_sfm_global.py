"""A map that lost its scale at a turn, or is in pieces, gives way to one of all keyframes at once; others stay."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from list3r.evaluation.trajectory import Trajectory, align, position_errors
from list3r.frames.base import Camera
from list3r.reconstruction.sfm.global_map import global_map, scale_lost_at_turns, with_global_map
from list3r.reconstruction.sfm.mapping import KeyframeView, MapProblem, SparseMap, shared_rows, triangulate
from list3r.reconstruction.sfm.settings import maps_of_chunks
from list3r.reconstruction.sfm.two_view import verified_rows

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
TURN = range(6, 15)
COUNT = 22
BREAK = 10


def cameras(aside: float = 0.08) -> dict[int, np.ndarray]:
    """Keyframes of a camera that steps aside, turns by 90 degrees with next to no step, and steps aside again."""
    out, T = {}, np.eye(4)
    for k in range(COUNT):
        out[k] = T.copy()
        angle, step = (np.pi / 2 / len(TURN), 0.15 * aside) if k in TURN else (0.0, aside)
        R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        T = T.copy()
        T[:3, 3] += T[:3, 0] * step
        T[:3, :3] = T[:3, :3] @ R
    return out


def problem(T_world_cam: dict[int, np.ndarray]) -> MapProblem:
    """What the keyframes see of points all round, off by a third of a pixel."""
    rng = np.random.default_rng(4)
    way = rng.normal(size=(1500, 3)) * [1.0, 0.35, 1.0]
    points = way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(1.6, 3.4, (1500, 1))
    views = {}
    for k, T in T_world_cam.items():
        at = (points - T[:3, 3]) @ T[:3, :3]
        xy = at[:, :2] / np.maximum(at[:, 2:], 1e-6) * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
        seen = np.flatnonzero((at[:, 2] > 0.3) & (xy > 5).all(axis=1) & (xy < (635, 475)).all(axis=1))
        noisy = xy[seen] + rng.normal(0.0, 0.33, (len(seen), 2))
        views[k] = KeyframeView(seen.astype(np.int64), noisy.astype(np.float32))
    near = [(a, b) for a in views for b in views if a < b <= a + 6]
    return MapProblem(views, {(a, b): shared_rows(views[a], views[b]) for a, b in near})


def error_m(found: SparseMap, true: dict[int, np.ndarray]) -> float:
    keys = sorted(found.T_map_cam)
    truth, own = (Trajectory(np.array(keys, float), np.stack([T[k] for k in keys])) for T in (true, found.T_map_cam))
    return float(np.sqrt(np.square(position_errors(truth, own, align(truth, own, with_scale=True))).mean()))


def broken(true: dict[int, np.ndarray], made: MapProblem) -> SparseMap:
    """A map of two halves, the second 1.8 times as large."""
    halves = []
    for keys, growth in ((range(BREAK), 1.0), (range(BREAK, COUNT), 1.8)):
        part = {k: made.views[k] for k in keys}
        pairs = {p: rows for p, rows in made.pairs.items() if p[0] in part and p[1] in part}
        half = triangulate(MapProblem(part, pairs), CAMERA, {k: true[k] for k in keys}, maps_of_chunks())
        assert half is not None
        at = true[BREAK][:3, 3]
        poses = {k: T.copy() for k, T in half.T_map_cam.items()}
        for T in poses.values():
            T[:3, 3] = at + growth * (T[:3, 3] - at)
        halves.append(
            replace(half, T_map_cam=poses, points={n: at + growth * (x - at) for n, x in half.points.items()})
        )
    one, two = halves
    return replace(
        one,
        T_map_cam=one.T_map_cam | two.T_map_cam,
        points=one.points | two.points,
        seen=one.seen | two.seen,
    )


def test_a_map_that_lost_its_scale_at_a_turn_gives_way_to_a_global_one() -> None:
    true, settings = cameras(), maps_of_chunks()
    made = problem(true)
    slipped = broken(true, made)
    assert scale_lost_at_turns(slipped) > settings.turned_scale and error_m(slipped, true) > 0.05
    verified = verified_rows(made, CAMERA, settings)
    (found,) = with_global_map([slipped], made, CAMERA, settings, verified)
    assert found.T_map_cam.keys() == true.keys() and error_m(found, true) < 0.01
    (again,) = with_global_map([slipped], made, CAMERA, settings, verified)
    assert all(np.array_equal(again.T_map_cam[k], found.T_map_cam[k]) for k in true)


def test_a_map_in_pieces_gives_way_to_a_whole_one() -> None:
    true, settings = cameras(), maps_of_chunks()
    made = problem(true)
    whole = broken(true, made)
    pieces = [replace(whole, T_map_cam={k: whole.T_map_cam[k] for k in keys}) for keys in (range(12), range(12, COUNT))]
    (found,) = with_global_map(pieces, made, CAMERA, settings, verified_rows(made, CAMERA, settings))
    assert found.T_map_cam.keys() == true.keys() and error_m(found, true) < 0.01


def test_steps_aside_lose_no_scale_and_their_map_stays() -> None:
    true, settings = cameras(), maps_of_chunks()
    made = problem(true)
    aside = {k: true[k] for k in range(TURN[0])}
    part = MapProblem({k: made.views[k] for k in aside}, {p: rows for p, rows in made.pairs.items() if p[1] < TURN[0]})
    found = triangulate(part, CAMERA, aside, settings)
    assert found is not None and scale_lost_at_turns(found) < 0.01
    assert with_global_map([found], part, CAMERA, settings, None)[0] is found


def test_pieces_that_share_nothing_stay_apart() -> None:
    true, settings = cameras(), maps_of_chunks()
    ends = range(6), range(16, COUNT)
    made = problem({k: T for k, T in true.items() if any(k in keys for keys in ends)})
    pieces = []
    for keys in ends:
        found = triangulate(made, CAMERA, {k: true[k] for k in keys}, settings)
        assert found is not None
        pieces.append(found)
    assert with_global_map(pieces, made, CAMERA, settings, None) == pieces


@pytest.mark.parametrize("linked", [True, False])
def test_nothing_is_made_of_a_camera_that_only_turns_or_of_keyframes_that_share_nothing(linked: bool) -> None:
    made = problem(cameras(aside=0.0))
    if not linked:
        made = replace(made, pairs={(a, b): np.zeros((0, 2), np.int64) for a, b in pairwise(made.views)})
    assert global_map(made, CAMERA, maps_of_chunks(), None) is None
