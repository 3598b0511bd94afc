"""Alignment of neighbouring chunks: a known similarity is recovered, and degenerate support is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from list3r.association.alignment import align_overlap
from list3r.memory.errors import DegenerateError
from list3r.memory.geometry import Sim3
from list3r.memory.records import FrameSamples

S_V_U = Sim3.exp([0.4, -0.2, 0.7, 0.3, -0.5, 0.2, 0.0])
S_V_U_SCALED = Sim3.exp([0.4, -0.2, 0.7, 0.3, -0.5, 0.2, 0.35])


def samples(first: int, count: int, points: np.ndarray) -> FrameSamples:
    """Samples of `count` frames, as many pixels in each as the points allow."""
    each = len(points) // count
    return FrameSamples(
        frame=np.repeat(np.arange(first, first + count), each).astype(np.int64),
        pixel=np.tile(np.arange(each), count).astype(np.int32),
        points=points.astype(np.float32),
        confidence=np.full(len(points), 0.8, np.float32),
        instance=np.full(len(points), -1, np.int32),
        camera_frames=np.arange(first, first + count),
        T_chunk_cam=np.tile(np.eye(4), (count, 1, 1)),
    )


def pair(S_v_u: Sim3, noise: float = 0.0, seed: int = 0) -> tuple[FrameSamples, FrameSamples]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 1], [1, 1, 4], (600, 3))
    moved = S_v_u.apply(points) + noise * rng.normal(size=points.shape)
    return samples(0, 20, points), samples(0, 20, moved)


def test_a_rigid_motion_is_recovered() -> None:
    edge = align_overlap(*pair(S_V_U), 3, 4, metric=True)
    assert (edge.u, edge.v, edge.kind, edge.accepted) == (3, 4, "adjacent", True)
    assert np.allclose(edge.S_v_u.as_matrix(), S_V_U.as_matrix(), atol=1e-5)
    assert edge.confidence == pytest.approx(1.0, abs=1e-3)


def test_scale_is_recovered_without_metric_depth_and_held_with_it() -> None:
    u, v = pair(S_V_U_SCALED)
    assert np.allclose(align_overlap(u, v, 0, 1, metric=False).S_v_u.as_matrix(), S_V_U_SCALED.as_matrix(), atol=1e-5)
    assert float(align_overlap(u, v, 0, 1, metric=True).S_v_u.scale) == 1.0


def test_a_third_of_wrong_points_does_not_bend_it() -> None:
    u, v = pair(S_V_U, noise=0.003)
    points = v.points.copy()
    points[::3] += np.array([0.5, 0.3, -0.4], np.float32)
    edge = align_overlap(u, replace(v, points=points), 0, 1, metric=True)
    error = (edge.S_v_u.inverse() @ S_V_U).log()
    assert edge.accepted
    assert np.abs(error).max() < 0.02
    assert edge.confidence < align_overlap(u, v, 0, 1, metric=True).confidence


def test_frames_that_are_not_shared_do_not_count() -> None:
    u, v = pair(S_V_U)
    shifted = replace(v, frame=v.frame + 10)
    edge = align_overlap(u, shifted, 0, 1, metric=True)
    assert edge.scores["shared_frames"] == 10
    assert edge.scores["pairs"] == 300


def test_confidence_weighs() -> None:
    u, v = pair(S_V_U)
    points, confidence = v.points.copy(), np.full(len(v.points), 0.9, np.float32)
    points[::2] += np.float32(0.3)
    confidence[::2] = 0.01
    edge = align_overlap(u, replace(v, points=points, confidence=confidence), 0, 1, metric=True)
    assert np.abs((edge.S_v_u.inverse() @ S_V_U).log()).max() < 0.03


def test_contradicting_chunks_are_not_joined() -> None:
    rng = np.random.default_rng(1)
    u = samples(0, 20, rng.uniform(-1, 1, (600, 3)))
    v = samples(0, 20, rng.uniform(-1, 1, (600, 3)))
    edge = align_overlap(u, v, 0, 1, metric=True)
    assert not edge.accepted
    assert "only" in edge.reason


def test_degenerate_support_has_a_name() -> None:
    u, v = pair(S_V_U)
    with pytest.raises(DegenerateError, match="chunks 7 and 8 share 0 points"):
        align_overlap(u, replace(v, frame=v.frame + 100), 7, 8, metric=True)
    line = np.linspace(0, 1, 600)[:, None] * np.array([1.0, 2.0, 3.0])
    with pytest.raises(DegenerateError, match="line"):
        align_overlap(samples(0, 20, line), samples(0, 20, line), 0, 1, metric=True)
