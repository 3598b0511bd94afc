"""Merging as the paper writes it, against numbers worked out by hand: what leaves, what is sampled, what is aligned."""

from __future__ import annotations

import numpy as np
import pytest

from list3r.association.overlap import overlap_edge
from list3r.association.overlap.overlap_edge import EdgeEnd, EdgeSettings
from list3r.association.overlap.regions import EdgeSupportSettings
from list3r.association.overlap.shared_points import Pairs
from list3r.association.paper.support import coverage_turn, sampled, without_large_delta
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameSamples

CAMERA = Camera(100, 80, 100.0, 100.0, 50.0, 40.0)
REGIONS = EdgeSupportSettings()


def _pairs(p_u: np.ndarray, p_v: np.ndarray, instance: np.ndarray, confidence: np.ndarray | None = None) -> Pairs:
    n = len(p_u)
    here, zero = np.tile(np.eye(4)[:3], (n, 1, 1)), np.zeros(n, np.int64)
    sure = np.ones(n) if confidence is None else confidence
    return Pairs(p_u, p_v, sure, sure, zero, zero, instance, instance, here, here, p_v)


def _grid(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform([-1, -1, 2], [1, 1, 4], (n, 3))


def test_an_instance_leaves_where_its_delta_is_large() -> None:
    # five things of 100 points; the last one was moved by 0.2 along x between the chunks: 5 to 10 px at 100 px focal
    # length and 2 to 4 away, where the rest are off by what the first fit is drawn along, about a fifth of that
    rng = np.random.default_rng(0)
    p_u = _grid(rng, 500)
    p_v = p_u.copy()
    p_v[400:, 0] += 0.2
    thing = np.repeat(np.arange(5), 100)
    found = without_large_delta(_pairs(p_u, p_v, thing), CAMERA, REGIONS)
    assert found.left_out_u == {4} and found.removed.tolist() == (thing == 4).tolist()
    assert 0.5 < found.delta_max_px < 2.0
    still = without_large_delta(_pairs(p_u, p_u, thing), CAMERA, REGIONS)
    assert not still.removed.any() and still.delta_max_px == pytest.approx(0.0, abs=1e-6)


def test_what_has_no_instance_never_leaves() -> None:
    rng = np.random.default_rng(1)
    p_u = _grid(rng, 300)
    p_v = p_u.copy()
    p_v[200:, 0] += 0.5
    found = without_large_delta(_pairs(p_u, p_v, np.full(300, -1)), CAMERA, REGIONS)
    assert not found.removed.any()


def test_cells_and_instances_are_sampled_in_turn_the_surest_first() -> None:
    # one cell a metre: a wall of four points with the surest of all, a thing in the same cell, and a far point
    points = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [0.4, 0, 0], [0.5, 0, 0], [0.6, 0, 0], [20.0, 0, 0]])
    thing = np.array([-1, -1, -1, -1, 3, 3, -1])
    weight = np.array([0.8, 0.9, 0.7, 0.6, 0.2, 0.3, 0.1])
    turn = coverage_turn(points, thing, weight, 16)
    assert turn.tolist() == [1, 0, 2, 3, 1, 0, 0]
    pairs = _pairs(points, points, thing, weight)
    chosen = sampled(pairs, without_large_delta(pairs, CAMERA, REGIONS), 3)
    assert chosen.used.tolist() == [False, True, False, False, False, True, True]
    assert chosen.weight == pytest.approx([0.9, 0.3, 0.1])


def test_an_edge_is_measured_so_where_its_settings_say_it() -> None:
    rng = np.random.default_rng(2)
    truth = Sim3.exp(np.array([0.3, -0.2, 0.1, 0.1, 0.2, -0.1, 0.2]))
    p = _grid(rng, 600)
    pixel = np.arange(600, dtype=np.int32)
    u = FrameSamples(*_samples(p, pixel))
    v = FrameSamples(*_samples(truth.apply(p), pixel))
    as_written = EdgeSettings(method="paper")
    found = overlap_edge.measure_edge(EdgeEnd(1, u), EdgeEnd(2, v), CAMERA, False, as_written).edge
    assert np.allclose(found.S_v_u.as_matrix(), truth.as_matrix(), atol=1e-5)
    assert found.confidence == pytest.approx(1.0, abs=1e-4)


def _samples(points: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, ...]:
    """Frames 0 to 5 of a hundred samples each, all seen from the origin of their chunk."""
    n = len(points)
    frame = np.repeat(np.arange(6), n // 6)
    T = np.tile(np.eye(4), (6, 1, 1))
    none = np.full(n, -1, np.int32)
    one = np.ones(n, np.float32)
    return frame, pixel, points.astype(np.float32), one, none, np.arange(6), T
