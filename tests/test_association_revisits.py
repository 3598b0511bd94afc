"""Revisits: the same place is found again with the right pose, another place is not, and the reason is given."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from list3r.association.revisits import RevisitSettings, find_loops, propose
from list3r.association.verification import verify
from list3r.memory.geometry import Sim3
from list3r.memory.records import ChunkRow, Keyframe
from list3r.reconstruction.features import FeatureSettings, match, relative_pose
from list3r.reconstruction.keyframe_record import frame_samples, make_keyframes
from list3r.reconstruction.rgbd import RgbdReconstructor
from list3r.reconstruction.view import SensorNoise
from tests.rgbd_scenes import CAMERA, frames_along, pose_errors, walk

GAUGE = Sim3.exp([0.3, -0.2, 0.5, 0.2, 0.4, -0.1, 0.0]).as_matrix()


@dataclass
class Chunks:
    """A store of three chunks with one keyframe each."""

    done: list[tuple[Keyframe, ...]] = field(default_factory=list)

    def chunks(self, session_id: int | None = None) -> list[ChunkRow]:
        return [
            ChunkRow(k, 0, k, 0, 0, 0, Sim3.identity(), (1.0, 1.0, 0.0, 0.0), (240, 320), "metric")
            for k in range(len(self.done))
        ]

    def keyframes(self, chunk_id: int) -> list[Keyframe]:
        return list(self.done[chunk_id])

    def keyframe(self, chunk_id: int, frame_index: int) -> Keyframe:
        return next(k for k in self.done[chunk_id] if k.frame_index == frame_index)

    def keyframe_descriptors(self) -> tuple[np.ndarray, np.ndarray]:
        rows = [(c, k) for c, ks in enumerate(self.done) for k in ks]
        return np.array([(c, k.frame_index) for c, k in rows]), np.stack([k.descriptor for _, k in rows])


def keyframes_at(start: float, seed: int = 0, first: int = 0, gauge: np.ndarray | None = None) -> tuple[Keyframe, ...]:
    """One keyframe of a chunk, in a gauge of its own."""
    frames = [replace(f, index=first) for f in frames_along(walk(1, start=start), seed=seed)]
    result = RgbdReconstructor(poses="given")(frames, CAMERA)
    if gauge is not None:
        result = replace(result, T_chunk_cam=gauge @ result.T_chunk_cam)
    return make_keyframes(frames, result, keep_jpeg=True)


@pytest.fixture(scope="module")
def here() -> Keyframe:
    return keyframes_at(0.0)[0]


@pytest.fixture(scope="module")
def again() -> Keyframe:
    return keyframes_at(0.7, first=200, gauge=GAUGE)[0]


def test_a_keyframe_holds_what_it_says(here: Keyframe) -> None:
    assert np.linalg.norm(here.descriptor) == pytest.approx(1.0, abs=1e-5)
    assert here.keypoint_descriptors.dtype == np.uint8
    assert len(here.keypoints_xy) == len(here.keypoint_descriptors) == len(here.points_cam) > 100
    assert here.depth_small.shape == (120, 160)
    assert here.jpeg[:2] == b"\xff\xd8"
    known = np.isfinite(here.points_cam[:, 0])
    u = here.points_cam[known, 0] / here.points_cam[known, 2] * CAMERA.fx + CAMERA.cx
    assert np.allclose(u, here.keypoints_xy[known, 0], atol=0.01)


def test_a_revisit_is_verified_with_the_right_pose(here: Keyframe, again: Keyframe) -> None:
    edge = verify(here, again, 0, 2)
    assert edge.accepted, edge.reason
    assert (edge.kind, edge.frames) == ("loop", (0, 200))
    found = np.stack([np.eye(4), edge.S_v_u.as_matrix()])
    shift, turn = pose_errors(found, np.stack([np.eye(4), GAUGE]))
    assert shift[1] < 0.02
    assert turn[1] < 0.5
    assert edge.confidence > 0.7


def test_another_place_is_rejected_with_a_reason(here: Keyframe) -> None:
    other = keyframes_at(0.0, seed=9, first=300)[0]
    edge = verify(here, other, 0, 2)
    assert not edge.accepted
    assert "features" in edge.reason
    assert edge.weight == 0.0


def test_a_place_with_something_in_front_is_rejected(here: Keyframe, again: Keyframe) -> None:
    depth = again.depth_small.copy()
    depth[20:100, 20:140] *= 0.6
    edge = verify(here, replace(again, depth_small=depth), 0, 2)
    assert not edge.accepted


def test_chunks_without_metric_scale_get_no_edge_from_one_frame(here: Keyframe, again: Keyframe) -> None:
    edge = verify(here, again, 0, 2, metric=False)
    assert not edge.accepted
    assert "scale" in edge.reason


def test_loops_are_found_among_stored_chunks(here: Keyframe, again: Keyframe) -> None:
    store = Chunks([(here,), keyframes_at(3.0, first=100), (again,)])
    edges = find_loops(store, 2)
    assert [(e.u, e.v) for e in edges if e.accepted] == [(0, 2)]
    assert all(e.u != 1 for e in edges)
    assert find_loops(store, 0) == []


def test_proposals_keep_their_distance_and_their_quota() -> None:
    rng = np.random.default_rng(0)
    place = rng.normal(size=32)
    stored = np.stack([place + 0.1 * rng.normal(size=32) for _ in range(6)] + [rng.normal(size=32) for _ in range(14)])
    stored_keys = np.array([(0, 2 * k) for k in range(6)] + [(1, 100 + 40 * k) for k in range(14)])
    new, new_keys = place[None].astype(np.float32), np.array([[3, 900]])
    proposals = propose(new, new_keys, stored.astype(np.float32), stored_keys, RevisitSettings())
    assert proposals[0].stored < 6
    assert sum(p.stored < 6 for p in proposals) == 1
    chunk_1 = [p for p in proposals if stored_keys[p.stored, 0] == 1]
    assert len(chunk_1) <= RevisitSettings().per_pair
    assert all(a.cosine >= b.cosine for a, b in itertools.pairwise(proposals))


def test_features_give_the_relative_pose(here: Keyframe, again: Keyframe) -> None:
    pairs = match(here.keypoint_descriptors, again.keypoint_descriptors, 0.85)
    pose = relative_pose(here.points_cam[pairs[:, 0]], again.points_cam[pairs[:, 1]], FeatureSettings(), SensorNoise())
    assert pose is not None
    truth = np.stack([walk(1)[0], walk(1, start=0.7)[0]])
    shift, turn = pose_errors(np.stack([np.eye(4), pose.T_a_b]), truth)
    assert shift[1] < 0.05
    assert turn[1] < 1.5
    assert match(here.keypoint_descriptors[:1], again.keypoint_descriptors, 0.85).shape == (0, 2)
    assert relative_pose(here.points_cam[:5], again.points_cam[:5], FeatureSettings(), SensorNoise()) is None


def test_frame_samples_are_the_same_pixels_in_every_chunk() -> None:
    frames = frames_along(walk(8))
    result = RgbdReconstructor(poses="given")(frames, CAMERA)
    posed = result.posed.copy()
    posed[1] = False
    samples = frame_samples(replace(result, posed=posed))
    assert set(samples.frame.tolist()) == {0, 2, 3, 4, 5, 6, 7}
    assert samples.camera_frames.tolist() == [0, 2, 3, 4, 5, 6, 7]
    per_frame = np.bincount(samples.frame)
    assert 150 <= per_frame[0] <= 300
    row, column = samples.pixel // CAMERA.width, samples.pixel % CAMERA.width
    first = samples.frame == 5
    camera_points = np.linalg.inv(result.T_chunk_cam[5]) @ np.c_[samples.points[first], np.ones(first.sum())].T
    assert np.allclose(camera_points[2], result.depth[5][row[first], column[first]], atol=1e-4)
