"""Surfaces of instances, cached while the instances stay as they are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.records import Instance
from list3r.memory.store.derived import LruCache
from list3r.memory.store.store import Store

_MAX_POINTS = 4000
"""More points of one instance are thinned out: that is finer than the surfaces are known."""
STRAY = 2e-5
"""Points may be this far outside their instance's box, by its size: the steps in which they are stored."""
_SLACK = 0.02
"""Points this far outside of the box, as a share of its longest edge, still count as the instance's surface."""
_READ = 50
"""Instances whose surfaces are read together."""
_KEPT_POINTS = 4_000_000
"""Points of surfaces that are kept for the next question, over all instances of a store."""


@dataclass(frozen=True)
class InstanceSurface:
    """What is known of the surface of one instance, world coordinates."""

    support: NDArray[np.float64] | None
    """Thinned out, inside the axis-aligned box but for `STRAY`; None where nothing was measured. Shape (N, 3)."""
    instance: Instance

    @property
    def weight(self) -> int:
        """What it counts for among those that are kept."""
        return 50 if self.support is None else 50 + len(self.support)

    # Cached properties write to __dict__, which frozen dataclasses without slots allow.
    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Points of the surface, of the oriented box where nothing was measured. Shape (N, 3)."""
        return _box_points(self.instance) if self.support is None else self.support

    @cached_property
    def tree(self) -> cKDTree:
        """KD-tree of the points."""
        return cKDTree(self.points)

    @cached_property
    def spacing(self) -> float:
        """Distance of the points from each other: what is nearer than that touches, as far as is known."""
        if self.support is None or len(self.support) < 9:
            return 0.0
        sample = self.points[:: -(-len(self.points) // 200)]
        return float(np.median(np.asarray(self.tree.query(sample, k=2)[0])[:, 1]))


class SurfaceCache(LruCache[tuple[int, bytes], InstanceSurface]):
    """Surfaces by instance id and what shows that the instance is unchanged."""

    def __init__(self) -> None:
        super().__init__(_KEPT_POINTS, lambda surface: surface.weight)


def surface_of(store: Store, instance: Instance) -> InstanceSurface:
    """Return the surface of an instance: its support, or its box where it has none."""
    return store.derived.of(SurfaceCache).get(_key(instance)) or next(surfaces_of(store, [instance]))


def surfaces_of(store: Store, instances: Sequence[Instance]) -> Iterator[InstanceSurface]:
    """Yield the surfaces of instances, in order; those that are not kept are read together, some at a time."""
    known = store.derived.of(SurfaceCache)
    for start in range(0, len(instances), _READ):
        some = [(_key(i), i) for i in instances[start : start + _READ]]
        fresh = [i.id for key, i in some if key not in known]
        points = store.surfaces.points_of_each(fresh) if fresh else {}
        yield from [known.get(key) or known.put(key, _surface(points.get(i.id), i)) for key, i in some]


def _key(i: Instance) -> tuple[int, bytes]:
    return i.id, i.aabb.tobytes() + i.center.tobytes() + i.observations.to_bytes(8, "little")


def _surface(measured: NDArray[np.float32] | None, instance: Instance) -> InstanceSurface:
    """Return the support points inside the box, as deriving the box left strays out; those just outside are moved to
    its side, so that a thing is never nearer than its box.
    """
    points = None if measured is None else measured[inside_box(measured, instance)].astype(np.float64)
    if points is None or len(points) == 0:
        return InstanceSurface(None, instance)
    low, high = instance.aabb
    stray = STRAY * float(np.max(instance.box.size))
    points = np.clip(points[:: -(-len(points) // _MAX_POINTS)], low - stray, high + stray)
    return InstanceSurface(points, instance)


def inside_box(points: NDArray[np.floating[Any]], instance: Instance) -> NDArray[np.bool_]:
    """Tell which points are in the box of an instance, or just outside. Shape (N, 3) -> (N,)."""
    slack = _SLACK * float(np.max(instance.box.size)) + 1e-9
    low, high = instance.aabb
    return np.asarray(np.all((points >= low - slack) & (points <= high + slack), axis=1))


_FACES = np.array([p for p in np.ndindex(3, 3, 3) if p != (1, 1, 1)], dtype=np.float64) * 0.5 - 0.5


def _box_points(instance: Instance) -> NDArray[np.float64]:
    """Return corners and middles of edges and faces of the oriented box. Shape (26, 3)."""
    box = instance.box
    points = box.center + (_FACES * box.size) @ box.rotation.T
    return np.asarray(np.clip(points, instance.aabb[0], instance.aabb[1]))


def distance_to_point(store: Store, instance: Instance, point: NDArray[np.float64]) -> float:
    """Measure from a point to the nearest surface point of an instance."""
    surface = surface_of(store, instance)
    if surface.support is not None:
        offset = surface.support - point
        return float(np.sqrt(np.min(np.einsum("ij,ij->i", offset, offset))))
    at, box = point.tolist(), instance.box
    along = zip(np.dot(point - box.center, box.rotation).tolist(), box.size.tolist(), strict=True)
    outside = [abs(offset) - 0.5 * edge for offset, edge in along]
    if max(outside) <= 0.0:
        return float(-max(outside))
    low, high = instance.aabb.tolist()
    apart = [max(a - x, x - b) for a, x, b in zip(low, at, high, strict=True)]
    return math.sqrt(max(_squared(*outside), _squared(*apart)))


def _squared(x: float, y: float, z: float) -> float:
    """Return square of a distance by how far a point is outside along three axes, not above 0 where it does not."""
    x, y, z = max(x, 0.0), max(y, 0.0), max(z, 0.0)
    return x**2 + y**2 + z**2


def distance_between(store: Store, a: Instance, b: Instance) -> float:
    """Measure between the nearest surface points of two instances; 0 where they touch, which is where the points of one
    are as near to the other as to each other.
    """
    one, two = surface_of(store, a), surface_of(store, b)
    small, large = sorted((one, two), key=lambda s: len(s.points))
    gap = float(np.min(large.tree.query(small.points)[0]))
    return 0.0 if gap <= max(one.spacing, two.spacing) else gap
