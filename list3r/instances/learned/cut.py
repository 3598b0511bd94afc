"""A chunk's cloud cut into things by the trained networks: fine pieces first, then what they make up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.fusion import View
from list3r.instances.learned.agglomeration import STRONGEST, agglomerate
from list3r.instances.learned.graph import PieceGraph, Surroundings, piece_graph
from list3r.instances.learned.network import Judgement, Weights, judge
from list3r.instances.learned.pieces import Pieces, cut_pieces

Float = NDArray[np.float32]


@dataclass(frozen=True)
class CutSettings:
    """Where agglomeration stops. Both were chosen on worlds for training (see training/)."""

    sure: float = 2.0
    """Mean log odds above which fine pieces become parts."""
    enough: float = 0.0
    """Mean log odds above which parts become things."""


@dataclass(frozen=True)
class CloudCut:
    """T things of a cloud of N voxels."""

    labels: NDArray[np.int32]
    """Thing of each voxel, from 0; -1 for none. Shape (N,)."""
    structure: Float
    """Probability that a thing is of what bounds the room. Shape (T,)."""
    names: Float
    """Probabilities of the names. Shape (T, C)."""
    features: Float
    """What its confidence is told from, see `thing_features`. Shape (T, THING_FEATURES)."""

    def only(self, kept: NDArray[np.bool_]) -> CloudCut:
        """Return the cut with only the things that are `kept` (T,); the voxels of the others are of none."""
        number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
        labels = np.asarray(number[self.labels], np.int32)
        return CloudCut(labels, self.structure[kept], self.names[kept], self.features[kept])


THING_FEATURES = 8


def cut_cloud(
    cloud: Cloud, views: Sequence[View], around: Surroundings, weights: Weights, settings: CutSettings | None = None
) -> CloudCut:
    """Cut a cloud into things."""
    s = settings or CutSettings()
    pieces = cut_pieces(cloud, views, around)
    parts, coarse = make_parts(cloud, views, around, pieces, judge(weights, "fine", pieces.graph), s.sure)
    told = judge(weights, "coarse", coarse)
    count = len(coarse.nodes)
    own = agglomerate(count, coarse.left, coarse.right, told.affinity, coarse.weight, s.enough)
    labels = np.asarray(np.append(own, -1)[parts], np.int32)
    size = np.bincount(parts[parts >= 0], minlength=count).astype(np.float32)
    return summarise(labels, own, size, coarse, told)


def make_parts(
    cloud: Cloud, views: Sequence[View], around: Surroundings, pieces: Pieces, told: Judgement, sure: float
) -> tuple[NDArray[np.int32], PieceGraph]:
    """Return the part of each voxel (N,), -1 for none, and the parts' graph with what the first network said."""
    g = pieces.graph
    own = agglomerate(len(g.nodes), g.left, g.right, told.affinity, g.weight, sure)
    labels = pieces.joined(own)
    graph = piece_graph(cloud, views, labels, pieces.pairs, around, FAR)
    count = len(graph.nodes)
    size = np.bincount(pieces.labels[pieces.labels >= 0], minlength=len(own)).astype(np.float64)
    total = np.maximum(np.bincount(own, size, minlength=count), 1.0)
    said = np.column_stack([told.hidden, np.clip(told.structure, -STRONGEST, STRONGEST)])
    mean = np.stack(
        [np.bincount(own, said[:, k] * size, minlength=count) / total for k in range(said.shape[1])], axis=1
    )
    amount = np.log(np.bincount(own, minlength=count))[:, None]
    nodes = np.concatenate([graph.nodes, mean, amount], axis=1)
    edges = np.concatenate([graph.edges, _told_between(g, told, own, graph)], axis=1)
    full = PieceGraph(nodes.astype(np.float32), graph.left, graph.right, edges.astype(np.float32), graph.weight)
    return labels, full


FAR = 3
"""Doublings of the voxel's size at which parts are neighbours: legs end up to 16 cm below what they carry, where a view
from above hides their top."""
EXTRA_NODES = 34
"""Columns that `make_parts` adds to the features of pieces: 32 of the first network's, structure, number of pieces."""
EXTRA_EDGES = 4


def _told_between(g: PieceGraph, told: Judgement, own: NDArray[np.int64], graph: PieceGraph) -> NDArray[np.float64]:
    """Mean, least and greatest affinity of the fine borders between two parts, and their number. (E, EXTRA_EDGES)."""
    count = len(graph.nodes)
    codes = graph.left * count + graph.right
    a, b = own[g.left], own[g.right]
    fine = np.minimum(a, b) * count + np.maximum(a, b)
    at = np.minimum(np.searchsorted(codes, fine), len(codes) - 1)
    hit = (codes[at] == fine) & (a != b) if len(codes) else np.zeros(len(fine), bool)
    at, score = at[hit], np.clip(told.affinity[hit], -STRONGEST, STRONGEST).astype(np.float64)
    weight = g.weight[hit].astype(np.float64)
    mass = np.bincount(at, weight, minlength=len(codes))
    mean = np.bincount(at, score * weight, minlength=len(codes)) / np.maximum(mass, 1e-6)
    low, high = np.full(len(codes), STRONGEST), np.full(len(codes), -STRONGEST)
    np.minimum.at(low, at, score)
    np.maximum.at(high, at, score)
    times = np.bincount(at, minlength=len(codes))
    return np.column_stack([mean, np.where(times > 0, low, 0), np.where(times > 0, high, 0), np.log1p(times)])


def summarise(
    labels: NDArray[np.int32], own: NDArray[np.int64], size: Float, graph: PieceGraph, told: Judgement
) -> CloudCut:
    """Return the things that parts were joined to; `own` is the thing of each part, `size` its voxels. Shape (P,)."""
    count = int(own.max(initial=-1)) + 1
    total = np.maximum(np.bincount(own, size, minlength=count), 1.0)
    bound = 1.0 / (1.0 + np.exp(-np.clip(told.structure.astype(np.float64), -20, 20)))
    structure = np.bincount(own, bound * size, minlength=count) / total
    words = [np.bincount(own, told.names[:, k] * size, minlength=count) / total for k in range(told.names.shape[1])]
    odds = np.stack(words, axis=1)
    names = np.exp(odds - odds.max(axis=1, keepdims=True))
    names = names / names.sum(axis=1, keepdims=True)
    features = thing_features(own, size, structure, graph, told)
    return CloudCut(labels, structure.astype(np.float32), names.astype(np.float32), features)


def thing_features(
    own: NDArray[np.int64], size: Float, structure: NDArray[np.float64], graph: PieceGraph, told: Judgement
) -> Float:
    """Return what tells whether a thing is whole: size, how tight inside, how loose outside. (T, THING_FEATURES)."""
    count = int(own.max(initial=-1)) + 1
    a, b = own[graph.left], own[graph.right]
    score, weight = np.clip(told.affinity, -STRONGEST, STRONGEST).astype(np.float64), graph.weight.astype(np.float64)
    inside = a == b
    tight = np.bincount(a[inside], (score * weight)[inside], minlength=count)
    held = np.bincount(a[inside], weight[inside], minlength=count)
    least = np.full(count, STRONGEST)
    np.minimum.at(least, a[inside], score[inside])
    out, rim, most = np.zeros(count), np.zeros(count), np.full(count, -STRONGEST)
    for side in (a[~inside], b[~inside]):
        out += np.bincount(side, (score * weight)[~inside], minlength=count)
        rim += np.bincount(side, weight[~inside], minlength=count)
        np.maximum.at(most, side, score[~inside])
    total = np.maximum(np.bincount(own, size, minlength=count), 1.0)
    columns = [
        np.log(total),
        np.where(held > 0, tight / np.maximum(held, 1e-6), STRONGEST),
        least,
        np.where(rim > 0, out / np.maximum(rim, 1e-6), -STRONGEST),
        most,
        np.log((rim + 1.0) / np.sqrt(total)),
        structure,
        np.log(np.maximum(np.bincount(own, minlength=count), 1)),
    ]
    return np.column_stack(columns).astype(np.float32)
