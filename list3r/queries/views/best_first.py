"""Find the nearest of very many instances: boxes from the R*Tree in growing surroundings, then surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.match import Filters
from list3r.queries.views.surfaces import STRAY, surfaces_of

_MOST = 300
"""More boxes than this in the first surroundings: smaller ones will do."""

_AMPLE = 1.25
"""The first surroundings reach this much further than the k-th nearest of late: most questions are answered in one."""


_ROUNDING = 1e-9
"""Rounding errors of distances, world units."""


class UsualReach:
    """How far the k-th nearest lay, over the last questions to an open store."""

    def __init__(self) -> None:
        self.reach: float | None = None


@dataclass(frozen=True)
class NearestSearch:
    """What is searched for."""

    k: int
    """How many instances are wanted."""
    measure: Callable[[Instance], float]
    """Distance of an instance, world units: at least the gap between its box and the box asked about, less `touch`."""
    filters: Filters
    leave_out: int | None = None
    """Id of an instance that is no answer."""
    component: int | None = None
    """The only connected component that answers."""
    limit: float | None = None
    """Largest distance of an answer, world units."""
    touch: float = 0.0
    """How much smaller a distance may be than the gap between boxes, world units."""


def nearest_first(store: Store, aabb: NDArray[np.float64], search: NearestSearch) -> list[tuple[float, Instance]]:
    """Return the k nearest instances with their distances from a box (2, 3), by distance and then by id.

    Boxes bound distances from below. So the search ends when the surroundings that were searched are as wide as the
    k-th best is far.
    """
    k, filters, limit = search.k, search.filters, search.limit
    bounds = store.instances.bounds()
    if bounds is None:
        return []
    touch = search.touch + STRAY * math.dist(*bounds.tolist())
    whole = _farthest(bounds, aabb) + 1.0
    farthest = whole if limit is None else min(limit + touch, whole)
    kept = store.derived.of(UsualReach)
    usual = kept.reach
    reach = min(_spacing(store, bounds, k) if usual is None else _AMPLE * usual, farthest)
    measured: dict[int, tuple[float, Instance] | None] = {}
    shrinking = 4
    while True:
        most = _MOST + k if shrinking else -1
        ids, boxes = store.instances.boxes_in_box(
            aabb[0] - reach,
            aabb[1] + reach,
            structure=filters.structure,
            min_confidence=filters.min_confidence,
            state=filters.stored_state,
            component=search.component,
            limit=most,
        )
        if len(ids) == most:
            reach, shrinking = 0.5 * reach, shrinking - 1
            continue
        shrinking = 0
        best = _measure(store, ids, box_gaps(boxes, aabb), search, touch + _ROUNDING, measured)
        worst = best[k - 1][0] + touch if len(best) >= k else np.inf
        if worst <= reach or reach >= farthest:
            if len(best) >= k:
                kept.reach = 0.5 * (worst if usual is None else usual) + 0.5 * max(worst, 1e-6)
            return [(d, i) for d, i in best[:k] if limit is None or d <= limit]
        reach = min(worst if np.isfinite(worst) else 2.0 * reach, farthest)


def _measure(
    store: Store,
    ids: NDArray[np.int64],
    gaps: NDArray[np.float64],
    search: NearestSearch,
    farther: float,
    measured: dict[int, tuple[float, Instance] | None],
) -> list[tuple[float, Instance]]:
    """Measure whatever could be among the k nearest. Returns the best so far, in order. A distance may be smaller than
    the gap between boxes, but not by more than `farther`.
    """
    k = search.k
    best = sorted((m for m in measured.values() if m is not None), key=lambda m: (m[0], m[1].id))[:k]
    order = np.lexsort((ids, gaps))
    start, width = 0, k + 2
    while start < len(order):
        part = order[start : start + width]
        if len(best) >= k and gaps[part[0]] > best[k - 1][0] + farther:
            break
        fresh = [int(ids[n]) for n in part if int(ids[n]) not in measured and int(ids[n]) != search.leave_out]
        gap = dict(zip(ids[part].tolist(), gaps[part].tolist(), strict=True))
        read = store.instances.of(fresh)
        for _ in surfaces_of(store, search.filters.select(read)[: max(k - len(best), 0)]):
            pass  # these are measured in any case: their surfaces are read together
        for i in read:
            if len(best) >= k and gap[i.id] > best[k - 1][0] + farther:
                continue
            measured[i.id] = (search.measure(i), i) if search.filters.passes(i) else None
            if (found := measured[i.id]) is not None:
                best = sorted([*best, found], key=lambda m: (m[0], m[1].id))[:k]
        start, width = start + width, 2 * width
    return best


def box_gaps(boxes: NDArray[np.float64], aabb: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances of boxes (N, 2, 3) from a box (2, 3), 0 where they meet. Shape (N,)."""
    apart = np.maximum(0.0, np.maximum(boxes[:, 0] - aabb[1], aabb[0] - boxes[:, 1]))
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", apart, apart)))


def _farthest(bounds: NDArray[np.float64], aabb: NDArray[np.float64]) -> float:
    """Return a distance that no point of a box (2, 3) exceeds from any of another. In floats: it is asked each time."""
    (a, b), (c, d) = bounds.tolist(), aabb.tolist()
    return math.hypot(*(max(high - z, w - low) for low, high, z, w in zip(a, b, c, d, strict=True)))


def _spacing(store: Store, bounds: NDArray[np.float64], k: int) -> float:
    """Guess how far the k-th nearest lies, as if all ids ever given were spread evenly over the world."""
    side = np.maximum(bounds[1] - bounds[0], 1e-3)
    return float(np.cbrt(np.prod(side) * k / max(store.ids.next(), 1)))
