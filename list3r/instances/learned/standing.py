"""What carries a thing: legs and feet that were seen in bits join the thing that would hover without them.

Thin legs are seen in bits that are too small, or too far from what they carry, for the networks to join. But nothing
hovers: where a seat, a table top or a lamp's shade has nothing to stand on or to hang from, the bits below it that are
no things of their own carry it (docs/decisions/0165-nothing-hovers.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from list3r.instances.learned.cut import CloudCut
from list3r.instances.learned.graph import ChunkSurface, upright_frame

Float = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_POINTS = 400
"""Points of a thing that are looked at to tell whether it is held."""
LEVEL, UPRIGHT = 0.6, 0.4
"""Cosine to the vertical from which a surface is level, and up to which it is upright."""


@dataclass(frozen=True)
class StandingSettings:
    """When a thing hovers, and what may carry it. Chosen on offices that others furnished and on left-out worlds."""

    touch_m: float = 0.04
    """Height over a level surface up to which a thing stands on it."""
    rim_m: float = 0.1
    """Distance to the side over which that surface is looked for: what is under a thing is hidden by it, and depth is
    lost at its outline."""
    wall_m: float = 0.08
    """Distance from a wall or ceiling up to which a thing hangs there."""
    base_m: float = 0.06
    """Height of the lowest part of a thing, which is what it stands on."""
    held: float = 0.15
    """Share of that part that must stand on something,"""
    hung: float = 0.25
    """and of the whole thing that must be at a wall, for it not to hover."""
    larger: float = 8.0
    """Times as large, seen from above, that something must be for a thing to stand on it though it is not told: a mug
    stands on such a table, but a chair's back not on its seat."""
    gap_m: float = 0.3
    """Longest gap to the next bit of what carries it; the post of an office chair may not be seen at all."""
    around_m: float = 0.15
    """How far feet reach beyond what they carry, at most half of its width."""
    overlap_m: float = 0.15
    """How far up beside a thing what carries it may reach."""
    link_m: float = 0.025
    """Distance between voxels of one bit."""
    least: int = 6
    """Voxels from which a bit counts."""


def with_supports(surface: ChunkSurface, cut: CloudCut, listed: NDArray[np.bool_], s: StandingSettings) -> CloudCut:
    """Return the cut in which things that would hover have the bits that carry them, the largest things first.

    `listed` (T,) are the things that are told. What is not told and is no structure, and voxels of no thing, come in
    bits that may carry.
    """
    place = _Place(surface, cut, listed, s)
    labels = cut.labels.copy()
    for number, own in place.things():
        candidates = place.below(own)
        if len(candidates) and not place.is_held(number, own):
            for k in place.reached(own, candidates):
                labels[place.take(k)] = number
    left = np.bincount(labels[labels >= 0], minlength=len(cut.told.structure)) > 0
    return CloudCut(labels, cut.told).only(left)


class _Place:
    """The cloud upright in metres: its things, the bits that may carry them, and what they can stand on."""

    def __init__(self, surface: ChunkSurface, cut: CloudCut, listed: NDArray[np.bool_], s: StandingSettings) -> None:
        frame = upright_frame(surface.around.up)
        self._s, self._labels = s, cut.labels
        self._points: Float = (surface.cloud.points @ frame.T) / surface.around.unit
        self._rise: Float = surface.cloud.normals @ frame[2]
        structure = cut.told.structure > 0.5
        self._thing = listed & ~structure
        self._structure = np.append(structure, False)[cut.labels]
        self._solid = np.append(listed | structure, False)[cut.labels]
        self._outlines = _outlines(self._points, cut.labels, len(structure))
        self._bits = self._cut_bits(np.flatnonzero(~self._solid))
        self._low = np.array([self._points[rows].min(axis=0) for rows in self._bits]).reshape(-1, 3)
        self._high = np.array([self._points[rows].max(axis=0) for rows in self._bits]).reshape(-1, 3)
        self._free = np.ones(len(self._bits), bool)

    def things(self) -> Iterator[tuple[int, Float]]:
        """Yield the number and the points (M, 3) of each thing, the largest first."""
        count = len(self._thing)
        order = np.argsort(self._labels, kind="stable")
        bounds = np.searchsorted(self._labels[order], np.arange(count + 1))
        for number in np.argsort(-np.diff(bounds), kind="stable").tolist():
            if self._thing[number] and self._free.any():
                yield number, self._points[order[bounds[number] : bounds[number + 1]]]

    def below(self, own: Float) -> Ints:
        """Return the bits that lie below a thing and within its outline, or little beyond it."""
        s = self._s
        low, high = np.quantile(own, [0.01, 0.99], axis=0)
        beyond = np.minimum(s.around_m, (high - low)[:2] / 2)
        inside = (self._low[:, :2] > low[:2] - beyond).all(axis=1) & (self._high[:, :2] < high[:2] + beyond).all(axis=1)
        under = (self._low[:, 2] < low[2]) & (self._high[:, 2] < low[2] + s.overlap_m)
        return np.flatnonzero(self._free & inside & under)

    def is_held(self, number: int, own: Float) -> bool:
        """Return whether a thing stands on something level, or hangs at a wall or from a ceiling."""
        s = self._s
        bottom, top = np.quantile(own[:, 2], [0.01, 0.99])
        wide = self._outlines >= s.larger * np.prod(np.ptp(own[:, :2], axis=0))
        near = (self._solid | np.append(wide, False)[self._labels]) & (self._labels != number)
        near &= ((self._points > own.min(axis=0) - s.rim_m) & (self._points < own.max(axis=0) + s.rim_m)).all(axis=1)
        level = self._points[near & (self._rise > LEVEL)]
        flat = np.array([s.touch_m / s.rim_m, s.touch_m / s.rim_m, 1.0])
        near &= self._structure
        walls, ceilings = near & (np.abs(self._rise) < UPRIGHT), near & (self._rise < -LEVEL)
        return (
            _share_near(own[own[:, 2] < bottom + s.base_m] * flat, level * flat, s.touch_m) >= s.held
            or _share_near(own, self._points[walls], s.wall_m) >= s.hung
            or _share_near(own[own[:, 2] > top - s.base_m], self._points[ceilings], s.wall_m) >= s.held
        )

    def reached(self, own: Float, candidates: Ints) -> Iterator[int]:
        """Yield those of some bits that are reached from a thing without a longer gap."""
        grown, left = own, candidates.tolist()
        while left:
            tree = cKDTree(grown)
            near = [k for k in left if np.min(tree.query(self._points[self._bits[k]])[0]) < self._s.gap_m]
            if not near:
                return
            yield from near
            grown = np.concatenate([self._points[self._bits[k]] for k in near])
            left = [k for k in left if k not in near]

    def take(self, bit: int) -> Ints:
        """Return the voxels of a bit, which then is no other thing's."""
        self._free[bit] = False
        return self._bits[bit]

    def _cut_bits(self, rows: Ints) -> list[Ints]:
        """Return voxels of no thing and of what is not told, in connected bits; what lies on a floor is none."""
        s, floor = self._s, self._points[self._structure & (self._rise > LEVEL)]
        if len(rows) and len(floor):
            flat = np.array([0.3, 0.3, 2.0])
            level = np.flatnonzero(self._rise[rows] > LEVEL)
            gap, _ = cKDTree(floor * flat).query(self._points[rows[level]] * flat, distance_upper_bound=0.03)
            rows = np.delete(rows, level[np.isfinite(gap)])
        pairs = (
            cKDTree(self._points[rows]).query_pairs(s.link_m, output_type="ndarray")
            if len(rows)
            else np.empty((0, 2), int)
        )
        a, b = pairs[self._labels[rows[pairs[:, 0]]] == self._labels[rows[pairs[:, 1]]]].T
        links = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(len(rows), len(rows)))
        _, bit = connected_components(links, directed=False)
        order = np.argsort(bit, kind="stable")
        bits = np.split(rows[order], np.flatnonzero(np.diff(bit[order])) + 1)
        return [r for r in bits if len(r) >= s.least]


def _outlines(points: Float, labels: NDArray[np.int32], count: int) -> Float:
    """Return the area of the rectangle round each of `count` clusters, seen from above. Shape (count,)."""
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    known = labels >= 0
    np.minimum.at(low, labels[known], points[known, :2])
    np.maximum.at(high, labels[known], points[known, :2])
    return np.asarray(np.prod(np.maximum(high - low, 0.0), axis=1))


def _share_near(sample: Float, surface: Float, reach: float) -> float:
    """Return the share of some points (S, 3) that have one of a surface (P, 3) within reach."""
    if not len(sample) or not len(surface):
        return 0.0
    if len(sample) > MOST_POINTS:
        sample = sample[np.random.default_rng(0).choice(len(sample), MOST_POINTS, replace=False)]
    gap, _ = cKDTree(surface).query(sample, distance_upper_bound=reach)
    return float(np.isfinite(gap).mean())
