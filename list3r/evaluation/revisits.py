"""Loop candidates against covisibility: which claimed revisits are true, which true ones were found.

A pair of frames is a *revisit* when each sees at least the share `least` of the other's surface, and *different* when
either sees less than `different` of it; pairs in between are ignored. A pair of chunks is a revisit when any of its
frame pairs is, different when all are. Chunks that follow on one another are no revisits.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.evaluation.covisibility import Covisibility
from list3r.frames.recordings.stamps import nearest_rows
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Edge, JsonFields

Array = NDArray[np.float64]
TRUE, FALSE, OPEN = 1, 0, -1
"""Labels: the same place, different places, neither can be said."""


@dataclass(frozen=True)
class RevisitTruthSettings:
    """When two frames see the same place."""

    least: float = 0.3
    """Least share of the surface, both ways, of a revisit: the hard pairs of matching benchmarks start at 40 % overlap
    (SuperGlue on ScanNet), and 30 % still suffices for an alignment."""
    different: float = 0.1
    """Share of the surface, either way, below which two frames see different places: below 10 % even the pairs of
    MegaDepth's hardest training sets end."""
    precision: float = 0.99
    """Least precision at which the recall of a ranking is reported: one false loop can bend a map."""

    def __post_init__(self) -> None:
        if not 0 < self.different <= self.least <= 1:
            raise OptionError(f"shares {self.least} and {self.different}: give 0 < different <= least <= 1")
        if not 0 < self.precision <= 1:
            raise OptionError(f"precision {self.precision}: give a share above 0 and up to 1")


@dataclass(frozen=True)
class Candidates:
    """Claims that two chunks see the same place, N of them."""

    chunks: NDArray[np.int64]
    """Chunk ids u and v. Shape (N, 2)."""
    frames: NDArray[np.int64]
    """Frame.index in u and in v of the pair that was compared. Shape (N, 2)."""
    accepted: NDArray[np.bool_]
    """Shape (N,)."""
    scores: dict[str, Array]
    """By name, greater is likelier, NaN where a claim has none. Each of shape (N,)."""

    def __post_init__(self) -> None:
        count = len(self.accepted)
        if self.chunks.shape != (count, 2) or self.frames.shape != (count, 2):
            raise OptionError(
                f"{count} candidates with chunks of shape {self.chunks.shape} and frames of shape {self.frames.shape}"
            )
        if any(s.shape != (count,) for s in self.scores.values()):
            raise OptionError(f"{count} candidates with scores of another length")

    @staticmethod
    def of_edges(edges: Iterable[Edge]) -> Candidates:
        """Return the loop edges of a memory that know their frames."""
        loops = [e for e in edges if e.kind == "loop" and e.frames is not None]
        names = sorted({name for e in loops for name in e.scores})
        return Candidates(
            np.array([(e.u, e.v) for e in loops], dtype=np.int64).reshape(-1, 2),
            np.array([e.frames for e in loops], dtype=np.int64).reshape(-1, 2),
            np.array([e.accepted for e in loops], dtype=bool),
            {name: np.array([float(e.scores.get(name, np.nan)) for e in loops]) for name in names},
        )


@dataclass(frozen=True)
class RevisitJudgement:
    """Candidates of one video with their ground truth. Several videos are scored together."""

    candidates: Candidates
    frame_labels: NDArray[np.int8]
    """TRUE, FALSE or OPEN for the frame pair of each candidate. Shape (N,)."""
    chunk_labels: NDArray[np.int8]
    """The same for its pair of chunks. Shape (N,)."""
    true_pairs: frozenset[tuple[int, int]]
    """Pairs of chunks, smaller id first, that are revisits."""


@dataclass(frozen=True)
class Agreement:
    """How well claims agree with the truth at one level."""

    true: int
    """Number of true revisits."""
    claimed: int
    """Accepted, open ones left out."""
    correct: int
    open: int
    """Accepted, but neither true nor false."""
    precision: float | None
    """None where nothing was claimed."""
    recall: float | None
    """None where nothing was to be found."""


@dataclass(frozen=True)
class Ranking:
    """Claims sorted by one score instead of taken by their verdict."""

    chunk_recall: float | None
    """Greatest share of the true pairs of chunks at or above the wanted precision."""
    frame_recall: float | None
    """The same of the proposed frame pairs that are revisits."""
    chunk_threshold: float | None
    """Least score of that choice; None where no choice is precise enough."""
    average_precision: float | None
    """Mean precision over the true pairs of chunks, found or not."""


@dataclass(frozen=True)
class RevisitScores(JsonFields):
    """Recall of revisits."""

    settings: RevisitTruthSettings
    candidates: int
    chunks: Agreement
    """Pairs of chunks joined by an accepted candidate, against all pairs of chunks that see the same place."""
    frames: Agreement
    """Accepted candidates by their frame pair, against the proposed frame pairs that are revisits."""
    proposed_recall: float | None
    """Share of the true pairs of chunks that have a candidate at all: the recall of the proposal stage."""
    rankings: dict[str, Ranking]
    """By score."""
    wrong: tuple[tuple[int, int, int, int], ...]
    """Accepted between chunks that see different places throughout: chunk u, chunk v, frame in u, frame in v."""
    missed: tuple[tuple[int, int], ...]
    """True pairs of chunks that no accepted candidate joins."""


def judge(
    candidates: Candidates,
    covisibility: Covisibility,
    spans: Mapping[int, tuple[int, int]],
    neighbours: Collection[tuple[int, int]] | None = None,
    settings: RevisitTruthSettings | None = None,
) -> RevisitJudgement:
    """Return which candidates of a video are true.

    `spans` gives the first and last Frame.index of each chunk. `neighbours` are pairs of chunks that never count as
    revisits; None takes pairs that share frames. A candidate's frame is mapped to the nearest frame of `covisibility`,
    if that is within its greatest step.
    """
    chosen = settings or RevisitTruthSettings()
    same, apart = frame_labels(covisibility.share, chosen)
    near = {_ordered(u, v) for u, v in (_sharing(spans) if neighbours is None else neighbours)}
    true_pairs, false_pairs = _chunk_pairs(same, apart, covisibility.frame, spans, near)
    rows, columns = (_nearest_rows(covisibility.frame, candidates.frames[:, k]) for k in (0, 1))
    label = np.full(len(rows), OPEN, dtype=np.int8)
    known = np.flatnonzero((rows >= 0) & (columns >= 0))
    label[known[same[rows[known], columns[known]]]] = TRUE
    label[known[apart[rows[known], columns[known]]]] = FALSE
    pairs = [_ordered(u, v) for u, v in candidates.chunks.tolist()]
    by_chunk = [TRUE if p in true_pairs else FALSE if p in false_pairs else OPEN for p in pairs]
    return RevisitJudgement(candidates, label, np.array(by_chunk, dtype=np.int8).reshape(-1), frozenset(true_pairs))


def frame_labels(
    share: ArrayLike, settings: RevisitTruthSettings | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which frame pairs are revisits and which different places, by directed shares (F, F); NaN is neither."""
    chosen = settings or RevisitTruthSettings()
    s = np.asarray(share)
    return np.minimum(s, s.T) >= chosen.least, np.maximum(s, s.T) < chosen.different


def score(judgements: Sequence[RevisitJudgement], settings: RevisitTruthSettings | None = None) -> RevisitScores:
    """Score the candidates of one or several videos together."""
    chosen = settings or RevisitTruthSettings()
    names = sorted({name for j in judgements for name in j.candidates.scores})
    frame_label = np.concatenate([j.frame_labels for j in judgements] or [np.zeros(0, np.int8)])
    accepted = np.concatenate([j.candidates.accepted for j in judgements] or [np.zeros(0, bool)])
    true_count = sum(len(j.true_pairs) for j in judgements)
    verdicts = [_by_pair(j, j.candidates.accepted.astype(np.float64)) for j in judgements]
    claimed = [label for pairs in verdicts for label, verdict in pairs.values() if verdict > 0]
    proposed = sum(label == TRUE for pairs in verdicts for label, _ in pairs.values())
    return RevisitScores(
        settings=chosen,
        candidates=len(accepted),
        chunks=_agreement(np.array(claimed, dtype=np.int8), true_count),
        frames=_agreement(frame_label[accepted], int((frame_label == TRUE).sum())),
        proposed_recall=proposed / true_count if true_count else None,
        rankings={name: _ranking(judgements, name, true_count, chosen.precision) for name in names},
        wrong=tuple(row for j in judgements for row in _wrong(j)),
        missed=tuple(
            pair
            for j, pairs in zip(judgements, verdicts, strict=True)
            for pair in sorted(j.true_pairs)
            if pair not in pairs or not pairs[pair][1] > 0
        ),
    )


def recall_at_precision(
    scores: ArrayLike, labels: ArrayLike, total: int, precision: float
) -> tuple[float | None, float | None]:
    """Return the greatest recall, of `total` true ones, of a choice `scores >= threshold` that is precise enough; its
    threshold.

    `labels` are TRUE, FALSE or OPEN; open ones count neither way, and claims without a score are never chosen. Claims
    of one score are taken together. (None, None) when there is nothing to find, (0, None) when no choice is precise
    enough.
    """
    if total <= 0:
        return None, None
    order, right, chosen = _cumulative(scores, labels)
    good = right >= precision * chosen - 1e-9
    good &= right > 0
    if not good.any():
        return 0.0, None
    k = int(np.flatnonzero(good)[-1])
    best = int(np.flatnonzero(good & (right == right[k]))[0])
    return float(right[k] / total), float(order[best])


def average_precision(scores: ArrayLike, labels: ArrayLike, total: int) -> float | None:
    """Return the average precision over all `total` true revisits, 0 for those never found."""
    if total <= 0:
        return None
    _, right, chosen = _cumulative(scores, labels)
    gained = np.diff(np.concatenate([[0.0], right]))
    return float((gained * right / np.maximum(chosen, 1)).sum() / total)


def _cumulative(scores: ArrayLike, labels: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the distinct scores from the best down, and the true and the chosen claims at or above each. Three of
    shape (T,)."""
    s, label = np.asarray(scores, dtype=np.float64), np.asarray(labels)
    keep = np.isfinite(s) & (label != OPEN)
    levels, at = np.unique(-s[keep], return_inverse=True)
    right = np.bincount(at, weights=(label[keep] == TRUE).astype(np.float64), minlength=len(levels))
    count = np.bincount(at, minlength=len(levels)).astype(np.float64)
    return -levels, np.cumsum(right), np.cumsum(count)


def _ranking(judgements: Sequence[RevisitJudgement], name: str, true_count: int, precision: float) -> Ranking:
    absent = [np.full(len(j.frame_labels), np.nan) for j in judgements]
    values = [j.candidates.scores.get(name, nan) for j, nan in zip(judgements, absent, strict=True)]
    pairs = [p for j, v in zip(judgements, values, strict=True) for p in _by_pair(j, v).values()]
    chunk_labels, chunk_scores = np.array([p[0] for p in pairs], dtype=np.int8), np.array([p[1] for p in pairs])
    frame_label = np.concatenate([j.frame_labels for j in judgements])
    recall, threshold = recall_at_precision(chunk_scores, chunk_labels, true_count, precision)
    found = int((frame_label == TRUE).sum())
    return Ranking(
        chunk_recall=recall,
        frame_recall=recall_at_precision(np.concatenate(values), frame_label, found, precision)[0],
        chunk_threshold=threshold,
        average_precision=average_precision(chunk_scores, chunk_labels, true_count),
    )


def _by_pair(judgement: RevisitJudgement, values: Array) -> dict[tuple[int, int], tuple[int, float]]:
    """(label, best value) of each pair of chunks that has a candidate."""
    out: dict[tuple[int, int], tuple[int, float]] = {}
    for (u, v), label, value in zip(
        judgement.candidates.chunks.tolist(), judgement.chunk_labels.tolist(), values.tolist(), strict=True
    ):
        best = out.get(_ordered(u, v), (label, float("nan")))[1]
        out[_ordered(u, v)] = (label, float(np.fmax(best, value)))
    return out


def _agreement(labels: NDArray[np.int8], true_count: int) -> Agreement:
    correct, decided = int((labels == TRUE).sum()), int((labels != OPEN).sum())
    return Agreement(
        true=true_count,
        claimed=decided,
        correct=correct,
        open=len(labels) - decided,
        precision=correct / decided if decided else None,
        recall=correct / true_count if true_count else None,
    )


def _wrong(judgement: RevisitJudgement) -> list[tuple[int, int, int, int]]:
    """Return the accepted candidates between chunks that see different places throughout."""
    c = judgement.candidates
    bad = c.accepted & (judgement.chunk_labels == FALSE)
    return [(int(u), int(v), int(a), int(b)) for (u, v), (a, b) in zip(c.chunks[bad], c.frames[bad], strict=True)]


def _chunk_pairs(
    same: NDArray[np.bool_],
    apart: NDArray[np.bool_],
    frame: NDArray[np.int64],
    spans: Mapping[int, tuple[int, int]],
    neighbours: set[tuple[int, int]],
) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
    """Return pairs of chunks that are revisits, and pairs that see different places throughout."""
    rows = {k: np.flatnonzero((frame >= first) & (frame <= last)) for k, (first, last) in spans.items()}
    true_pairs, false_pairs = set(), set()
    for u, v in combinations(sorted(spans), 2):
        if (u, v) in neighbours or not len(rows[u]) or not len(rows[v]):
            continue
        block = np.ix_(rows[u], rows[v])
        if same[block].any():
            true_pairs.add((u, v))
        elif apart[block].all():
            false_pairs.add((u, v))
    return true_pairs, false_pairs


def _sharing(spans: Mapping[int, tuple[int, int]]) -> list[tuple[int, int]]:
    pairs = combinations(sorted(spans), 2)
    return [(u, v) for u, v in pairs if spans[v][0] <= spans[u][1] and spans[u][0] <= spans[v][1]]


def _nearest_rows(frame: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return row of nearest known frame, -1 where it is further away than the greatest step between known frames."""
    if not len(frame):
        return np.full(len(wanted), -1, dtype=np.int64)
    row = nearest_rows(frame, wanted)
    reach = int(np.diff(frame).max()) if len(frame) > 1 else 0
    return np.where(np.abs(frame[row] - wanted) <= reach, row, -1).astype(np.int64)


def _ordered(u: int, v: int) -> tuple[int, int]:
    return (int(u), int(v)) if u <= v else (int(v), int(u))
