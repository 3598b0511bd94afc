"""What relations are computed on: instances with what is measured of them and between them, each once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from list3r.memory.core.geometry import Array
from list3r.memory.library.relations.instance_geometry import InstanceGeometry, neighbours_of
from list3r.memory.library.relations.settings import RelationSettings
from list3r.memory.library.relations.symmetry import round_axis, turned

T = TypeVar("T")


class PairMeasures:
    """What was measured between pairs of instances, by their ids: each is looked at from both, in several places."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int, int], object] = {}

    def get(self, what: str, a: InstanceGeometry, b: InstanceGeometry, compute: Callable[[], T]) -> T:
        """Return the measure `what` of a and b, computed if it is new."""
        key = what, a.id, b.id
        if key not in self._known:
            self._known[key] = compute()
        return cast(T, self._known[key])


Found = tuple[int, int, float, float]
"""Subject and object by position, confidence, margin."""
Held = tuple[int, float, float]
"""Object by position, confidence, margin."""
Sure = tuple[float, float]
"""Confidence, margin."""


class RelationScene:
    """Instances with what is derived from them once."""

    def __init__(
        self,
        instances: Sequence[InstanceGeometry],
        unit: float,
        settings: RelationSettings,
        measured: PairMeasures,
        *,
        upright: bool,
    ) -> None:
        self.instances = instances
        self._upright = upright
        self._measured = measured
        self.unit = unit
        self.s = settings
        self.tree, self.plan, self.surface = cache(self._tree_of), cache(self._seen_from_above), cache(self._sampled)
        low = np.array([b.aabb[0] for b in instances]).reshape(-1, 3)
        high = np.array([b.aabb[1] for b in instances]).reshape(-1, 3)
        gap = np.maximum(0, np.maximum(low[:, None] - high[None], low[None] - high[:, None]))
        self.box_gap = np.linalg.norm(gap, axis=2)
        component = np.array([b.component for b in instances])
        self.box_gap[component[:, None] != component[None]] = np.inf
        self.low, self.high = low, high
        self.foot = low[:, 2].copy()
        """Where each instance ends below; down to the floor for what is on it."""
        self.covering = np.zeros(len(instances), dtype=bool)
        """Whether each is a rug."""
        self.size = np.array([b.size for b in instances])
        self.in_room = np.array([b.structure is None for b in instances], dtype=bool)

    def _tree_of(self, n: int) -> cKDTree:
        """Return the KD-tree of an instance's points."""
        return cKDTree(self.instances[n].points)

    def measure(self, what: str, a: int, b: int, compute: Callable[[RelationScene, int, int], T]) -> T:
        """Return a measure of two instances, from memory where it is known."""
        return self._measured.get(what, self.instances[a], self.instances[b], lambda: compute(self, a, b))

    def touch(self, a: int, b: int) -> float:
        """Return the distance of a few hundred points of the smaller instance to the nearest of the other."""
        return self.measure("touch", min(a, b), max(a, b), _touch)

    def gap(self, a: int, b: int) -> float:
        """Return the distance between surfaces."""
        return self.measure("upright gap" if self._upright else "gap", min(a, b), max(a, b), _gap)

    def _sampled(self, n: int) -> SampledSurface:
        """Return what is known of an instance's surface: its points, and for what is round its hidden sides too."""
        points = self.instances[n].points
        axis = self.measure("axis", n, n, _axis) if self._upright and self.in_room[n] else None
        if axis is not None:
            points = turned(points[:: -(-len(points) // _TURNED)], axis)
        tree = self.tree(n) if axis is None else cKDTree(points)
        away = neighbours_of(points[:: max(1, len(points) // 100)], tree, min(_COMPANY + 1, len(points)))[0]
        grain, company = np.median(away[:, min(1, away.shape[1] - 1)]), np.median(away[:, -1])
        return SampledSurface(points, tree, float(grain), float(company))

    def _seen_from_above(self, n: int) -> Footprint:
        """Return an instance as it is seen from above."""
        points = self.instances[n].points
        sample = points[:: -(-len(points) // _SAMPLE)]
        return Footprint(sample, cKDTree(sample[:, :2]), spacing_of(sample))


def _touch(scene: RelationScene, a: int, b: int) -> float:
    small, large = sorted((a, b), key=lambda n: (len(scene.instances[n].points), n))
    return float(neighbours_of(scene.plan(small).points, scene.tree(large))[0].min())


def _axis(scene: RelationScene, a: int, _: int) -> Array | None:
    return round_axis(scene.instances[a].points, scene.s.noise_m * scene.unit, scene.s.symmetry)


def _gap(scene: RelationScene, a: int, b: int) -> float:
    """Of the nearest points that keep company; a reading amidst the edge between two instances is no surface."""
    small, large = sorted((scene.surface(a), scene.surface(b)), key=lambda s: len(s.points))
    near = _nearest(small.points, large.tree)
    away, at = neighbours_of(small.points[near], large.tree, min(_COMPANY, large.tree.n))
    keeps = _in_company(small, near)[:, None] & _in_company(large, at.ravel()).reshape(at.shape)
    gap = float(away[keeps].min() if keeps.any() else away.min())
    return max(0.0, gap - scene.s.grain * max(small.grain, large.grain))


def _nearest(points: Array, tree: cKDTree) -> NDArray[np.int64]:
    """Return positions of the few dozen points that are nearest to those of a tree; looks first where its box is
    near.
    """
    at_least = np.linalg.norm(np.maximum(0.0, np.maximum(tree.mins - points, points - tree.maxes)), axis=1)
    order = np.argsort(at_least, kind="stable")
    away = np.sort(neighbours_of(points[order[: 2 * _NEAR]], tree)[0][:, 0])
    asked = order[at_least[order] <= away[min(_NEAR, len(away)) - 1]]
    found = neighbours_of(points[asked], tree)[0][:, 0]
    return np.asarray(asked[np.argsort(found, kind="stable")[:_NEAR]])


def _in_company(surface: SampledSurface, at: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether points of a surface have others about them as is usual for it."""
    away = neighbours_of(surface.points[at], surface.tree, min(_COMPANY + 1, surface.tree.n))[0][:, -1]
    return np.asarray(away <= 2.0 * surface.company)


_COMPANY, _NEAR, _TURNED = 4, 32, 250
_SAMPLE = 200
"""Points that represent an instance where its outline matters, not its detail."""


@dataclass(frozen=True)
class SampledSurface:
    """Points of a surface."""

    points: Array
    tree: cKDTree
    grain: float
    """Typical distance of a point from the nearest other."""
    company: float
    """And from the fourth."""


@dataclass(frozen=True)
class Footprint:
    points: Array
    tree: cKDTree
    spacing: float


def certainty(margin: float, noise: float) -> float:
    """Return how likely a decision holds when its margin is measured with this noise: 0.5 at the boundary."""
    return 1.0 / (1.0 + math.exp(-max(-700.0, min(1.7 * margin / max(noise, 1e-12), 700.0))))


def wall_touched(scene: RelationScene, a: int) -> tuple[float, int] | None:
    """Return the wall that an instance touches: (gap, position), the nearest one."""
    limit = scene.s.attached_m * scene.unit
    walls = [
        (scene.touch(a, b), b)
        for b, other in enumerate(scene.instances)
        if other.structure in ("wall", "plane") and scene.box_gap[a, b] < limit
    ]
    return min(walls) if walls and min(walls)[0] < limit else None


def contact_of(scene: RelationScene, a: int) -> float:
    height = float(scene.instances[a].box.size[2])
    return scene.s.contact_m * scene.unit + scene.s.contact_per_height * min(height, scene.unit)


def spacing_of(points: Array) -> float:
    """Return the typical distance between neighbouring points of a layer."""
    if len(points) < 3:
        return 0.0
    sample = points[:: max(1, len(points) // 100)]
    return float(np.median(neighbours_of(sample, cKDTree(points), 2)[0][:, 1]))


def hull_under(point: Array, xy: Array) -> tuple[float, float]:
    """Return how far a point lies outside the convex hull of others in the plane, 0 inside, and the area of the
    hull.
    """
    try:
        hull = ConvexHull(xy)
    except (QhullError, ValueError):
        return float(np.linalg.norm(xy - point, axis=1).min()), 0.0
    return float(max(0.0, (hull.equations[:, :2] @ point + hull.equations[:, 2]).max())), float(hull.volume)
