"""Predict the relation of two chunks from the chain of accepted edges between them: a gate for candidate revisits.

Copies of one room differ only in position, so their appearance cannot distinguish them; the camera's path can. A chain
is as uncertain as its edges and the deformation of each chunk on it. A relation far outside of that uncertainty is
refused.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.solver import adjoint
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ChainSettings:
    """Uncertainty of a chain of edges. The deviations are of one chunk of the chain, its deformation included."""

    shift: float = 0.04
    """Deviation of a shift, as a share of the spread of the edge's points."""
    turn_deg: float = 2.0
    log_scale: float = 0.03
    """Deviation of the logarithm of the scale; none where everything is metric."""
    least_confidence: float = 0.05
    """Least confidence assumed for an edge when the path of highest confidence is chosen,"""
    least_step_confidence: float = 0.2
    """and when its deviations are widened by one over its confidence."""
    most_deviations: float = 4.5
    """Distance, in deviations, beyond which a relation is refused."""


@dataclass(frozen=True)
class Prediction:
    """A relation of two chunks predicted by the edges between them."""

    S_v_u: Sim3
    covariance: Array
    """Of x in S_true = S_v_u exp(x), u's units. Shape (7, 7)."""

    def deviations(self, S_v_u: Sim3) -> float:
        """Return how many standard deviations away a measured relation is (Mahalanobis distance)."""
        off = (self.S_v_u.inverse() @ S_v_u).log()
        return float(np.sqrt(max(float(off @ np.linalg.solve(self.covariance, off)), 0.0)))


class EdgeChains:
    """The graph of accepted edges, which predicts many relations."""

    def __init__(self, edges: Iterable[Edge], settings: ChainSettings) -> None:
        self._settings = settings
        self._near: dict[int, list[tuple[int, Edge]]] = {}
        for edge in sorted((e for e in edges if e.accepted), key=_order):
            self._near.setdefault(edge.u, []).append((edge.v, edge))
            self._near.setdefault(edge.v, []).append((edge.u, edge))

    def connected_to(self, chunk_id: int) -> set[int]:
        """Return the chunks that are connected to a chunk, and the chunk itself."""
        out, queue = {chunk_id}, [chunk_id]
        while queue:
            for k, _ in self._near.get(queue.pop(), ()):
                if k not in out:
                    out.add(k)
                    queue.append(k)
        return out

    def predict(self, u: int, v: int, more: Sequence[Edge] = ()) -> Prediction | None:
        """Return the relation of two chunks along the path of least cost, with `more` edges; None without a path."""
        near = self._near
        if more:
            near = dict(near)
            for edge in sorted((e for e in more if e.accepted), key=_order):
                near[edge.u] = [*near.get(edge.u, []), (edge.v, edge)]
                near[edge.v] = [*near.get(edge.v, []), (edge.u, edge)]
        return _along(near, u, v, self._settings)


def _order(edge: Edge) -> tuple[int, int, str, tuple[int, int]]:
    return edge.u, edge.v, edge.kind, edge.frames or (0, 0)


def _along(near: Mapping[int, list[tuple[int, Edge]]], u: int, v: int, settings: ChainSettings) -> Prediction | None:
    path = _path(near, u, v, settings)
    if path is None:
        return None
    S, covariance = Sim3.identity(), np.zeros((7, 7))
    here = u
    for edge in path:
        step, noise = _step(edge, here, settings)
        moved = adjoint(S.inverse())
        covariance = covariance + moved @ noise @ moved.T
        S = step @ S
        here = edge.v if edge.u == here else edge.u
    return Prediction(S, covariance + 1e-12 * np.eye(7))


def _path(near: Mapping[int, list[tuple[int, Edge]]], u: int, v: int, settings: ChainSettings) -> list[Edge] | None:
    """Return the path with the least sum of 1 / confidence (Dijkstra)."""
    queue: list[tuple[float, int, int]] = [(0.0, u, u)]
    done: dict[int, int] = {}
    by: dict[tuple[int, int], Edge] = {}
    cost = {u: 0.0}
    while queue:
        so_far, here, before = heapq.heappop(queue)
        if here in done:
            continue
        done[here] = before
        if here == v:
            break
        for other, edge in near.get(here, []):
            new = so_far + 1.0 / max(edge.confidence, settings.least_confidence)
            if other not in done and new < cost.get(other, np.inf):
                cost[other], by[here, other] = new, edge
                heapq.heappush(queue, (new, other, here))
    if v not in done:
        return None
    out: list[Edge] = []
    while v != u:
        out.append(by[done[v], v])
        v = done[v]
    return out[::-1]


def _step(edge: Edge, here: int, settings: ChainSettings) -> tuple[Sim3, Array]:
    """Return the similarity across an edge from the chunk `here`, and its covariance with one chunk's deformation."""
    spread_v = edge.scores.get("spread", 1.0)
    spread_u = spread_v / float(edge.S_v_u.scale)
    forth = here == edge.u
    spread = spread_u if forth else spread_v
    weak = 1.0 / max(edge.confidence, settings.least_step_confidence)
    deviation = np.array([settings.shift * spread] * 3 + [np.deg2rad(settings.turn_deg)] * 3 + [settings.log_scale])
    noise = np.diag((weak * deviation) ** 2)
    if edge.covariance is not None:
        flip = np.eye(7) if forth else adjoint(edge.S_v_u)
        noise = noise + flip @ edge.covariance @ flip.T
    return (edge.S_v_u if forth else edge.S_v_u.inverse()), noise
