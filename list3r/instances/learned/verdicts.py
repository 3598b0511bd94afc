"""Classification of clusters of parts: structure, names, and whether each is one whole object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.instances.learned.agglomeration import STRONGEST
from list3r.instances.learned.graph import PieceGraph
from list3r.instances.learned.name_confidence import NameConfidence, name_signs, with_confidence
from list3r.instances.learned.network import Classification, Weights, two_layers

Float = NDArray[np.float32]


SHOWN_NODES = (2, 3, 4, *range(16, 26))
"""Columns of the parts' features that are averaged for the classifier: slopes, colours, noise, occluders."""
NODES_AT = 19
"""Column of the first of them among the features of objects."""


@dataclass(frozen=True)
class SegmentVerdicts:
    """Classification of T clusters."""

    structure: Float
    """Probability that it bounds the room. Shape (T,)."""
    whole: Float
    """Calibrated probability that it is one object and all of it. Shape (T,)."""
    names: Float
    """Calibrated probabilities of the names, see `names_of`. Shape (T, C)."""

    def rows(self, rows: NDArray[np.int64]) -> SegmentVerdicts:
        """Return the verdicts of some clusters, in their order. `rows` has shape (R,)."""
        return SegmentVerdicts(self.structure[rows], self.whole[rows], self.names[rows])


def names_of(weights: Weights) -> tuple[str, ...]:
    """Return the names that the weights know, in their order."""
    return tuple(weights["names"].tolist())


def classify_segments(
    weights: Weights,
    own: NDArray[np.int64],
    graph: PieceGraph,
    scores: Classification,
    confidence: NameConfidence | None = None,
) -> SegmentVerdicts:
    """Classify clusters of parts; `own` is the cluster of each part, from 0. Shape (P,)."""
    structure, x = segment_features(own, graph, scores)
    whole, names = first_verdicts(weights, x)
    signs = name_signs(names, whole, structure)
    names = with_confidence(names, (confidence or NameConfidence()).probability(signs))
    return SegmentVerdicts(structure.astype(np.float32), whole.astype(np.float32), names.astype(np.float32))


def first_verdicts(weights: Weights, x: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the probabilities of being one whole (T,) and of the names (T, C) as the network learned them."""
    out = two_layers(
        weights, "things.net", np.asarray((x - weights["things.mean"]) / weights["things.std"], np.float32)
    )
    a, b = (float(v) for v in weights["things.whole"])
    whole = 1.0 / (1.0 + np.exp(-np.clip(a * out[:, 0] + b, -20.0, 20.0)))
    odds = out[:, 1:] / np.maximum(weights["things.temperature"], np.float32(1e-3))
    names = np.exp((odds - odds.max(axis=1, keepdims=True)).astype(np.float64))
    return whole.astype(np.float64), names / names.sum(axis=1, keepdims=True)


def segment_features(
    own: NDArray[np.int64], graph: PieceGraph, scores: Classification
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the probability that each cluster is structure (T,), and the classifier's inputs (T, F)."""
    count, size = int(own.max(initial=-1)) + 1, graph.moments[:, 0].astype(np.float64)
    total = np.maximum(np.bincount(own, size, minlength=count), 1.0)

    def mean(values: NDArray[np.generic]) -> NDArray[np.float64]:
        table = (values if values.ndim == 2 else values[:, None]).astype(np.float64)
        sums = [np.bincount(own, table[:, k] * size, minlength=count) for k in range(table.shape[1])]
        return np.stack(sums, axis=1) / total[:, None]

    bound = 1.0 / (1.0 + np.exp(-np.clip(scores.structure.astype(np.float64), -20, 20)))
    structure = mean(bound)[:, 0]
    most = np.full((count, scores.hidden.shape[1]), -np.inf)
    np.maximum.at(most, own, scores.hidden)
    columns = [
        np.log(total),
        structure,
        np.log(np.maximum(np.bincount(own, minlength=count), 1)),
        *_borders(own, graph, scores, np.sqrt(total), bound),
        *_shape(own, graph, mean, count),
        mean(graph.nodes[:, list(SHOWN_NODES)]),
        mean((graph.nodes[:, 3] > 0.8) * 1.0),
        mean((graph.nodes[:, 3] < 0.3) * 1.0),
        mean(scores.hidden),
        most,
        mean(np.maximum(scores.names, -12.0)),
    ]
    return structure, np.column_stack(columns).astype(np.float32)


def _borders(
    own: NDArray[np.int64],
    graph: PieceGraph,
    scores: Classification,
    outline: NDArray[np.float64],
    bound: NDArray[np.float64],
) -> list[NDArray[np.float64]]:
    """How tight clusters are inside, how loose outside, and how much of their rim is at structure. Shape (T,) each."""
    count = len(outline)
    a, b = own[graph.left], own[graph.right]
    score, weight = np.clip(scores.affinity, -STRONGEST, STRONGEST).astype(np.float64), graph.weight.astype(np.float64)
    inside = a == b
    tight = np.bincount(a[inside], (score * weight)[inside], minlength=count)
    held = np.bincount(a[inside], weight[inside], minlength=count)
    least = np.full(count, STRONGEST)
    np.minimum.at(least, a[inside], score[inside])
    out, rim, at_structure, most = np.zeros(count), np.zeros(count), np.zeros(count), np.full(count, -STRONGEST)
    for side, other in ((a, graph.right), (b, graph.left)):
        mine = side[~inside]
        out += np.bincount(mine, (score * weight)[~inside], minlength=count)
        rim += np.bincount(mine, weight[~inside], minlength=count)
        at_structure += np.bincount(mine, (weight * bound[other])[~inside], minlength=count)
        np.maximum.at(most, mine, score[~inside])
    return [
        np.where(held > 0, tight / np.maximum(held, 1e-6), STRONGEST),
        least,
        np.where(rim > 0, out / np.maximum(rim, 1e-6), -STRONGEST),
        most,
        np.log((rim + 1.0) / outline),
        at_structure / np.maximum(rim, 1e-6),
    ]


def _shape(own: NDArray[np.int64], graph: PieceGraph, mean: _Mean, count: int) -> list[NDArray[np.float64]]:
    """Length, width, height, thickness, and height over the floor of clusters, metres and logarithms. (T,) each."""
    m = graph.moments.astype(np.float64)
    center = mean(m[:, 1:4])
    off = m[:, 1:4] - center[own]
    squares = [off[:, i] * off[:, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    c = mean(m[:, 4:] + np.stack(squares, axis=1))
    full = np.stack([c[:, [0, 3, 4]], c[:, [3, 1, 5]], c[:, [4, 5, 2]]], axis=1)
    level = np.sqrt(np.maximum(np.linalg.eigvalsh(full[:, :2, :2]), 0.0) * 12.0)
    thick = np.sqrt(np.maximum(np.linalg.eigvalsh(full)[:, 0], 0.0) * 12.0)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, own, graph.nodes[:, 13].astype(np.float64))
    np.maximum.at(high, own, graph.nodes[:, 14].astype(np.float64))
    tall = np.maximum(high - low, 0.0)
    sizes = [level[:, 1], level[:, 0], tall, thick]
    return [*(np.minimum(s, 3.0) for s in sizes), *(np.log(s + 0.01) for s in sizes), low, high]


class _Mean(Protocol):
    """Mean over the voxels of each cluster."""

    def __call__(self, values: NDArray[np.generic]) -> NDArray[np.float64]: ...
