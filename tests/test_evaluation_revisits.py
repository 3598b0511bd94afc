"""Revisits against covisibility: facts of small cases and laws of rankings."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from list3r.evaluation.covisibility import Covisibility
from list3r.evaluation.revisits import (
    FALSE,
    OPEN,
    TRUE,
    Candidates,
    RevisitScores,
    RevisitTruthSettings,
    average_precision,
    frame_labels,
    judge,
    recall_at_precision,
    score,
)
from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge

SPANS = {1: (0, 9), 2: (8, 17), 3: (16, 23), 4: (22, 33)}


def place_of(frame: np.ndarray) -> np.ndarray:
    """A walk that comes back to its beginning: chunk 4 sees what chunk 1 saw."""
    return np.where(frame >= 24, frame - 24, frame)


def truth(step: int = 1) -> Covisibility:
    """Frames see the same when their places are within 2, a little when within 4."""
    frame = np.arange(0, 34, step)
    gap = np.abs(np.subtract.outer(place_of(frame), place_of(frame)))
    share = np.select([gap <= 2, gap <= 4], [0.8, 0.2], 0.0).astype(np.float32)
    return Covisibility(frame, frame / 30, share)


def candidates(*rows: tuple[int, int, int, int, bool, float, float]) -> Candidates:
    table = np.array(rows, dtype=float).reshape(-1, 7)
    return Candidates(
        table[:, :2].astype(np.int64),
        table[:, 2:4].astype(np.int64),
        table[:, 4] > 0,
        {"s_det": table[:, 5], "s_loop": table[:, 6]},
    )


def test_true_false_and_open_candidates_are_told_apart() -> None:
    judged = judge(
        candidates((1, 4, 3, 27, True, 0.9, 1.5), (1, 3, 2, 20, True, 0.95, 0.4), (1, 4, 3, 31, True, 0.9, 0.8)),
        truth(),
        SPANS,
    )
    assert judged.frame_labels.tolist() == [TRUE, FALSE, OPEN]
    assert judged.chunk_labels.tolist() == [TRUE, FALSE, TRUE]
    assert judged.true_pairs == {(1, 4), (2, 4)}


def scored(wanted: Candidates, known: Covisibility, spans: dict[int, tuple[int, int]]) -> RevisitScores:
    return score([judge(wanted, known, spans)])


def test_agreement_counts_pairs_of_chunks_once() -> None:
    found = scored(
        candidates((4, 1, 27, 3, True, 0.9, 1.5), (1, 4, 5, 29, True, 0.8, 1.4), (1, 3, 2, 20, True, 0.95, 0.4)),
        truth(),
        SPANS,
    )
    assert (found.chunks.true, found.chunks.claimed, found.chunks.correct) == (2, 2, 1)
    assert (found.chunks.precision, found.chunks.recall) == (0.5, 0.5)
    assert (found.frames.claimed, found.frames.correct, found.frames.recall) == (3, 2, 1.0)
    assert found.proposed_recall == 0.5
    assert found.wrong == ((1, 3, 2, 20),)
    assert found.missed == ((2, 4),)
    json.dumps(found.as_dict())


def test_the_better_ranking_has_the_greater_recall() -> None:
    found = scored(
        candidates((1, 4, 3, 27, False, 0.9, 1.5), (2, 4, 9, 33, False, 0.7, 1.4), (1, 3, 2, 20, False, 0.95, 0.4)),
        truth(),
        SPANS,
    )
    assert found.rankings["s_loop"].chunk_recall == 1.0
    assert found.rankings["s_loop"].chunk_threshold == 1.4
    assert found.rankings["s_det"].chunk_recall == 0.0
    assert found.rankings["s_det"].average_precision == pytest.approx((1 / 2 + 2 / 3) / 2)
    assert found.chunks.precision is None


def test_frames_between_the_known_ones_are_looked_up_at_the_nearest() -> None:
    wanted = candidates((1, 4, 3, 28, True, 1.0, 1.0), (1, 4, 3, 90, True, 1.0, 1.0))
    assert judge(wanted, truth(step=3), SPANS).frame_labels.tolist() == [TRUE, OPEN]


def test_neighbours_are_no_revisits_even_without_shared_frames() -> None:
    cut = {1: (0, 9), 2: (10, 17), 3: (18, 33)}
    judged = judge(candidates(), truth(), cut, neighbours=[(2, 1), (2, 3)])
    assert judged.true_pairs == {(1, 3)}
    assert (1, 2) in judge(candidates(), truth(), cut).true_pairs


def test_videos_are_scored_together() -> None:
    good = judge(candidates((1, 4, 3, 27, True, 0.9, 1.5)), truth(), SPANS)
    bad = judge(candidates((1, 3, 2, 20, True, 0.95, 0.4)), truth(), SPANS)
    both = score([good, bad])
    assert (both.chunks.true, both.chunks.correct, both.chunks.precision) == (4, 1, 0.5)
    assert both.rankings["s_loop"].chunk_recall == 0.25


def test_nothing_at_all_is_no_crash() -> None:
    empty = Covisibility(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 0), np.float32))
    found = scored(candidates((1, 4, 3, 27, True, 0.9, 1.5)), empty, SPANS)
    assert (found.chunks.true, found.chunks.open, found.chunks.precision) == (0, 1, None)
    assert score([]).chunks.recall is None
    assert scored(candidates(), truth(), SPANS).chunks.recall == 0.0


def test_unknown_covisibility_counts_neither_way() -> None:
    share = np.array([[1, np.nan, 0.5], [np.nan, 1, 0.05], [0.5, 0.02, 1]], np.float32)
    same, apart = frame_labels(share)
    assert (same[0, 1], apart[0, 1]) == (False, False)
    assert (same[0, 2], apart[1, 2]) == (True, True)


def test_shares_that_make_no_sense_are_named() -> None:
    with pytest.raises(OptionError, match="different <= least"):
        RevisitTruthSettings(least=0.1, different=0.3)
    with pytest.raises(OptionError, match="precision"):
        RevisitTruthSettings(precision=0.0)
    with pytest.raises(OptionError, match="shape"):
        Candidates(np.zeros((2, 2), int), np.zeros((1, 2), int), np.zeros(2, bool), {})


def test_candidates_are_the_loop_edges() -> None:
    edges = [
        Edge(1, 2, "adjacent", Sim3.identity(), 1, 1, 9, 0.01, True, ""),
        Edge(1, 4, "loop", Sim3.identity(), 1, 1, 9, 0.01, True, "", {"s_det": 0.7}, (3, 27)),
        Edge(2, 4, "loop", Sim3.identity(), 0, 0, 0, 0.0, False, "", {"s_det": 0.6, "s_sem": 0.5}, (9, 30)),
    ]
    found = Candidates.of_edges(edges)
    assert found.chunks.tolist() == [[1, 4], [2, 4]]
    assert np.isnan(found.scores["s_sem"]).tolist() == [True, False]
    assert Candidates.of_edges([]).frames.shape == (0, 2)


def brute_force(scores: list[float], labels: list[int], total: int, precision: float) -> float:
    best = 0.0
    for threshold in set(scores):
        taken = [y for s, y in zip(scores, labels, strict=True) if s >= threshold and y != OPEN]
        if taken and sum(y == TRUE for y in taken) / len(taken) >= precision:
            best = max(best, sum(y == TRUE for y in taken) / total)
    return best


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.sampled_from([TRUE, FALSE, OPEN])), max_size=14), st.floats(0.3, 1.0))
def test_recall_at_precision_is_the_best_of_all_thresholds(rows: list[tuple[int, int]], precision: float) -> None:
    scores, labels = [float(s) for s, _ in rows], [y for _, y in rows]
    total = labels.count(TRUE) + 1
    recall, threshold = recall_at_precision(scores, labels, total, precision)
    assert recall == pytest.approx(brute_force(scores, labels, total, precision))
    if threshold is not None:
        taken = [y for s, y in zip(scores, labels, strict=True) if s >= threshold and y != OPEN]
        assert sum(y == TRUE for y in taken) / total == pytest.approx(recall)
    mean = average_precision(scores, labels, total)
    assert mean is not None
    assert 0 <= mean <= 1
