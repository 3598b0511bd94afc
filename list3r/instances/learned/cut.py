"""A chunk's cloud cut into objects by the trained networks: fine pieces first, then parts and objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from list3r.instances.learned.agglomeration import STRONGEST, agglomerate
from list3r.instances.learned.graph import ChunkSurface, PieceGraph, piece_graph
from list3r.instances.learned.network import Classification, Weights, classify
from list3r.instances.learned.pieces import Pieces, cut_pieces
from list3r.instances.learned.verdicts import SegmentVerdicts, classify_segments


@dataclass(frozen=True)
class CutSettings:
    """Where agglomeration stops, chosen on left-out worlds (research/discovery 0135)."""

    sure: float = 3.5
    """Mean log odds above which fine pieces become parts."""
    steps: tuple[float, ...] = (3.5, 2.5, 1.5)
    """Mean log odds above which parts are joined before the merged parts are scored again, one step after the other."""
    enough: float = 0.0
    """Mean log odds above which parts become objects."""
    hop_m: float = 0.05
    """Longest gap over which voxels of no piece go to the object that is nearest."""


@dataclass(frozen=True)
class CloudCut:
    """T objects of a cloud of N voxels."""

    labels: NDArray[np.int32]
    """Object of each voxel, from 0; -1 for none. Shape (N,)."""
    verdicts: SegmentVerdicts

    def only(self, kept: NDArray[np.bool_]) -> CloudCut:
        """Return the cut with only the objects that are `kept` (T,); the voxels of the others are of none."""
        number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
        return CloudCut(np.asarray(number[self.labels], np.int32), self.verdicts.rows(np.flatnonzero(kept)))


def cut_cloud(surface: ChunkSurface, weights: Weights, settings: CutSettings | None = None) -> CloudCut:
    """Cut a cloud into objects."""
    s = settings or CutSettings()
    parts, graph, scores = join_parts(surface, cut_pieces(surface), weights, s)
    own = agglomerate(len(graph.nodes), graph.left, graph.right, scores.affinity, graph.weight, s.enough)
    labels = np.asarray(np.append(own, -1)[parts], np.int32)
    labels = spread_labels(surface.cloud.points, labels, s.hop_m * surface.around.unit)
    return CloudCut(labels, classify_segments(weights, own, graph, scores))


def join_parts(
    surface: ChunkSurface, pieces: Pieces, weights: Weights, s: CutSettings
) -> tuple[NDArray[np.int32], PieceGraph, Classification]:
    """Return the part of each voxel (N,), -1 for none, the parts' graph, and the second network's scores of it.

    Only confident joins are made at a time; then size, place and borders of the results are measured again, so that
    small pieces without evidence decide no early join.
    """
    g, scores = pieces.graph, classify(weights, "fine", pieces.graph)
    own = agglomerate(len(g.nodes), g.left, g.right, scores.affinity, g.weight, s.sure)
    for end in s.steps:
        _, graph = group(surface, pieces, scores, own)
        said = classify(weights, "coarse", graph).affinity
        own = agglomerate(len(graph.nodes), graph.left, graph.right, said, graph.weight, end)[own]
    labels, graph = group(surface, pieces, scores, own)
    return labels, graph, classify(weights, "coarse", graph)


def spread_labels(points: NDArray[np.floating], labels: NDArray[np.int32], hop: float) -> NDArray[np.int32]:
    """Return labels (N,) in which unlabelled points (-1) get the nearest label by paths without a gap above `hop`.

    Sides seen at a grazing angle are too sparse for pieces, but only they show an object's depth. Gaps count squared,
    so that paths prefer dense points. `points` has shape (N, 3).
    """
    free, taken = np.flatnonzero(labels < 0), np.flatnonzero(labels >= 0)
    if not len(free) or not len(taken):
        return labels
    found = cKDTree(points[taken]).query(points[free], distance_upper_bound=hop)
    gap, nearest = np.asarray(found[0]), np.asarray(found[1], np.int64)
    near = np.flatnonzero(np.isfinite(gap))
    pairs = cKDTree(points[free]).query_pairs(hop, output_type="ndarray")
    starts, at = np.unique(nearest[near], return_inverse=True)
    between = np.linalg.norm(points[free[pairs[:, 0]]] - points[free[pairs[:, 1]]], axis=1)
    cost = np.square(np.concatenate([between, gap[near]])) + 1e-9
    rows, columns = np.concatenate([pairs[:, 0], near]), np.concatenate([pairs[:, 1], len(free) + at])
    size = len(free) + len(starts)
    ways = coo_matrix((cost, (rows, columns)), shape=(size, size)).tocsr()
    indices = np.arange(len(free), size)
    _, _, source = dijkstra(ways, directed=False, indices=indices, return_predecessors=True, min_only=True)
    reached = np.flatnonzero(source[: len(free)] >= 0)
    out = labels.copy()
    out[free[reached]] = labels[taken[starts[source[reached] - len(free)]]]
    return out


def group(
    surface: ChunkSurface, pieces: Pieces, scores: Classification, own: NDArray[np.int64]
) -> tuple[NDArray[np.int32], PieceGraph]:
    """Return the group of each voxel (N,), -1 for none, and the groups' graph with the first network's outputs.

    `own` is the group of each piece, from 0. Shape (P,).
    """
    g = pieces.graph
    labels = pieces.joined(own)
    graph = piece_graph(surface, labels, FAR)
    count = len(graph.nodes)
    size = np.bincount(pieces.labels[pieces.labels >= 0], minlength=len(own)).astype(np.float64)
    total = np.maximum(np.bincount(own, size, minlength=count), 1.0)
    said = np.column_stack([scores.hidden, np.clip(scores.structure, -STRONGEST, STRONGEST)])
    mean = np.stack(
        [np.bincount(own, said[:, k] * size, minlength=count) / total for k in range(said.shape[1])], axis=1
    )
    amount = np.log(np.bincount(own, minlength=count))[:, None]
    nodes = np.concatenate([graph.nodes, mean, amount], axis=1)
    edges = np.concatenate([graph.edges, _affinity_between(g, scores, own, graph)], axis=1)
    return labels, replace(graph, nodes=nodes.astype(np.float32), edges=edges.astype(np.float32))


FAR = 3
"""Doublings of the voxel's size at which parts are neighbours: a view from above hides the top of legs."""
EXTRA_NODES = 2
"""Columns that `group` adds to the features of pieces and the hidden state: structure and number of pieces."""
EXTRA_EDGES = 4


def _affinity_between(
    g: PieceGraph, scores: Classification, own: NDArray[np.int64], graph: PieceGraph
) -> NDArray[np.float64]:
    """Mean, least and greatest affinity of the fine borders between two parts, and their number. (E, EXTRA_EDGES)."""
    count = len(graph.nodes)
    codes = graph.left * count + graph.right
    a, b = own[g.left], own[g.right]
    fine = np.minimum(a, b) * count + np.maximum(a, b)
    at = np.minimum(np.searchsorted(codes, fine), len(codes) - 1)
    hit = (codes[at] == fine) & (a != b) if len(codes) else np.zeros(len(fine), bool)
    at, score = at[hit], np.clip(scores.affinity[hit], -STRONGEST, STRONGEST).astype(np.float64)
    weight = g.weight[hit].astype(np.float64)
    mass = np.bincount(at, weight, minlength=len(codes))
    mean = np.bincount(at, score * weight, minlength=len(codes)) / np.maximum(mass, 1e-6)
    low, high = np.full(len(codes), STRONGEST), np.full(len(codes), -STRONGEST)
    np.minimum.at(low, at, score)
    np.maximum.at(high, at, score)
    times = np.bincount(at, minlength=len(codes))
    return np.column_stack([mean, np.where(times > 0, low, 0), np.where(times > 0, high, 0), np.log1p(times)])
