"""Add one chunk to a solved graph: chained, fitted, or with its neighbourhood re-optimized.

The result depends only on the stored chunks and edges, so an interrupted build that is resumed takes the same steps as
one that was not interrupted.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, dijkstra

from list3r.association.graph.edge_information import information_of
from list3r.association.graph.edge_trust import NO_TRUST
from list3r.association.graph.pose_graph import (
    GraphResult,
    GraphSettings,
    across,
    check,
    contradicted,
    deviations_of,
    optimize,
    problem_of,
)
from list3r.association.graph.solver import adjoint, unstack
from list3r.association.quantiles import chi2_quantile
from list3r.memory.core.geometry import Sim3, stack
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]
T = TypeVar("T")


def extend(
    new: int,
    chunk_ids: Sequence[int],
    edges: Sequence[Edge],
    placed: GraphResult,
    metric: bool,
    settings: GraphSettings | None = None,
) -> GraphResult:
    """Place one more chunk in a graph whose other chunks are at `placed` (from `optimize` or `extend`).

    A chunk with a single edge is chained: that is the optimum. One whose loops agree with the map is fitted to it
    alone; if its edges then do not fit, the chunks on the closed loops and those near them move by a Gauss-Newton
    step; if it joins components, the whole graph is solved again. Only the edges of the new chunk are judged, and
    covariances of the others stay: `optimize` at the end of a session judges all.
    """
    chosen = settings or GraphSettings()
    mine = _accepted_of(new, edges)
    others = {_other(edges[k], new) for k in mine}
    if not mine:
        return _with(placed, new, placed.S_graph_chunk.get(new, Sim3.identity()), new, edges, np.zeros((7, 7)))
    if len({placed.components[k] for k in others}) > 1:
        return optimize(chunk_ids, edges, placed.S_graph_chunk, metric, chosen)
    active = [edges[k] for k in mine]
    check(active)
    first = min(range(len(active)), key=lambda n: (active[n].kind != "adjacent", -active[n].confidence))
    here = _other(active[first], new)
    ids = sorted({new, *others})
    row = {chunk: k for k, chunk in enumerate(ids)}
    start = across(placed.S_graph_chunk[here], active[first], here)
    poses = stack([start if k == new else placed.S_graph_chunk[k] for k in ids])
    factors = _factors(edges)
    loop = np.array([_kind(e) for e in active])
    weights = information_of(active, metric, chosen.weights) / factors[loop, None, None]
    problem = problem_of(active, row, np.array([k != new for k in ids]), weights)
    if len(active) > 1:
        poses = problem.solve(poses, np.ones(len(active)), 5)
    squares = problem.squares(poses)
    covariance = _hanging(placed.covariances[here], active[first], here, weights[first])
    if len(active) > 1 and float(squares.max()) > chi2_quantile(chosen.fits_quantile, problem.size):
        started = replace(placed, S_graph_chunk=ChainMap({new: start}, _under(placed.S_graph_chunk)))
        moved = _moved(new, here, edges, started, metric, chosen)
        placed = replace(placed, S_graph_chunk=ChainMap(moved[0], _under(placed.S_graph_chunk)))
        return _with(placed, new, moved[0][new], placed.components[here], moved[1], covariance)
    out = list(edges)
    for n, k in enumerate(mine):
        scores = {**edges[k].scores, "graph_residual": deviations_of(squares[n])}
        scores |= {"trust": 1.0, "variance_factor": float(factors[loop[n]])}
        out[k] = replace(edges[k], scores=scores)
    return _with(placed, new, unstack(poses, ids)[new], placed.components[here], out, covariance)


def _accepted_of(chunk: int, edges: Sequence[Edge]) -> list[int]:
    """Return the numbers of the accepted edges of a chunk."""
    return [k for k, e in enumerate(edges) if chunk in (e.u, e.v) and e.accepted]


def _moved(
    new: int, here: int, edges: Sequence[Edge], started: GraphResult, metric: bool, settings: GraphSettings
) -> tuple[dict[int, Sim3], list[Edge]]:
    """Move the neighbourhood by a step and solve_with_trust the new chunk's loops; trust in other edges stays.

    `started` includes the new chunk at the pose that its edge to `here` gives. Returns the moved poses, and all edges.
    """
    poses_of, components, mine = started.S_graph_chunk, started.components, _accepted_of(new, edges)
    known = [k for k, e in enumerate(edges) if e.accepted and e.u in poses_of and e.v in poses_of]
    ends = np.array([(edges[k].u, edges[k].v) for k in known])
    near = _near(new, here, ends, {_other(edges[k], new) for k in mine}, settings.most_moved)
    used = [known[n] for n in np.flatnonzero(np.isin(ends, near).any(axis=1))]
    active = [edges[k] for k in used]
    ids = sorted({c for e in active for c in (e.u, e.v)})
    row = {chunk: k for k, chunk in enumerate(ids)}
    fixed = ~np.isin(ids, near) | np.array([components.get(k) == k for k in ids])
    loop = np.array([_kind(e) for e in active])
    factors = _factors(edges)
    weights = information_of(active, metric, settings.weights) / factors[loop, None, None]
    problem = problem_of(active, row, fixed, weights)
    poses = stack([poses_of[k] for k in ids])
    own = np.isin(used, mine)
    fresh = own & (loop == 1) & settings.robust
    limit = chi2_quantile(settings.trust.loop_quantile, problem.size)
    trust = np.ones(len(used))
    for _ in range(3):
        poses = problem.solve(poses, trust, 1)
        squares = problem.squares(poses)
        after = np.where(fresh & (squares > limit), NO_TRUST, 1.0)
        if (after == trust).all():
            break
        trust = after
    out = list(edges)
    for n in np.flatnonzero(own):
        edge, deviations = active[n], deviations_of(squares[n])
        scores = {**edge.scores, "graph_residual": deviations, "trust": (limit / (float(squares[n]) + limit)) ** 2}
        scores["variance_factor"] = float(factors[loop[n]])
        believed = bool(trust[n] == 1.0)
        reason = edge.reason if believed else contradicted(edge, deviations)
        out[used[n]] = replace(edge, accepted=believed, scores=scores, reason=reason)
    return unstack(poses, ids), out


def _near(new: int, here: int, ends: NDArray[np.int64], others: set[int], most: int) -> NDArray[np.int64]:
    """Return ids of the chunks that move: all on the shortest paths from `here` to the other chunks with an edge to the
    new one, and those nearest to these paths (by number of edges) up to `most`. `ends` (E, 2) are ids of all edges."""
    ids, at = np.unique(ends, return_inverse=True)
    at = at.reshape(ends.shape)
    old = ~(ends == new).any(axis=1)
    graph = csr_array((np.ones(len(at)), (at[:, 0], at[:, 1])), shape=(len(ids), len(ids)))
    without = csr_array((np.ones(int(old.sum())), (at[old, 0], at[old, 1])), shape=graph.shape)
    _, back = breadth_first_order(without, int(np.searchsorted(ids, here)), directed=False)
    way = {int(np.searchsorted(ids, new))}
    for other in np.searchsorted(ids, sorted(others)).tolist():
        while other >= 0 and other not in way:
            way.add(other)
            other = int(back[other])
    steps = dijkstra(graph, directed=False, indices=sorted(way), unweighted=True, min_only=True)
    nearest = np.argsort(steps, kind="stable")[: max(most, len(way))]
    return np.asarray(ids[nearest[np.isfinite(steps[nearest])]])


def _under(known: Mapping[int, T]) -> MutableMapping[int, T]:
    """Return a mapping with the type that `ChainMap` declares; it is never written to."""
    return cast("MutableMapping[int, T]", known)


def _other(edge: Edge, chunk: int) -> int:
    return edge.u if edge.v == chunk else edge.v


def _kind(edge: Edge) -> int:
    return int(edge.kind != "adjacent")


def _with(
    placed: GraphResult, new: int, S: Sim3, component: int, edges: Sequence[Edge], covariance: Array
) -> GraphResult:
    """`placed` with one more chunk; the rest is not copied, so that a chunk costs the same in a long video."""
    return GraphResult(
        ChainMap({new: S}, _under(placed.S_graph_chunk)),
        ChainMap({new: component}, _under(placed.components)),
        tuple(edges),
        placed.residual,
        ChainMap({new: covariance}, _under(placed.covariances)),
    )


def _hanging(of_here: Array, edge: Edge, here: int, information: Array) -> Array:
    """Return the covariance of a chunk chained by an edge to a chunk with covariance `of_here`. Shape (7, 7)."""
    own = np.zeros((7, 7))
    own[: len(information), : len(information)] = np.linalg.inv(information)
    if here == edge.u:
        moved = adjoint(edge.S_v_u)
        return np.asarray(moved @ (of_here + own) @ moved.T)
    moved = adjoint(edge.S_v_u.inverse())
    return np.asarray(moved @ of_here @ moved.T + own)


def _factors(edges: Sequence[Edge]) -> Array:
    """Return the variance factors of adjacent and of loop edges from the last full solution. Shape (2,)."""
    out = np.ones(2)
    for kind in range(2):
        known = (e.scores["variance_factor"] for e in edges if "variance_factor" in e.scores and _kind(e) == kind)
        out[kind] = next(known, 1.0)
    return out
