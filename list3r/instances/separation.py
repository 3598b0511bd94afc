"""Cannot-link evidence: pairs that are two objects because one frame shows both (paper 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.instances.geometric.features import lab_of
from list3r.memory.core.records import LocalInstance

WELL_VISIBLE = 0.3
"""Share of an instance's support that must be seen for its mask to count."""
TOUCHING_M = 0.03
"""Objects nearer than this may be pieces of one, unless a surface parts them."""
PIECE_M = 0.25
"""Instances smaller than this in every direction are small objects."""
COLOR_DIFFERENCE = 12.0
"""From this on two flat objects in one plane are a sheet and its support."""
ROOM_M = 0.6
"""Pieces of one piece of furniture are seldom farther apart than this."""


def cannot_link_pairs(instances: Sequence[LocalInstance], frames: int, unit: float) -> NDArray[np.int32]:
    """Pairs of local ids seen side by side in at least `frames` frames that cannot be pieces of one. Shape (P, 2).

    An over-segmented object looks just like two objects side by side. So a pair only counts when a surface parts it
    (one is on the other), when they are in one plane and differ in colour, when both are small and apart, or when they
    are far apart and not in one plane.
    """
    well = [_well_visible(instance) for instance in instances]
    parts = [_Part.of(instance) for instance in instances]
    pairs = [
        (a, b)
        for a in range(len(instances))
        for b in range(a + 1, len(instances))
        if len(well[a] & well[b]) >= frames and _two_objects(parts[a], parts[b], unit)
    ]
    return np.array(pairs, np.int32).reshape(-1, 2)


@dataclass(frozen=True)
class _Part:
    """An instance with values that every comparison needs."""

    instance: LocalInstance
    low: NDArray[np.float32]
    """Least corner of its box, chunk units. Shape (3,)."""
    high: NDArray[np.float32]
    """Greatest corner. Shape (3,)."""
    tree: cKDTree
    some: NDArray[np.float32]
    """About 300 of its points, chunk units. Shape (S, 3)."""

    @classmethod
    def of(cls, instance: LocalInstance) -> _Part:
        """Return the part that an instance is."""
        points = instance.support.points
        some = points[:: max(1, len(points) // 300)]
        return cls(instance, points.min(axis=0), points.max(axis=0), cKDTree(points), some)

    def small(self, unit: float) -> bool:
        """Return whether it is small in every direction."""
        return bool((self.high - self.low).max() < PIECE_M * unit)


def _well_visible(instance: LocalInstance) -> set[int]:
    rows = instance.track.visible_fraction > WELL_VISIBLE
    return set(instance.track.frames[rows].tolist())


def _two_objects(one: _Part, two: _Part, unit: float) -> bool:
    a, b = one.instance, two.instance
    if a.plane is not None and b.plane is not None and (_on_plane(a, b, unit) or _on_plane(b, a, unit)):
        return _color_difference(a, b) > COLOR_DIFFERENCE
    gap = _gap(one, two, 1.1 * ROOM_M * unit) / unit
    if gap < TOUCHING_M:
        return _rests_on(a, b, unit) or _rests_on(b, a, unit)
    return (one.small(unit) and two.small(unit)) or gap > ROOM_M or a.structure or b.structure


def _color_difference(a: LocalInstance, b: LocalInstance) -> float:
    """Distance of the median colours in Lab, lightness halved."""
    tone = lab_of(np.stack([np.median(i.support.rgb, axis=0) for i in (a, b)]).astype(np.float32))
    return float(np.linalg.norm(tone[0] - tone[1]))


def _gap(a: _Part, b: _Part, far: float) -> float:
    """About the smallest distance of a from b, at most `far`."""
    if np.linalg.norm(np.maximum(np.maximum(a.low - b.high, b.low - a.high), 0.0)) > far:
        return far
    distance, _ = b.tree.query(a.some, distance_upper_bound=far)
    return float(np.quantile(np.minimum(distance, far), 0.02))


def _on_plane(a: LocalInstance, b: LocalInstance, unit: float) -> bool:
    """True where the flat a is in the plane of b."""
    assert b.plane is not None
    return bool(np.median(np.abs(a.support.points @ b.plane[:3] + b.plane[3])) < 0.05 * unit)


def _rests_on(a: LocalInstance, b: LocalInstance, unit: float) -> bool:
    """True where a is all on the open side of the flat b and rises well from it."""
    if b.plane is None:
        return False
    height = a.support.points @ b.plane[:3] + b.plane[3]
    return bool(np.quantile(height, 0.05) > -0.01 * unit and np.quantile(height, 0.9) > 0.03 * unit)
