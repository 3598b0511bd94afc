"""The graph of chunks: all edges together determine the pose of every chunk (paper A.4).

Minimises the sum of e^T W e, e = log(S_v_u^-1 S_v_world S_world_u), by Levenberg-Marquardt (`solver`), W from the
covariance of each edge and the deformation of chunks (`edge_information`); false loops are switched off (`edge_trust`),
and every chunk gets a covariance (`marginals`). The start is always the chain of adjacent edges from each component's
first chunk, so the result does not depend on the order in which chunks arrived.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet

from list3r.association.graph.edge_information import WeightSettings, information_of, own_shapes
from list3r.association.graph.edge_trust import Tree, TrustedGraph, TrustSettings, solve_with_trust
from list3r.association.graph.marginals import widening
from list3r.association.graph.solver import GraphProblem, adjoint, unstack
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3, stack, take
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]

_ALONE = " (geometry alone: "
"""Between the graph's reason to reject an edge and the edge's earlier reason."""


@dataclass(frozen=True)
class GraphSettings:
    """How the graph is weighted and solved."""

    robust: bool = True
    """Edges that the rest contradicts are switched off."""
    weights: WeightSettings = field(default_factory=WeightSettings)
    trust: TrustSettings = field(default_factory=TrustSettings)
    least_weight: float = 1e-5
    """Loops of less information than this share of the strongest edge's are dropped (deviations 300 times larger)."""
    fits_quantile: float = 0.95
    """A new chunk fits where all its edges' errors are inside this quantile of their stated ones; otherwise its
    neighbourhood moves."""
    most_moved: int = 150
    """Chunks near a new loop that move before the end of the session, when the closed loop is longer than this."""


@dataclass(frozen=True)
class GraphResult:
    """The poses of the chunks."""

    S_graph_chunk: Mapping[int, Sim3]
    """By chunk id; chunks of different components share no frame."""
    components: Mapping[int, int]
    """By chunk id: the smallest chunk id of its component."""
    edges: tuple[Edge, ...]
    """The edges as given, with `weight`, and loop edges that the rest contradicts no longer `accepted`."""
    residual: float
    """RMS of the inlier edges' errors in their own standard deviations, 1 where errors are as stated."""
    covariances: Mapping[int, Array]
    """By chunk id, of x in S_true = S_graph_chunk exp(x), x = (rho, omega, sigma), relative to the first chunk of the
    component, which has 0. Shape (7, 7) each."""


def optimize(
    chunk_ids: Sequence[int],
    edges: Sequence[Edge],
    initial: Mapping[int, Sim3],
    metric: bool,
    settings: GraphSettings | None = None,
) -> GraphResult:
    """Place all chunks. The first chunk of each component stays at `initial`, or at the origin if it is not in it.

    Edges that geometry did not accept are passed through; those that an earlier call rejected are tried again. Raises
    `DegenerateError` for an edge with a number that is not finite.
    """
    chosen = settings or GraphSettings()
    ids = sorted(chunk_ids)
    known = set(ids)
    used = [k for k, e in enumerate(edges) if e.u in known and e.v in known and (e.accepted or "trust" in e.scores)]
    used.sort(key=lambda k: (edges[k].u, edges[k].v, edges[k].kind, edges[k].frames or (-1, -1), k))
    active = [edges[k] for k in used]
    check(active)
    component = _components(ids, active)
    out = list(edges)
    weights = information_of(active, metric, chosen.weights)
    weak = _weak(active, ids, weights, chosen)
    weights = np.delete(weights, weak, axis=0)
    for n in reversed(weak):
        scores = {**active[n].scores, "trust": 0.0}
        reason = f"too uncertain compared with the other edges{_ALONE}{active[n].reason})"
        reason = active[n].reason if "trust" in active[n].scores and not active[n].accepted else reason
        out[used[n]] = replace(active[n], weight=0.0, accepted=False, scores=scores, reason=reason)
        del used[n], active[n]
    start, tree = _chain(ids, active, component, initial)
    if not active:
        return GraphResult(start, component, tuple(edges), 0.0, dict.fromkeys(ids, np.zeros((7, 7))))
    row = {chunk: k for k, chunk in enumerate(ids)}
    problem = problem_of(active, row, np.array([component[chunk] == chunk for chunk in ids]), weights)
    loop = np.array([e.kind != "adjacent" for e in active])
    found = solve_with_trust(problem, stack([start[k] for k in ids]), tree, loop, chosen.robust, chosen.trust)
    strength = _strengths(problem.information / found.factors[loop.astype(np.int64), None, None])
    for n, k in enumerate(used):
        out[k] = _judged(edges[k], float(strength[n]), float(found.squares[n]), found, n)
    count = max(float(found.trust @ found.marginals.redundancy), 1e-9)
    residual = float(np.sqrt(found.trust @ found.squares / max(count, 1.0)))
    own = own_shapes(active, row, len(ids), chosen.weights)
    first = np.array([row[component[chunk]] for chunk in ids])
    covariances = dict(zip(ids, _covariances(found, own, first), strict=True))
    return GraphResult(unstack(found.poses, ids), component, tuple(out), residual, covariances)


def problem_of(
    active: Sequence[Edge], row: Mapping[int, int], fixed: NDArray[np.bool_], weights: Array
) -> GraphProblem:
    """Return the graph of some edges with information `weights` (E, D, D); `row` numbers the chunks."""
    u, v = np.array([row[e.u] for e in active]), np.array([row[e.v] for e in active])
    return GraphProblem.build(u, v, stack([e.S_v_u for e in active]), weights, fixed)


def check(edges: Sequence[Edge]) -> None:
    """Raise `DegenerateError` that names an edge with a number that is not finite."""
    if not edges:
        return
    S = stack([e.S_v_u for e in edges])
    confidence = np.array([e.confidence for e in edges])
    each = [S.scale[:, None], S.rotation.reshape(-1, 9), S.translation, confidence[:, None]]
    finite = np.asarray(np.isfinite(np.hstack(each)).all(axis=1))
    stated = [k for k, e in enumerate(edges) if e.covariance is not None]
    if stated:
        finite[stated] &= np.isfinite(np.array([edges[k].covariance for k in stated])).all(axis=(1, 2))
    if not finite.all():
        e = edges[int(np.argmin(finite))]
        raise DegenerateError(f"the edge between chunks {e.u} and {e.v} ({e.kind}) has a value that is not finite")


def _covariances(found: TrustedGraph, own: Array, first: NDArray[np.int64]) -> Array:
    """Return the stated covariance of each chunk: its pose in the graph, its own deformation, and that of the first
    chunk, `first` (K,), which moves all others. Shape (K, 7, 7)."""
    size = found.marginals.covariance.shape[1]
    own = own * found.factors[0]
    from_first = adjoint(found.poses.inverse() @ take(found.poses, first))
    out = own + from_first @ own[first] @ np.swapaxes(from_first, 1, 2)
    out[:, size:], out[:, :, size:] = 0.0, 0.0
    out[:, :size, :size] += found.marginals.covariance
    out[first] = 0.0
    return np.asarray(out * widening(float(found.freedom.sum() - found.freedom.min())))


def _strengths(information: Array) -> Array:
    """Return each edge's information on rotation (which has no unit), geometric mean, the strongest 1. Shape (E,)."""
    size = np.cbrt(np.maximum(np.linalg.det(information[:, 3:6, 3:6]), 0.0))
    return np.asarray(size / max(float(size.max()), 1e-300))


def _weak(edges: Sequence[Edge], ids: Sequence[int], weights: Array, settings: GraphSettings) -> list[int]:
    """Return numbers of the loops of negligible information; none where the graph would fall apart without them."""
    if not any(e.kind != "adjacent" for e in edges):
        return []
    strength = _strengths(weights)
    weak = [k for k, e in enumerate(edges) if e.kind != "adjacent" and strength[k] < settings.least_weight]
    gone = set(weak)
    rest = [e for k, e in enumerate(edges) if k not in gone]
    return weak if not weak or _components(ids, rest) == _components(ids, edges) else []


def _components(ids: Sequence[int], edges: Sequence[Edge]) -> dict[int, int]:
    """Return the first chunk id of each chunk's connected component, by chunk id. Edges join chunks of `ids`."""
    joined: DisjointSet[int] = DisjointSet(ids)
    for edge in edges:
        joined.merge(edge.u, edge.v)
    first: dict[int, int] = {}
    return {chunk: first.setdefault(joined[chunk], chunk) for chunk in ids}


class _SpanningTree:
    """Poses along a spanning tree that prefers adjacent edges, then confident ones (Prim's algorithm, few edges)."""

    def __init__(self, ids: Sequence[int], edges: Sequence[Edge]) -> None:
        self.placed: dict[int, Sim3] = {}
        self._edges = edges
        self._neighbours = _neighbours(edges)
        self._row = {chunk: k for k, chunk in enumerate(ids)}
        self._parent, self._by = np.arange(len(ids)), np.full(len(ids), -1)
        self._order: list[int] = []

    def grow(self, root: int, S_graph_root: Sim3) -> None:
        """Place the component of a chunk."""
        self.placed[root] = S_graph_root
        self._order.append(self._row[root])
        waiting = self._along_adjacent(root)
        while waiting := [k for k in waiting if self._leads_on(self._edges[k])]:
            best = max(waiting, key=lambda k: (self._edges[k].confidence, -self._edges[k].u, -self._edges[k].v))
            here, there = self._edges[best].u, self._edges[best].v
            here, there = (here, there) if here in self.placed else (there, here)
            self._place(there, here, best)
            waiting += self._along_adjacent(there)

    def tree(self) -> Tree:
        """Return the tree of all components grown so far."""
        return Tree(self._parent, self._by, np.array(self._order, np.int64))

    def _along_adjacent(self, start: int) -> list[int]:
        """Place the chunks that adjacent edges reach from a chunk. Returns the other edges met on the way."""
        queue, others = deque([start]), []
        while queue:
            chunk = queue.popleft()
            fresh = ((other, k) for other, k in self._neighbours.get(chunk, []) if other not in self.placed)
            for other, k in fresh:
                if self._edges[k].kind != "adjacent":
                    others.append(k)
                else:
                    self._place(other, chunk, k)
                    queue.append(other)
        return others

    def _leads_on(self, edge: Edge) -> bool:
        return (edge.u in self.placed) != (edge.v in self.placed)

    def _place(self, there: int, here: int, k: int) -> None:
        self.placed[there] = across(self.placed[here], self._edges[k], here)
        self._parent[self._row[there]], self._by[self._row[there]] = self._row[here], k
        self._order.append(self._row[there])


def _chain(
    ids: Sequence[int], edges: Sequence[Edge], component: Mapping[int, int], initial: Mapping[int, Sim3]
) -> tuple[dict[int, Sim3], Tree]:
    """Chain poses along a spanning tree from the first chunk of each component."""
    growing = _SpanningTree(ids, edges)
    for root in ids:
        if component[root] == root:
            growing.grow(root, initial.get(root, Sim3.identity()))
    return growing.placed, growing.tree()


def chain_poses(ids: Sequence[int], edges: Sequence[Edge]) -> tuple[dict[int, Sim3], dict[int, int]]:
    """Return poses of chunks along a spanning tree of edges, from the first of each component, and the components."""
    component = _components(ids, edges)
    return _chain(ids, edges, component, {})[0], component


def across(S_world_here: Sim3, edge: Edge, here: int) -> Sim3:
    """Return the pose of the chunk at the other end of an edge."""
    S_here_there = edge.S_v_u.inverse() if here == edge.u else edge.S_v_u
    return S_world_here @ S_here_there


def _neighbours(edges: Sequence[Edge]) -> dict[int, list[tuple[int, int]]]:
    """Return the neighbours by chunk id: (other chunk, number of the edge)."""
    out: dict[int, list[tuple[int, int]]] = {}
    for k, edge in enumerate(edges):
        out.setdefault(edge.u, []).append((edge.v, k))
        out.setdefault(edge.v, []).append((edge.u, k))
    return out


def _judged(edge: Edge, strength: float, square: float, found: TrustedGraph, n: int) -> Edge:
    """Return the edge with its weight in the graph, and whether it is an inlier."""
    deviations = deviations_of(square)
    trusted = bool(found.trust[n] > 0.5)
    trust = float((found.limit[n] / (square + found.limit[n])) ** 2)
    factor = float(found.factors[int(edge.kind != "adjacent")])
    scores = {**edge.scores, "trust": trust, "graph_residual": deviations, "variance_factor": factor}
    if trusted:
        reason = edge.reason.partition(_ALONE)[2].removesuffix(")") or edge.reason
        return replace(edge, weight=strength, accepted=True, scores=scores, reason=reason)
    already = "trust" in edge.scores and not edge.accepted
    reason = contradicted(edge, deviations)
    return replace(edge, weight=0.0, accepted=False, scores=scores, reason=edge.reason if already else reason)


def deviations_of(square: float) -> float:
    """Return a squared Mahalanobis distance as deviations along one axis of three."""
    return float(np.sqrt(square / 3.0))


def contradicted(edge: Edge, deviations: float) -> str:
    """Return why a loop is rejected."""
    return f"the rest of the graph contradicts it by {deviations:.1f} deviations{_ALONE}{edge.reason})"
