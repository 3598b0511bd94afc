"""Deform chunks so that shared frames and loop closures agree: a graph of nodes within chunks (in the paper's A.1 a
node every 50 frames).

The graph of chunks (`pose_graph`) decides which edges are inliers. Every chunk is cut into nodes (`chunk_nodes`): its
neighbouring nodes are tied as stiffly as overlaps show, nodes of two chunks by their shared frames, and nodes of a
loop's two frames by the loop. The same solver places all nodes; their mean places the chunk, and the remainder is the
chunk's non-rigid correction. The gain: research/association 0043.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.chunk_nodes import (
    ChunkNodes,
    FrameRelations,
    NodeSettings,
    Tie,
    measured_walk,
    walk_covariance,
)
from list3r.association.graph.edge_information import information_of
from list3r.association.graph.pose_graph import GraphResult, GraphSettings
from list3r.association.graph.sampled_chunks import SampledChunks
from list3r.association.graph.solver import GraphProblem, unstack
from list3r.memory.core.bends import Bend
from list3r.memory.core.geometry import Sim3, stack, take
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]

_UNTRUSTED = 1e9
"""Variance factor of outlier edges, so that components that only they join stay in place."""
_STEPS = 10
"""Most steps of the solution; its start is near."""


@dataclass(frozen=True)
class NodeGraphParts:
    """The inputs of the node graph."""

    nodes: dict[int, ChunkNodes]
    """By chunk id."""
    relations: list[tuple[Edge, FrameRelations]]
    """Of inlier adjacent edges."""
    chunks: SampledChunks
    """The samples that nodes and relations come from."""

    @cached_property
    def first(self) -> dict[int, int]:
        """Row of each chunk's first node among all nodes, by chunk id."""
        counts = [len(nodes.at) for nodes in self.nodes.values()]
        return dict(zip(self.nodes, np.cumsum([0, *counts]).tolist(), strict=False))

    @property
    def count(self) -> int:
        """Nodes of all chunks."""
        return sum(len(nodes.at) for nodes in self.nodes.values())


def bend_chunks(
    chunks: SampledChunks,
    graph: GraphResult,
    rigid: Collection[int],
    metric: bool,
    settings: NodeSettings | None = None,
    weights: GraphSettings | None = None,
    turning: Collection[int] = (),
) -> tuple[GraphResult, dict[int, Bend]]:
    """Return the graph with every chunk at the mean of its nodes, and the non-rigid correction of each chunk.

    The first chunk of each component stays in place. `rigid` chunks do not deform (their poses were given), `turning`
    ones lose scale where their camera rotates; chunks without posed frames have no correction.
    """
    chosen = settings or NodeSettings()
    known = graph.S_graph_chunk
    believed = [e for e in graph.edges if e.u in known and e.v in known and (e.accepted or "trust" in e.scores)]
    if not chosen.enabled or not believed:
        return graph, {}
    pieces = pieces_of(chunks, sorted(graph.S_graph_chunk), believed, rigid, chosen)
    start = [graph.S_graph_chunk[c] for c, nodes in pieces.nodes.items() for _ in nodes.at]
    problem = _problem(pieces, believed, graph.components, metric, chosen, weights or GraphSettings(), turning)
    placed = problem.solve(stack(start), np.ones(len(problem.u)), _STEPS)
    return _place_chunks(placed, pieces.nodes, graph, rigid)


def pieces_of(
    chunks: SampledChunks, ids: Sequence[int], believed: Sequence[Edge], rigid: Collection[int], settings: NodeSettings
) -> NodeGraphParts:
    """Return nodes of all chunks and relations of adjacent ones, in one pass over the samples."""
    to = {e.v: e for e in believed if e.kind == "adjacent" and e.accepted}
    length = {k: 0 if k in rigid else settings.frames for k in {*ids, *(e.u for e in to.values())}}
    nodes, relations = {}, []
    for chunk in ids:
        nodes[chunk] = chunks.nodes(chunk, length[chunk])
        if (edge := to.get(chunk)) is not None:
            relations.append((edge, chunks.relations(edge, length[edge.u])))
    return NodeGraphParts(nodes, relations, chunks)


def _problem(
    pieces: NodeGraphParts,
    believed: Sequence[Edge],
    components: Mapping[int, int],
    metric: bool,
    settings: NodeSettings,
    weights: GraphSettings,
    turning: Collection[int],
) -> GraphProblem:
    """Lay out all nodes and all ties between them."""
    first = pieces.first
    ends: list[tuple[int, int]] = []
    between: list[Sim3] = []
    covariances: list[Array] = []

    def add(u: int, v: int, S_v_u: Sim3, covariance: Array) -> None:
        ends.append((u, v))
        between.append(S_v_u)
        covariances.append(covariance)

    walk = settings.measured_share * measured_walk([r for _, r in pieces.relations])
    walk = np.maximum(walk + np.array([settings.shift_walk, settings.turn_walk, 0.0]) ** 2, settings.least_walk**2)
    for chunk, nodes in pieces.nodes.items():
        for k in range(len(nodes.at) - 1):
            deformation = walk_covariance(nodes, k, walk) + (nodes.turns[k] if chunk in turning else 0.0)
            add(first[chunk] + k, first[chunk] + k + 1, Sim3.identity(), deformation)
    tied = set()
    for edge, relations in pieces.relations:
        relations = relations.rigid() if metric else relations
        ties = pieces.chunks.ties(edge, relations, (pieces.nodes[edge.u], pieces.nodes[edge.v]), settings)
        for tie in ties:
            add(first[edge.u] + tie.u, first[edge.v] + tie.v, tie.S_v_u, tie.covariance)
        if ties:
            tied.add((edge.u, edge.v))
    size = 6 if metric else 7
    # Where scale is known it is no unknown: the block of the inverse, not the inverse of the block. Otherwise the
    # uncertainty of depth ratios would let a chunk slide towards its origin, however far away that is.
    information = inverses(np.array(covariances).reshape(-1, 7, 7))[:, :size, :size]
    rest = [e for e in believed if e.kind != "adjacent" or (e.u, e.v) not in tied]
    for edge in rest:
        tie = _whole(edge, pieces.nodes)
        add(first[edge.u] + tie.u, first[edge.v] + tie.v, tie.S_v_u, tie.covariance)
    if rest:
        factors = np.array([e.scores.get("variance_factor", 1.0) for e in rest])
        factors[[not e.accepted for e in rest]] *= _UNTRUSTED
        stiff = replace(weights.weights, bending=0.0)  # the nodes deform instead
        information = np.concatenate([information, information_of(rest, metric, stiff) / factors[:, None, None]])
    fixed = np.zeros(pieces.count, bool)
    fixed[[first[c] for c in first if components[c] == c]] = True
    u, v = np.array(ends).T
    return GraphProblem.build(u, v, stack(between), information, fixed)


def _whole(edge: Edge, nodes: Mapping[int, ChunkNodes]) -> Tie:
    """Return an edge as a tie of the nodes of its two frames; of the ends that face each other where it has no frames
    (its information is that of the edge)."""
    u, v = nodes[edge.u], nodes[edge.v]
    if edge.frames is not None:
        return Tie(u.nearest(edge.frames[0]), v.nearest(edge.frames[1]), edge.S_v_u, np.eye(7))
    return Tie(len(u.at) - 1, 0, edge.S_v_u, np.eye(7))


def _place_chunks(
    placed: Sim3,
    nodes: Mapping[int, ChunkNodes],
    graph: GraphResult,
    rigid: Collection[int],
) -> tuple[GraphResult, dict[int, Bend]]:
    """Place the chunks at the mean of their nodes, moved so that the first chunk of each component stays, and return
    their non-rigid corrections."""
    chunks = list(nodes)
    sizes = [len(nodes[c].at) for c in chunks]
    owner, weight = np.repeat(np.arange(len(chunks)), sizes), np.concatenate([nodes[c].count for c in chunks])
    S = stack([graph.S_graph_chunk[c] for c in chunks])
    x = (take(S, owner).inverse() @ placed).log()
    sums = np.stack([np.bincount(owner, weight * column) for column in x.T], axis=1)
    middle = S @ Sim3.exp(sums / np.bincount(owner, weight)[:, None])
    poses = unstack(middle, chunks)
    twists = np.split((take(middle, owner).inverse() @ placed).log(), np.cumsum(sizes)[:-1])
    bends = {
        c: Bend(nodes[c].at, x) for c, x in zip(chunks, twists, strict=True) if len(nodes[c].at) > 1 and c not in rigid
    }
    back = {c: graph.S_graph_chunk[c] @ poses[c].inverse() for c in poses if graph.components[c] == c}
    moved = {c: back[graph.components[c]] @ S for c, S in poses.items()}
    return replace(graph, S_graph_chunk=moved), bends


def inverses(covariance: Array) -> Array:
    """Return inverses of symmetric matrices, symmetric. Shape (E, D, D)."""
    inverse = np.linalg.inv(covariance)
    return np.asarray((inverse + np.swapaxes(inverse, 1, 2)) / 2.0)


def repeated(S: Sim3, count: int) -> Sim3:
    """Return the same similarity many times over."""
    return Sim3(np.full(count, float(S.scale)), np.tile(S.rotation, (count, 1, 1)), np.tile(S.translation, (count, 1)))
