"""The graph of chunks: all edges together decide where every chunk lies (paper A.4).

Minimises the sum of e^T W e, e = log(S_v_u^-1 S_v_world S_world_u), by Levenberg-Marquardt (`graph_solver`), W from
the covariance of each edge and the bending of chunks (`edge_information`); false loops are switched off (`loop_trust`),
and every chunk gets a covariance (`marginals`). The start is always the chain of adjacent edges from each component's
first chunk, so the result does not depend on the order in which chunks arrived.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from list3r.association.edge_information import WeightSettings, information, own_shapes, plain_information
from list3r.association.graph_solver import GraphProblem, adjoint, stack, take, unstack
from list3r.association.loop_trust import Believed, Tree, TrustSettings, judge
from list3r.association.marginals import widening
from list3r.memory.errors import DegenerateError
from list3r.memory.geometry import Sim3
from list3r.memory.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GraphSettings:
    """How the graph is weighted and solved. Without `weighted` and `robust`: plain least squares, as VGGT-Long."""

    weighted: bool = True
    """Edges count by their information; else all the same."""
    robust: bool = True
    """Edges that the rest contradicts are switched off."""
    weights: WeightSettings = field(default_factory=WeightSettings)
    trust: TrustSettings = field(default_factory=TrustSettings)
    least_weight: float = 1e-5
    """Loops of less information than this share of the strongest edge's are dropped (deviations 300 times larger)."""


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
    """RMS of the trusted edges' errors in their own standard deviations, 1 where they keep what they state."""
    covariances: dict[int, Array]
    """By chunk id, of x in S_true = S_graph_chunk exp(x), x = (rho, omega, sigma), relative to the first chunk of the
    component, which has 0. Shape (7, 7) each."""


def optimize(
    chunk_ids: Sequence[int],
    edges: Sequence[Edge],
    initial: Mapping[int, Sim3],
    metric: bool,
    settings: GraphSettings | None = None,
) -> GraphResult:
    """Place all chunks. The first chunk of each component stays at `initial`, or at the origin where that is silent.

    Edges that geometry did not accept are passed through; those that an earlier call rejected are tried again. Raises
    `DegenerateError` for an edge that holds a number that is not finite.
    """
    chosen = settings or GraphSettings()
    ids = sorted(chunk_ids)
    known = set(ids)
    used = [k for k, e in enumerate(edges) if e.u in known and e.v in known and (e.accepted or "trust" in e.scores)]
    used.sort(key=lambda k: (edges[k].u, edges[k].v, edges[k].kind, edges[k].frames or (-1, -1), k))
    active = [edges[k] for k in used]
    for edge in active:
        _check(edge)
    component = _components(ids, active)
    out = list(edges)
    for n in sorted(_weak(active, ids, metric, chosen), reverse=True):
        scores = {**active[n].scores, "trust": 0.0}
        reason = f"too uncertain beside the other edges (geometry alone: {active[n].reason})"
        reason = active[n].reason if "trust" in active[n].scores and not active[n].accepted else reason
        out[used[n]] = replace(active[n], weight=0.0, accepted=False, scores=scores, reason=reason)
        del used[n], active[n]
    start, tree = _chain(ids, active, component, initial)
    if not active:
        return GraphResult(start, component, tuple(edges), 0.0, dict.fromkeys(ids, np.zeros((7, 7))))
    row = {chunk: k for k, chunk in enumerate(ids)}
    problem = _problem(active, row, np.array([component[chunk] == chunk for chunk in ids]), metric, chosen)
    loop = np.array([e.kind != "adjacent" for e in active])
    found = judge(problem, stack([start[k] for k in ids]), tree, loop, chosen.robust, chosen.trust)
    strength = _strengths(problem.information / found.factors[loop.astype(np.int64), None, None])
    for n, k in enumerate(used):
        out[k] = _judged(edges[k], float(strength[n]), float(found.squares[n]), found, n)
    count = max(float(found.trust @ found.marginals.redundancy), 1e-9)
    residual = float(np.sqrt(found.trust @ found.squares / max(count, 1.0)))
    own = own_shapes(active, row, len(ids), chosen.weights)
    first = np.array([row[component[chunk]] for chunk in ids])
    covariances = dict(zip(ids, _covariances(found, own, first), strict=True))
    return GraphResult(unstack(found.poses, ids), component, tuple(out), residual, covariances)


def extend(
    new: int,
    chunk_ids: Sequence[int],
    edges: Sequence[Edge],
    placed: GraphResult,
    metric: bool,
    settings: GraphSettings | None = None,
) -> GraphResult:
    """Place one more chunk in a graph whose other chunks lie as `placed` says (as `optimize` or `extend` put them).

    A chunk that hangs on one edge is chained: that is the optimum. One with loops that agree with the map is fitted to
    it alone; if its edges do not fit then, all chunks move by a Gauss-Newton step; if it joins components, all are
    solved from the beginning. Only the edges of the new chunk are judged, and covariances of the others stay:
    `optimize` at the end of a session judges all.
    """
    chosen = settings or GraphSettings()
    mine = [k for k, e in enumerate(edges) if new in (e.u, e.v) and e.accepted]
    others = {e.u if e.v == new else e.v for e in (edges[k] for k in mine)}
    if not mine:
        return _with(placed, new, placed.S_graph_chunk.get(new, Sim3.identity()), new, edges, np.zeros((7, 7)))
    if len({placed.components[k] for k in others}) > 1:
        return optimize(chunk_ids, edges, placed.S_graph_chunk, metric, chosen)
    active = [edges[k] for k in mine]
    for edge in active:
        _check(edge)
    first = min(range(len(active)), key=lambda n: (active[n].kind != "adjacent", -active[n].confidence))
    here = active[first].u if active[first].v == new else active[first].v
    start = _across(placed.S_graph_chunk[here], active[first], here)
    factors = _factors(edges)
    ids = sorted({new, *others})
    row = {chunk: k for k, chunk in enumerate(ids)}
    poses = stack([start if k == new else placed.S_graph_chunk[k] for k in ids])
    problem = _problem(active, row, np.array([k != new for k in ids]), metric, chosen)
    loop = np.array([e.kind != "adjacent" for e in active])
    problem = problem.scaled(factors[loop.astype(np.int64)])
    if len(active) > 1:
        poses = problem.solve(poses, np.ones(len(active)), 5)
    squares = problem.squares(poses)
    covariance = _hanging(placed.covariances[here], active[first], here, problem.information[first])
    if len(active) > 1 and float(squares.max()) > chi2.ppf(0.95, problem.size):
        return _resolved(new, chunk_ids, edges, mine, placed, start, covariance, metric, chosen)
    out = list(edges)
    for n, k in enumerate(mine):
        scores = {**edges[k].scores, "graph_residual": float(np.sqrt(squares[n] / 3.0))}
        scores |= {"trust": 1.0, "variance_factor": float(factors[int(loop[n])])}
        out[k] = replace(edges[k], scores=scores)
    return _with(placed, new, unstack(poses, ids)[new], placed.components[here], out, covariance)


def _resolved(
    new: int,
    chunk_ids: Sequence[int],
    edges: Sequence[Edge],
    mine: Sequence[int],
    placed: GraphResult,
    start: Sim3,
    covariance: Array,
    metric: bool,
    settings: GraphSettings,
) -> GraphResult:
    """All chunks moved by a step; edges are believed as before, but the new chunk's loops are judged."""
    ids = sorted(chunk_ids)
    known = set(ids)
    used = [k for k, e in enumerate(edges) if e.accepted and e.u in known and e.v in known]
    active = [edges[k] for k in used]
    row = {chunk: k for k, chunk in enumerate(ids)}
    component = {**placed.components, new: placed.components[_other(edges[mine[0]], new)]}
    loop = np.array([e.kind != "adjacent" for e in active])
    problem = _problem(active, row, np.array([component[k] == k for k in ids]), metric, settings)
    problem = problem.scaled(_factors(edges)[loop.astype(np.int64)])
    poses = stack([start if k == new else placed.S_graph_chunk[k] for k in ids])
    fresh = np.isin(used, mine) & loop & settings.robust
    limit = float(chi2.ppf(settings.trust.loop_quantile, problem.size))
    trust = np.ones(len(used))
    for _ in range(3):
        poses = problem.solve(poses, trust, 1)
        squares = problem.squares(poses)
        after = np.where(fresh & (squares > limit), 1e-9, 1.0)
        if (after == trust).all():
            break
        trust = after
    out = list(edges)
    for n in np.flatnonzero(np.isin(used, mine)):
        edge, deviations = active[n], float(np.sqrt(squares[n] / 3.0))
        scores = {**edge.scores, "graph_residual": deviations, "trust": (limit / (float(squares[n]) + limit)) ** 2}
        believed = bool(trust[n] == 1.0)
        reason = edge.reason if believed else _contradicted(edge, deviations)
        out[used[n]] = replace(edge, accepted=believed, scores=scores, reason=reason)
    placed_all = GraphResult(unstack(poses, ids), component, tuple(out), placed.residual, dict(placed.covariances))
    return _with(placed_all, new, placed_all.S_graph_chunk[new], component[new], out, covariance)


def _other(edge: Edge, chunk: int) -> int:
    return edge.u if edge.v == chunk else edge.v


def _with(
    placed: GraphResult, new: int, S: Sim3, component: int, edges: Sequence[Edge], covariance: Array
) -> GraphResult:
    return GraphResult(
        {**placed.S_graph_chunk, new: S},
        {**placed.components, new: component},
        tuple(edges),
        placed.residual,
        {**placed.covariances, new: covariance},
    )


def _hanging(of_here: Array, edge: Edge, here: int, information: Array) -> Array:
    """Covariance of a chunk at the other end of an edge from a chunk with covariance `of_here`. Shape (7, 7)."""
    own = np.zeros((7, 7))
    own[: len(information), : len(information)] = np.linalg.inv(information)
    if here == edge.u:
        moved = adjoint(edge.S_v_u)
        return np.asarray(moved @ (of_here + own) @ moved.T)
    moved = adjoint(edge.S_v_u.inverse())
    return np.asarray(moved @ of_here @ moved.T + own)


def _factors(edges: Sequence[Edge]) -> Array:
    """Variance factors of adjacent and of loop edges that the last full solution found. Shape (2,)."""
    out = np.ones(2)
    for kind in range(2):
        known = (e.scores["variance_factor"] for e in edges if "variance_factor" in e.scores and _kind(e) == kind)
        out[kind] = next(known, 1.0)
    return out


def _kind(edge: Edge) -> int:
    return int(edge.kind != "adjacent")


def _problem(
    active: Sequence[Edge], row: Mapping[int, int], fixed: NDArray[np.bool_], metric: bool, settings: GraphSettings
) -> GraphProblem:
    of_edge = information if settings.weighted else plain_information
    return GraphProblem.build(
        np.array([row[e.u] for e in active]),
        np.array([row[e.v] for e in active]),
        stack([e.S_v_u for e in active]),
        of_edge(active, metric, settings.weights),
        fixed,
    )


def _check(edge: Edge) -> None:
    numbers = [edge.S_v_u.as_matrix(), np.array(edge.confidence)]
    if edge.covariance is not None:
        numbers.append(edge.covariance)
    if not all(np.isfinite(n).all() for n in numbers):
        raise DegenerateError(f"the edge between chunks {edge.u} and {edge.v} ({edge.kind}) holds a number not finite")


def _covariances(found: Believed, own: Array, first: NDArray[np.int64]) -> Array:
    """What is stated of each chunk: its place in the graph, its own bending, and that of the first chunk, `first` (K,),
    which moves all others. Shape (K, 7, 7)."""
    size = found.marginals.covariance.shape[1]
    own = own * found.factors[0]
    from_first = adjoint(found.poses.inverse() @ take(found.poses, first))
    out = own + from_first @ own[first] @ np.swapaxes(from_first, 1, 2)
    out[:, size:], out[:, :, size:] = 0.0, 0.0
    out[:, :size, :size] += found.marginals.covariance
    out[first] = 0.0
    return np.asarray(out * widening(float(found.freedom.sum() - found.freedom.min())))


def _strengths(information: Array) -> Array:
    """Information of each edge on the turn (which has no unit), by geometric mean, the strongest 1. Shape (E,)."""
    size = np.cbrt(np.maximum(np.linalg.det(information[:, 3:6, 3:6]), 0.0))
    return np.asarray(size / max(float(size.max()), 1e-300))


def _weak(edges: Sequence[Edge], ids: Sequence[int], metric: bool, settings: GraphSettings) -> list[int]:
    """Numbers of the loops that say next to nothing; none where the graph would fall apart without them."""
    if not settings.weighted or not any(_kind(e) for e in edges):
        return []
    strength = _strengths(information(edges, metric, settings.weights))
    weak = [k for k, e in enumerate(edges) if _kind(e) and strength[k] < settings.least_weight]
    rest = [e for k, e in enumerate(edges) if k not in set(weak)]
    return weak if _components(ids, rest) == _components(ids, edges) else []


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
) -> tuple[dict[int, Sim3], Tree]:
    """Poses along a spanning tree that prefers adjacent edges, then confident ones (Prim's algorithm, few edges)."""
    neighbours = _neighbours(edges)
    row = {chunk: k for k, chunk in enumerate(ids)}
    parent, by, order = np.arange(len(ids)), np.full(len(ids), -1), []
    placed: dict[int, Sim3] = {}

    def place(there: int, here: int, k: int) -> None:
        placed[there] = _across(placed[here], edges[k], here)
        parent[row[there]], by[row[there]] = row[here], k
        order.append(row[there])

    for root in ids:
        if component[root] != root:
            continue
        placed[root] = initial.get(root, Sim3.identity())
        order.append(row[root])
        queue = deque([root])
        waiting: list[int] = []
        while queue or waiting:
            while queue:
                chunk = queue.popleft()
                for other, k in neighbours.get(chunk, []):
                    if other in placed:
                        continue
                    if edges[k].kind != "adjacent":
                        waiting.append(k)
                        continue
                    place(other, chunk, k)
                    queue.append(other)
            waiting = [k for k in waiting if (edges[k].u in placed) != (edges[k].v in placed)]
            if waiting:
                best = max(waiting, key=lambda k: (edges[k].confidence, -edges[k].u, -edges[k].v))
                here, there = (edges[best].u, edges[best].v)
                here, there = (here, there) if here in placed else (there, here)
                place(there, here, best)
                queue.append(there)
    return placed, Tree(parent, by, np.array(order, np.int64))


def _across(S_world_here: Sim3, edge: Edge, here: int) -> Sim3:
    """Pose of the chunk at the other end of an edge."""
    S_here_there = edge.S_v_u.inverse() if here == edge.u else edge.S_v_u
    return S_world_here @ S_here_there


def _neighbours(edges: Sequence[Edge]) -> dict[int, list[tuple[int, int]]]:
    """By chunk id: (other chunk, number of the edge)."""
    out: dict[int, list[tuple[int, int]]] = {}
    for k, edge in enumerate(edges):
        out.setdefault(edge.u, []).append((edge.v, k))
        out.setdefault(edge.v, []).append((edge.u, k))
    return out


def _judged(edge: Edge, strength: float, square: float, found: Believed, n: int) -> Edge:
    """The edge with its weight in the graph, and what the graph thinks of it."""
    deviations = float(np.sqrt(square / 3.0))
    trusted = bool(found.trust[n] > 0.5)
    trust = float((found.limit[n] / (square + found.limit[n])) ** 2)
    factor = float(found.factors[int(edge.kind != "adjacent")])
    scores = {**edge.scores, "trust": trust, "graph_residual": deviations, "variance_factor": factor}
    if trusted:
        return replace(edge, weight=strength, accepted=True, scores=scores)
    already = "trust" in edge.scores and not edge.accepted
    reason = _contradicted(edge, deviations)
    return replace(edge, weight=0.0, accepted=False, scores=scores, reason=edge.reason if already else reason)


def _contradicted(edge: Edge, deviations: float) -> str:
    return f"the rest of the graph contradicts it by {deviations:.1f} deviations (geometry alone: {edge.reason})"
