"""Place chunks of structure from motion a second time, for their instances: by depth instead of camera paths.

A path of a few decimetres determines the scale of a chunk less well than its depth does (research/association 0044).
Neighbours are tied by the cameras' directions and the depth ratios of shared frames, loops as they are. The cameras
keep the poses of their own graph; the difference is part of each chunk's non-rigid correction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.chunk_nodes import ChunkNodes, NodeSettings, ties_of
from list3r.association.graph.edge_information import about
from list3r.association.graph.node_graph import inverses, pieces_of, repeated
from list3r.association.graph.pose_graph import GraphResult
from list3r.association.graph.sampled_chunks import SampledChunks
from list3r.association.graph.solver import GraphProblem, unstack
from list3r.memory.core.bends import Bend
from list3r.memory.core.geometry import Sim3, stack
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]

_STEPS = 30


@dataclass(frozen=True)
class SurfaceSettings:
    """How far a chunk's depth deforms between the supports of two edges."""

    shift: float = 0.01
    """Standard deviation, as a share of the viewing distance,"""
    turn_rad: float = 0.006
    """of directions,"""
    scale: float = 0.02
    """and of the logarithm of scale."""
    loop_scale: float = 0.015
    """Error of the log scale of a loop by depth; its edge states more, for the cameras."""


def place_by_surfaces(
    chunks: SampledChunks,
    graph: GraphResult,
    bends: Mapping[int, Bend],
    settings: SurfaceSettings | None = None,
) -> tuple[GraphResult, dict[int, Bend]]:
    """Return the graph with its chunks placed by surfaces, and corrections that keep the cameras in place.

    The first chunk of each component stays; the cameras of a component move together, by the mean motion of its chunks.
    """
    s = settings or SurfaceSettings()
    known = graph.S_graph_chunk
    ids = sorted(known)
    believed = [e for e in graph.edges if e.accepted and e.u in known and e.v in known]
    if not believed:
        return graph, dict(bends)
    pieces = pieces_of(chunks, ids, believed, set(ids), NodeSettings())
    relations = {(e.u, e.v): r for e, r in pieces.relations}
    ties: list[tuple[Edge, Sim3, Array]] = []
    for edge in believed:
        u, v = pieces.nodes[edge.u], pieces.nodes[edge.v]
        relation = relations.get((edge.u, edge.v)) if edge.kind == "adjacent" else None
        mean = [] if relation is None else ties_of(relation, edge, u, v, NodeSettings())
        if mean:
            ties.append((edge, mean[0].S_v_u, mean[0].covariance + _bending(u, s)))
        elif edge.covariance is not None:
            ties.append((edge, edge.S_v_u, _sharper(edge, s) + _bending(u, s)))
    row = {chunk: k for k, chunk in enumerate(ids)}
    trust = np.array([max(float(e.scores.get("trust", 1.0)), 1e-6) for e, _, _ in ties])
    problem = GraphProblem.build(
        np.array([row[e.u] for e, _, _ in ties], np.int64),
        np.array([row[e.v] for e, _, _ in ties], np.int64),
        stack([S for _, S, _ in ties]),
        inverses(np.array([c for _, _, c in ties])) * trust[:, None, None],
        np.array([graph.components[chunk] == chunk for chunk in ids]),
    )
    placed = unstack(problem.solve(stack([known[k] for k in ids]), np.ones(len(ties)), _STEPS), ids)
    return replace(graph, S_graph_chunk=placed), _camera_corrections(placed, graph, bends)


def _bending(nodes: ChunkNodes, s: SurfaceSettings) -> Array:
    """Return the covariance of a chunk's deformation about the centre of its points. Shape (7, 7)."""
    back = about(nodes.center[:1])[0]
    deviation = np.repeat([s.shift * float(nodes.reach[0]), s.turn_rad, s.scale], [3, 3, 1])
    return np.asarray(back @ np.diag(deviation**2) @ back.T)


def _sharper(edge: Edge, s: SurfaceSettings) -> Array:
    """Return the covariance of an edge, for a loop with the scale error of depth. Shape (7, 7)."""
    assert edge.covariance is not None
    factor = np.ones(7)
    if edge.kind == "loop":
        factor[6] = min(1.0, s.loop_scale / max(float(np.sqrt(edge.covariance[6, 6])), 1e-12))
    return np.asarray(edge.covariance * np.outer(factor, factor))


def _camera_corrections(placed: Mapping[int, Sim3], graph: GraphResult, bends: Mapping[int, Bend]) -> dict[int, Bend]:
    """Return corrections that take each frame to its pose in the cameras' graph, after the chunks' mean motion."""
    out: dict[int, Bend] = {}
    for component in sorted(set(graph.components.values())):
        mine = [k for k in sorted(placed) if graph.components[k] == component]
        moved = [(placed[k] @ graph.S_graph_chunk[k].inverse()).log() for k in mine]
        together = Sim3.exp(np.mean(moved, axis=0))
        for k in mine:
            bend = bends.get(k, Bend.none())
            count = len(bend.frames)
            there = placed[k].inverse() @ together @ graph.S_graph_chunk[k]
            out[k] = Bend(bend.frames, (repeated(there, count) @ Sim3.exp(np.array(bend.twists))).log())
    return out
