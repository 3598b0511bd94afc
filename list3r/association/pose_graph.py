"""The graph of chunks: all edges together decide where every chunk lies (paper A.4).

Minimises sum w |log(S_v_u^-1 S_v_world S_world_u)|^2 by Levenberg-Marquardt (`graph_solver`). Loop edges are under a
Geman-McClure kernel that is tightened from convex (graduated non-convexity: Yang et al., "Graduated non-convexity for
robust spatial perception", 2020), so that a false loop is switched off rather than bending the map. The start is
always the chain of adjacent edges from each component's first chunk, so the result does not depend on the order in
which chunks arrived.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph_solver import GraphProblem
from list3r.memory.geometry import Sim3
from list3r.memory.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GraphSettings:
    """How the graph is weighted and solved."""

    alpha: float = 0.30
    """The paper's alpha of the edge weight."""
    sharpness: float = 6.0
    """The paper's exponent g of the edge weight."""
    least_weight: float = 0.05
    """Floor of the normalised weights, so that a weak chain still holds together."""
    lever_m: float = 1.0
    """Distance at which a rotation error counts as much as a translation error, metres; without metric scale half
    the median spread of the edges' points takes its place."""
    loop_residual: float = 0.05
    """Residual, in levers, at which a loop edge is trusted by one quarter (the scale of Geman-McClure)."""
    least_trust: float = 0.1
    """Trust under which a loop edge is rejected."""
    iterations: int = 30
    """Steps of the final solution; each stage before it takes a tenth."""


@dataclass(frozen=True)
class GraphResult:
    """Where the chunks are."""

    S_graph_chunk: dict[int, Sim3]
    """By chunk id; chunks of different components share no frame."""
    components: dict[int, int]
    """By chunk id: the smallest chunk id of its component."""
    edges: tuple[Edge, ...]
    """The edges as given, with `weight`, and loop edges that the rest contradicts no longer `accepted`."""
    residual: float
    """Weighted RMS of the edges, in levers."""


def optimize(
    chunk_ids: Sequence[int],
    edges: Sequence[Edge],
    initial: Mapping[int, Sim3],
    metric: bool,
    settings: GraphSettings | None = None,
) -> GraphResult:
    """Place all chunks. The first chunk of each component stays at `initial`, or at the origin where that is silent.

    Edges that geometry did not accept are passed through; those that an earlier call rejected are tried again.
    """
    chosen = settings or GraphSettings()
    ids = sorted(chunk_ids)
    known = set(ids)
    used = [k for k, e in enumerate(edges) if e.u in known and e.v in known and (e.accepted or "trust" in e.scores)]
    active = [edges[k] for k in used]
    component = _components(ids, active)
    start = _chain(ids, active, component, initial)
    out = list(edges)
    if not active:
        return GraphResult(start, component, tuple(out), 0.0)
    weight = edge_weights(np.array([e.confidence for e in active]), chosen)
    problem = GraphProblem.build(ids, active, component, weight, metric, _lever(active, metric, chosen))
    poses, trust = _anneal(problem, start, np.array([e.kind != "adjacent" for e in active]), chosen)
    norms = problem.norms(poses)
    for k, edge, w, t, r in zip(used, active, weight, trust, norms, strict=True):
        out[k] = _judge(edge, float(w), float(t), float(r), chosen)
    total = weight * trust
    placed = {chunk: poses[k] for k, chunk in enumerate(ids)}
    return GraphResult(placed, component, tuple(out), float(np.sqrt((total * norms**2).sum() / total.sum())))


def edge_weights(confidence: Array, settings: GraphSettings) -> Array:
    """Weights of edges from their confidence m (paper A.4), the strongest edge 1. Shape (E,).

    With the paper's constants all raw weights are below 3.3e-4, so only their ratios mean something.
    """
    grown = np.log1p(settings.alpha * np.clip(confidence, 1e-3, 1.0))
    u = grown / (1.0 + grown)
    raw = u**settings.sharpness / (u**settings.sharpness + (1.0 - u) ** settings.sharpness)
    return np.asarray(np.maximum(raw / raw.max(), settings.least_weight))


def _components(ids: Sequence[int], edges: Sequence[Edge]) -> dict[int, int]:
    """The smallest chunk id that each chunk is connected to."""
    neighbours = _neighbours(edges)
    component: dict[int, int] = {}
    for root in ids:
        queue = deque([root] if root not in component else [])
        while queue:
            chunk = queue.popleft()
            if chunk not in component:
                component[chunk] = root
                queue.extend(other for other, _ in neighbours.get(chunk, []))
    return component


def _chain(
    ids: Sequence[int], edges: Sequence[Edge], component: Mapping[int, int], initial: Mapping[int, Sim3]
) -> dict[int, Sim3]:
    """Poses along a spanning tree that prefers adjacent edges, then confident ones (Prim's algorithm, few edges)."""
    neighbours = _neighbours(edges)
    placed: dict[int, Sim3] = {}
    for root in ids:
        if component[root] != root:
            continue
        placed[root] = initial.get(root, Sim3.identity())
        queue = deque([root])
        waiting: list[Edge] = []
        while queue or waiting:
            while queue:
                chunk = queue.popleft()
                for other, edge in neighbours.get(chunk, []):
                    if other in placed:
                        continue
                    if edge.kind != "adjacent":
                        waiting.append(edge)
                        continue
                    placed[other] = _across(placed[chunk], edge, chunk)
                    queue.append(other)
            waiting = [e for e in waiting if (e.u in placed) != (e.v in placed)]
            if waiting:
                best = max(waiting, key=lambda e: (e.confidence, -e.u, -e.v))
                here, there = (best.u, best.v) if best.u in placed else (best.v, best.u)
                placed[there] = _across(placed[here], best, here)
                queue.append(there)
    return placed


def _across(S_world_here: Sim3, edge: Edge, here: int) -> Sim3:
    """Pose of the chunk at the other end of an edge."""
    S_here_there = edge.S_v_u.inverse() if here == edge.u else edge.S_v_u
    return S_world_here @ S_here_there


def _neighbours(edges: Sequence[Edge]) -> dict[int, list[tuple[int, Edge]]]:
    out: dict[int, list[tuple[int, Edge]]] = {}
    for edge in sorted(edges, key=lambda e: (e.u, e.v, e.kind)):
        out.setdefault(edge.u, []).append((edge.v, edge))
        out.setdefault(edge.v, []).append((edge.u, edge))
    return out


def _lever(edges: Sequence[Edge], metric: bool, settings: GraphSettings) -> float:
    spreads = [e.scores["spread"] for e in edges if "spread" in e.scores]
    return settings.lever_m if metric or not spreads else max(0.5 * float(np.median(spreads)), 1e-9)


def _anneal(
    problem: GraphProblem, start: Mapping[int, Sim3], loop: NDArray[np.bool_], settings: GraphSettings
) -> tuple[list[Sim3], Array]:
    """Solve with the kernel tightened step by step. Returns poses in order of chunk id, and the trust in each edge."""
    poses, trust = problem.stack(start), np.ones(len(loop))
    if loop.any():
        scale = settings.loop_residual**2
        mu = max(2.0 * float((problem.norms(poses)[loop] ** 2).max()) / scale, 1.0)
        while True:
            poses = problem.solve(poses, trust, max(3, settings.iterations // 10))
            squares = problem.norms(poses)[loop] ** 2
            trust[loop] = (mu * scale / (squares + mu * scale)) ** 2
            if mu == 1.0:
                break
            mu = max(1.0, mu / 1.4)
    return problem.unstack(problem.solve(poses, trust, settings.iterations)), trust


def _judge(edge: Edge, weight: float, trust: float, residual: float, settings: GraphSettings) -> Edge:
    scores = {**edge.scores, "trust": trust, "graph_residual": residual}
    if edge.kind == "adjacent" or trust >= settings.least_trust:
        return replace(edge, weight=weight * trust, accepted=True, scores=scores)
    reason = f"the rest of the graph contradicts it by {residual:.3f} (geometry alone: {edge.reason})"
    already = "trust" in edge.scores and not edge.accepted
    return replace(edge, weight=0.0, accepted=False, scores=scores, reason=edge.reason if already else reason)
