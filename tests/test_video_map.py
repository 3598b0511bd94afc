"""One map of a whole video: drift is spread by what is seen again, and all is adjusted together."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.simulation.wide_steps import WideStepWalk
from list3r.association.overlap.camera_edge import camera_edge, in_one_frame, one_frame_edge
from list3r.association.whole_map.drift import spread_drift
from list3r.association.whole_map.joining import join_maps
from list3r.association.whole_map.revisits import Revisit, find_revisits, seen_again
from list3r.association.whole_map.settings import DriftSettings, JoiningSettings, RevisitPairSettings
from list3r.association.whole_map.views import MapView, shared_views
from list3r.frames.base import Camera
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.frames.source import open_source
from list3r.memory.core.geometry import Sim3, umeyama
from list3r.memory.core.records import FrameSamples
from list3r.pipeline.chunks.whole_map import map_spans
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.sfm.adjustment import adjust
from list3r.reconstruction.sfm.calibration import calibrate_by_map
from list3r.reconstruction.sfm.keyframe_features import LocalFeatures
from list3r.reconstruction.sfm.mapping import KeyframeView, MapProblem, SparseMap, shared_rows
from list3r.reconstruction.sfm.settings import AdjustmentSettings, MappingSettings, SfmSettings
from list3r.reconstruction.sfm.two_view import verified_rows

Array = NDArray[np.float64]

CAMERA = Camera(540, 360, 443.0, 443.0, 269.5, 179.5)
COUNT = 24
_RNG = np.random.default_rng(5)
POINTS = _RNG.uniform([-5, -5, -1.2], [5, 5, 1.2], (1500, 3))
LOOKS = _RNG.normal(size=(len(POINTS), 128)).astype(np.float32)
LOOKS /= np.linalg.norm(LOOKS, axis=1, keepdims=True)


def ring() -> Array:
    """Cameras on a circle of 1 m that look outward and come back to where they began. Shape (COUNT, 4, 4)."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, COUNT)):
        forward = np.array([np.cos(angle), np.sin(angle), 0.0])
        right, down = np.array([np.sin(angle), -np.cos(angle), 0.0]), np.array([0.0, 0.0, -1.0])
        poses[k, :3, :3], poses[k, :3, 3] = np.stack([right, down, forward], axis=1), forward
    return poses


def drifted(poses: Array, turn_rad: float = 0.004, growth: float = 0.002) -> Array:
    """The same with every step turned and longer than it was."""
    out = [poses[0]]
    for k in range(1, len(poses)):
        step = np.linalg.inv(poses[k - 1]) @ poses[k]
        step[:3, 3] *= 1.0 + growth * k
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        out.append(out[-1] @ step @ np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]]))
    return np.stack(out)


def seen(T: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Numbers, px (N, 2) and camera coordinates (N, 3) of the points that a camera sees up to 4 m away."""
    cam = (POINTS - T[:3, 3]) @ T[:3, :3]
    xy = cam[:, :2] / np.maximum(cam[:, 2:], 1e-9) * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    inside = (
        (cam[:, 2] > 0.3) & (cam[:, 2] < 4.0) & (xy > 0).all(axis=1) & (xy < (CAMERA.width, CAMERA.height)).all(axis=1)
    )
    return np.flatnonzero(inside), xy[inside], cam[inside]


def views(poses: Array) -> list[MapView]:
    """What the ring sees, at other poses than it has."""
    out = []
    for k, T in enumerate(ring()):
        ids, xy, cam = seen(T)
        features = LocalFeatures(xy.astype(np.float32), LOOKS[ids], 0.85)
        out.append(MapView(k, poses[k], features, np.zeros(4, np.float32), cam, cam))
    return out


def error(poses: Array, true: Array) -> float:
    S = umeyama(poses[:, :3, 3], true[:, :3, 3], with_scale=True)
    return float(np.linalg.norm(S.apply(poses[:, :3, 3]) - true[:, :3, 3], axis=1).max())


def test_views_of_one_place_share_what_they_see_and_opposite_ones_nothing() -> None:
    share = shared_views(views(ring()), CAMERA)
    assert share[0, COUNT - 1] > 0.4 and share[0, COUNT // 2] == 0 and np.allclose(share, share.T)


def test_what_is_seen_again_is_found_and_drift_is_spread_by_it() -> None:
    settings = RevisitPairSettings(apart=15)
    off = drifted(ring())
    revisits, common = find_revisits(views(off), CAMERA, settings)
    assert any((r.a, r.b) == (0, COUNT - 1) for r in revisits) and all(len(common[r.a, r.b]) >= 20 for r in revisits)
    placed, believed = spread_drift(views(off), revisits, DriftSettings())
    assert len(believed) == len(revisits)
    assert error(np.stack([placed[k] for k in range(COUNT)]), ring()) < 0.4 * error(off, ring())


def test_a_false_revisit_is_distrusted_where_others_contradict_it() -> None:
    true, _ = find_revisits(views(ring()), CAMERA, RevisitPairSettings(apart=15))
    false = Revisit(0, 14, Sim3.identity(), 40)
    placed, believed = spread_drift(views(ring()), [*true, false], DriftSettings())
    assert [(r.a, r.b) for r in believed] == [(r.a, r.b) for r in true]
    assert error(np.stack([placed[k] for k in range(COUNT)]), ring()) < 0.02


def test_a_revisit_that_the_way_between_contradicts_is_none() -> None:
    elsewhere = ring()
    elsewhere[12:, :3, 3] += (3.0, 0.0, 0.0)
    twins = [replace(v, descriptor=np.ones(4, np.float32)) for v in views(elsewhere)]
    assert not find_revisits(twins, CAMERA, RevisitPairSettings(apart=20))[0]


def test_a_place_comes_back_only_where_it_was_out_of_sight_between() -> None:
    near, back = Revisit(0, 3, Sim3.identity(), 40), Revisit(0, COUNT - 1, Sim3.identity(), 40)
    assert seen_again(views(ring()), CAMERA, [near, back], RevisitPairSettings()) == [back]


@pytest.mark.parametrize(("k1", "focal"), [(0.0, 1.0), (-0.08, 1.0), (0.0, 1.6)])
def test_a_map_tells_the_lens_and_doubts_a_focal_length_that_does_not_fit(k1: float, focal: float) -> None:
    held, all_ids = {}, set()
    for k, T in enumerate(ring()):
        ids, xy, _ = seen(T)
        at = (xy - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx
        bent = at * (1.0 + k1 * np.square(at).sum(axis=1, keepdims=True)) * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
        held[k] = KeyframeView(ids, bent.astype(np.float32))
        all_ids |= set(ids.tolist())
    points = {n: POINTS[n] for n in all_ids}
    found = SparseMap(dict(enumerate(ring())), points, CAMERA, seen=held)
    start = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)
    told = calibrate_by_map(start, (MapProblem(held, {}), found), SfmSettings())
    assert bool(told.notes) == (focal != 1.0) and told.camera.fx == start.fx
    assert (told.camera.distortion or (0.0,))[0] == pytest.approx(k1, abs=0.01)


def test_adjusting_recovers_poses_that_are_roughly_known() -> None:
    rng, true = np.random.default_rng(3), ring()
    noisy = {}
    for k, T in enumerate(true):
        noisy[k] = T @ Sim3.exp(np.concatenate([rng.normal(0, 0.006, 3), rng.normal(0, 0.003, 3), [0.0]])).as_matrix()
    told = [(k, *seen(T)[:2]) for k, T in enumerate(true)]
    keyframes = {k: KeyframeView(ids, xy + rng.normal(0, 0.2, xy.shape)) for k, ids, xy in told}
    pairs = {(a, b): shared_rows(keyframes[a], keyframes[b]) for a in range(COUNT) for b in range(a + 1, COUNT)}
    pairs = {pair: rows for pair, rows in pairs.items() if len(rows) >= 20}
    found = adjust(MapProblem(keyframes, pairs), CAMERA, noisy, AdjustmentSettings())
    assert found is not None and sorted(found.T_map_cam) == list(range(COUNT))
    before = error(np.stack([noisy[k] for k in range(COUNT)]), true)
    assert error(np.stack([found.T_map_cam[k] for k in range(COUNT)]), true) < 0.4 * before


def test_chunks_with_equal_poses_of_shared_frames_lie_in_one_frame() -> None:
    def samples(first: int, poses: Array) -> FrameSamples:
        return replace(FrameSamples.empty(), camera_frames=np.arange(first, first + len(poses)), T_chunk_cam=poses)

    u, v = samples(0, ring()[:16]), samples(8, ring()[8:])
    edge = one_frame_edge(u, v, 1, 2)
    assert edge is not None and in_one_frame(edge) and np.allclose(edge.S_v_u.as_matrix(), np.eye(4))
    moved = replace(v, T_chunk_cam=np.linalg.inv(ring()[3]) @ v.T_chunk_cam)
    assert one_frame_edge(u, moved, 1, 2) is None
    measured = camera_edge(u, moved, 1, 2)
    assert measured is None or not in_one_frame(measured)


def ring_problem(poses: Array) -> tuple[MapProblem, dict[int, LocalFeatures]]:
    """What the cameras of a ring see as features, and all pairs of them."""
    told = [(k, *seen(T)[:2]) for k, T in enumerate(poses)]
    keyframes = {k: KeyframeView(ids, xy.astype(np.float32)) for k, ids, xy in told}
    features = {k: LocalFeatures(xy.astype(np.float32), LOOKS[ids], 0.85) for k, ids, xy in told}
    pairs = {(a, b): shared_rows(keyframes[a], keyframes[b]) for a in range(COUNT) for b in range(a + 1, COUNT)}
    return MapProblem(keyframes, {pair: rows for pair, rows in pairs.items() if len(rows) >= 20}), features


def part_of(problem: MapProblem, keys: range, S: Sim3) -> SparseMap:
    """A map of some cameras of the ring in a frame of reference and scale of its own."""
    poses = {}
    for k in keys:
        placed = S @ Sim3.from_matrix(ring()[k])
        poses[k] = Sim3(np.ones(()), placed.rotation, placed.translation).as_matrix()
    held = {k: problem.views[k] for k in keys}
    points = {n: S.apply(POINTS[n])[0] for view in held.values() for n in view.ids.tolist()}
    return SparseMap(poses, points, CAMERA, seen=held)


@pytest.mark.parametrize("first", [12, 11, 9])
def test_maps_of_parts_are_joined_whether_or_not_they_share_keyframes(first: int) -> None:
    problem, features = ring_problem(ring())
    S = Sim3.exp(np.array([0.4, -0.2, 0.1, 0.3, 0.2, -0.5, 0.4]))
    maps = [part_of(problem, range(12), Sim3.identity()), part_of(problem, range(first, COUNT), S)]
    joined = join_maps(maps, problem, features, CAMERA, (JoiningSettings(), RevisitPairSettings()))
    assert sorted(joined.T_map_cam) == list(range(COUNT))
    assert error(np.stack([joined.T_map_cam[k] for k in range(COUNT)]), ring()) < 0.01
    assert all(set(view.ids.tolist()) <= joined.points.keys() for view in joined.seen.values())
    assert {np.shape(xyz) for xyz in joined.points.values()} == {(3,)}


def test_matches_that_agree_are_verified_and_others_are_not() -> None:
    problem, _ = ring_problem(ring())
    (a, b), rows = next(iter(problem.pairs.items()))
    wrong = rows.copy()
    wrong[::4, 1] = np.roll(wrong[::4, 1], 1)
    kept = verified_rows(replace(problem, pairs={(a, b): wrong}), CAMERA, MappingSettings())[a, b]
    right = (kept[:, None] == rows[None]).all(axis=2).any(axis=1)
    assert len(kept) >= 0.7 * len(rows) and right.mean() > 0.95


def test_a_walk_of_wide_steps_neither_moves_nor_turns_farther_than_its_steps() -> None:
    T = WideStepWalk(seed=311, frames=40).poses()[1]
    moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turned = np.degrees([np.linalg.norm(Sim3.from_matrix(np.linalg.inv(a) @ b).log()[3:6]) for a, b in pairwise(T)])
    assert moved.max() < 0.09 and turned.max() < 4.6 and np.median(np.maximum(moved / 0.08, turned / 4.0)) > 0.9


def test_chunks_of_a_mapped_video_are_even_unless_lengths_were_asked_for(tmp_path: Path) -> None:
    for k in range(120):
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), np.full((8, 8, 3), k, np.uint8))
    source, settings = open_source(tmp_path), BuildSettings("sfm")
    usual = plan_chunks(120, settings.chunks)
    assert [(s.start, s.stop) for s in map_spans(source, settings, usual)] == [(0, 66), (54, 120)]
    assert map_spans(source, replace(settings, chunks=ChunkSettings(80, 30)), usual) == usual
