"""VGGT-Long's and Pi-Long's way, held against what their published code gave on cases made by hand.

`tests/published_cases.py` was run through LoopModel.py, sim3utils.py and sim3loop.py of VGGT-Long (6b9f61f) and of
Pi-Long (ae567d9), which gave the same numbers; they stand here. research/association 0150 has a comparison on random
cases.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.peers.vggt_long import (
    LoopWindow,
    VggtLongSettings,
    find_loops,
    loop_windows,
    optimise,
    robust_similarity,
)
from list3r.memory.core.geometry import Sim3
from tests.published_cases import SPANS, looks_of_a_walk, matched_points, ring_with_a_loop

SETTINGS = VggtLongSettings()


def test_the_published_code_selects_the_same_loops_and_windows() -> None:
    loops = find_loops(looks_of_a_walk(), SETTINGS)
    assert loops == [(122, 88), (192, 158), (52, 18)]
    # the second one lies within a chunk and is dropped there
    assert loop_windows(SPANS, loops, SETTINGS) == [
        LoopWindow(4, (120, 140), 2, (78, 98)),
        LoopWindow(1, (42, 62), 0, (8, 28)),
    ]


def test_the_published_code_aligns_points_alike() -> None:
    found = robust_similarity(*matched_points(), SETTINGS)
    published = [0.40665011, -0.147436681, 0.128888712, 0.329463422, -0.504599274, 0.214710177, 0.145681906]
    assert found.log() == pytest.approx(published, abs=1e-8)


def test_the_published_code_closes_a_ring_alike() -> None:
    # in single precision there, and compared as steps from chunk to chunk
    published = [
        [0.9942, -0.0022, 0.0125, -0.0008, -0.0108, 0.9087, -0.0088],
        [0.9929, 0.0220, 0.0145, -0.0009, -0.0149, 0.8922, 0.0096],
        [0.9953, 0.0458, 0.0160, -0.0038, -0.0175, 0.9131, 0.0149],
        [0.9999, 0.0663, 0.0159, -0.0076, -0.0173, 0.8907, 0.0028],
        [1.0033, 0.0830, 0.0146, -0.0098, -0.0146, 0.9067, -0.0151],
        [1.0028, 0.0983, 0.0128, -0.0090, -0.0114, 0.8843, -0.0222],
        [0.9989, 0.1157, 0.0121, -0.0057, -0.0100, 0.9052, -0.0125],
    ]
    steps, (later, earlier, S) = ring_with_a_loop()
    placed = [Sim3.identity()]
    for step in steps:
        placed.append(placed[-1] @ step)
    closed = optimise(placed, [*((k, k + 1, x) for k, x in enumerate(steps)), (earlier, later, S)], SETTINGS)
    found = [(a.inverse() @ b).log() for a, b in pairwise(closed)]
    assert np.abs(np.array(found) - published).max() < 3e-4


def _looks(places: list[int]) -> np.ndarray:
    """Unit vectors, one a frame; frames of one place look alike, the nearer in time the more."""
    rng = np.random.default_rng(0)
    base = rng.standard_normal((max(places) + 1, 64))
    out = base[places] + 0.02 * rng.standard_normal((len(places), 64)) + 1e-3 * np.arange(len(places))[:, None]
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True), np.float32)


def test_one_loop_is_left_of_a_stretch_that_looks_alike() -> None:
    # frames 0..2 and 53..55 show one place, all others places of their own
    places = [0] * 3 + list(range(1, 51)) + [0] * 3
    loops = find_loops(_looks(places), SETTINGS)
    assert len(loops) == 1  # each end suppresses 25 frames on either side
    later, earlier = loops[0]
    assert later >= 53 and earlier < 3


def test_frames_that_are_near_in_time_or_not_alike_close_no_loop() -> None:
    assert find_loops(_looks([0] * 11 + list(range(1, 30))), SETTINGS) == []  # |i - j| must exceed 10
    assert find_loops(_looks(list(range(40))), SETTINGS) == []


def test_only_the_five_most_alike_of_a_frame_are_looked_at() -> None:
    # 40 frames of one place in a row: the five nearest in looks are nearest in time here
    t = np.arange(40) / 200.0
    looks = np.stack([np.cos(t), np.sin(t)], axis=1).astype(np.float32)
    assert (looks @ looks.T).min() > SETTINGS.least_similarity
    assert find_loops(looks, SETTINGS) == []


@pytest.mark.parametrize(
    ("frame", "expected"), [(50, (40, 60)), (33, (30, 50)), (88, (70, 90)), (40, (30, 50)), (80, (70, 90))]
)
def test_a_window_lies_within_its_chunk(frame: int, expected: tuple[int, int]) -> None:
    windows = loop_windows([(30, 90), (200, 260)], [(230, frame)], SETTINGS)
    assert windows == [LoopWindow(1, (220, 240), 0, expected)]


def test_a_pair_of_chunks_gets_one_loop_and_a_chunk_none_with_itself() -> None:
    spans = [(0, 60), (30, 90), (60, 120), (90, 150)]
    windows = loop_windows(spans, [(140, 10), (120, 20), (20, 5), (140, 40)], SETTINGS)
    assert [(w.chunk_a, w.chunk_b) for w in windows] == [(3, 0), (3, 1)]
    assert windows[0].frames_a == (130, 150)


def test_alignment_of_exact_points_is_exact_and_outliers_count_less() -> None:
    rng = np.random.default_rng(1)
    truth = Sim3.exp(np.array([0.4, -0.2, 0.1, 0.3, -0.5, 0.2, 0.15]))
    p = rng.uniform(-1, 1, (500, 3))
    q = truth.apply(p)
    weight = rng.uniform(0.2, 1.0, 500)
    assert np.allclose(robust_similarity(p, q, weight, SETTINGS).as_matrix(), truth.as_matrix(), atol=1e-9)
    q[:50] += rng.normal(0, 1.0, (50, 3))
    robust = robust_similarity(p, q, weight, SETTINGS)
    plain = robust_similarity(p, q, weight, VggtLongSettings(rounds=0))
    error = [np.linalg.norm(S.apply(p[50:]) - q[50:], axis=1).mean() for S in (robust, plain)]
    assert error[0] < 0.5 * error[1]


@pytest.mark.slow
def test_a_ring_closes_and_shares_its_error_evenly() -> None:
    step = Sim3.exp(np.array([1.0, 0, 0, 0, 0, 2 * np.pi / 12, 0.0]))
    drift = Sim3.exp(np.array([0.0, 0, 0.02, 0, 0.0, 0.01, 0.02]))
    placed = [Sim3.identity()]
    for _ in range(11):
        placed.append(placed[-1] @ step @ drift)
    sequential = [(n, n + 1, step @ drift) for n in range(11)]
    closed = optimise(placed, [*sequential, (11, 0, step)], SETTINGS)
    before = np.linalg.norm((placed[11] @ step).translation)
    gap = (closed[11] @ step).log()
    assert np.linalg.norm((closed[11] @ step).translation) < 0.15 * before and np.abs(gap).max() < 0.1
    off = [np.linalg.norm((S.inverse() @ closed[n].inverse() @ closed[n + 1]).log()) for n, _, S in sequential]
    assert max(off) < 3 * min(off)
    assert np.allclose(closed[0].as_matrix(), np.eye(4), atol=1e-9)


def test_a_graph_that_fits_stays() -> None:
    step = Sim3.exp(np.array([0.5, 0.1, 0, 0, 0.2, 0, 0.1]))
    placed = [Sim3.identity(), step, step @ step]
    kept = optimise(placed, [(0, 1, step), (1, 2, step), (2, 0, (step @ step).inverse())], SETTINGS)
    for S, T in zip(kept, placed, strict=True):
        assert np.allclose(S.as_matrix(), T.as_matrix(), atol=1e-6)
