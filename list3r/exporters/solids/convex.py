"""Convex parts of voxels: cut where that leaves least that is hull alone, along the axes of an instance.

CoACD (Wei et al., SIGGRAPH 2022) looks for such cuts in a triangle mesh, by a tree search. Voxels know their volume and
their axes are those of boards and legs, so that a few cuts need to be tried.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

from list3r.exporters.meshes.closed import ClosedSurface, hull
from list3r.memory.core.geometry import Array

Cells = NDArray[np.int64]


@dataclass(frozen=True)
class ConvexSettings:
    """How far voxels are cut."""

    parts: int = 32
    """At most."""
    unfilled: float = 0.75
    """Voxels: how deep a hull is unfilled, as a mean over its surface, from which it is cut."""
    cuts: int = 8
    """Along each axis at once, at most,"""
    step: float = 0.25
    """where the area changes by so much of the most that it does."""
    enough: float = 0.5
    """One cut that saves this share of the excess is taken without a look at several at once."""
    corners: int = 64
    """Of a part at most: what simulators take (PhysX)."""


def convex_parts(
    solid: NDArray[np.bool_], place: Callable[[Cells], Array], settings: ConvexSettings | None = None
) -> tuple[ClosedSurface, ...]:
    """Return convex parts that together are about the solid.

    `place` returns where corners of voxels lie, given the indices of the voxels above them, (N, 3) each.
    """
    s = settings or ConvexSettings()
    queue = [_Piece.of(cells) for cells in _connected(np.argwhere(solid))]
    heapq.heapify(queue)
    done: list[_Piece] = []
    while queue:
        piece = heapq.heappop(queue)
        pieces = _cut(piece, s.parts - len(queue) - len(done), s) if piece.unfilled > s.unfilled else [piece]
        if len(pieces) == 1:
            done += pieces
        for one in pieces[len(pieces) == 1 :]:
            heapq.heappush(queue, one)
    done = sorted(done, key=lambda p: -len(p.cells))[: s.parts]
    return tuple(part for piece in done if (part := _hull(place(piece.corners), s.corners)) is not None)


@dataclass(frozen=True, order=True)
class _Piece:
    order: float
    excess: float = field(compare=False)
    """Volume of the hull that is empty, voxels."""
    unfilled: float = field(compare=False)
    cells: Cells = field(compare=False)
    corners: Cells = field(compare=False)
    """Of the outer voxels of each column. Shape (N, 3)."""

    @staticmethod
    def of(cells: Cells) -> _Piece:
        """Return a piece of voxels, (N, 3)."""
        corners = _outer_corners(cells)
        found = ConvexHull(corners)
        excess = float(found.volume) - len(cells)
        return _Piece(-excess, excess, 2 * excess / float(found.area), cells, corners)


def _outer_corners(cells: Cells) -> Cells:
    """Return the first and last corner of voxels along their shortest axis, all that their hull needs. (M, 3)."""
    low = cells.min(axis=0)
    count = cells.max(axis=0) - low + 1
    rest = np.sort(np.argsort(count, kind="stable")[1:])
    axis = 3 - int(rest.sum())
    first = np.full(tuple(count[rest] + 1), count[axis] + 1)
    last = np.full(first.shape, -1)
    x, y = (cells[:, rest] - low[rest]).T
    z = cells[:, axis] - low[axis]
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        np.minimum.at(first, (x + dx, y + dy), z)
        np.maximum.at(last, (x + dx, y + dy), z + 1)
    at = np.argwhere(last > 0)
    ends = [np.insert(at, axis, heights[tuple(at.T)], axis=1) for heights in (first, last)]
    return np.asarray(np.concatenate(ends) + low)


def _connected(cells: Cells) -> list[Cells]:
    """Return the connected parts of voxels; specks of fewer than eight go."""
    if not len(cells):
        return []
    low = cells.min(axis=0)
    mask = np.zeros(tuple(cells.max(axis=0) - low + 1), bool)
    at = tuple((cells - low).T)
    mask[at] = True
    parts, count = ndimage.label(mask)
    if count == 1:
        return [cells]
    which = parts[at]
    return [cells[which == n] for n in np.flatnonzero(np.bincount(which) >= 8)] or [cells]


def _cut(piece: _Piece, room: int, s: ConvexSettings) -> list[_Piece]:
    """Return the pieces of the cut that saves most excess for each further piece, at most `room`; itself where none
    saves any.

    Several cuts at once are tried where one saves little: a ring is no better for being halved, an open box no better
    without one of its walls.
    """
    steps = [_steps(piece.cells, axis, s) for axis in range(3)]
    middles = [_middle(piece.cells[:, axis]) for axis in range(3)]
    tried = [_cut_at([piece], axis, (at,)) for axis in range(3) for at in {*steps[axis], middles[axis]}]
    if not any(_saved(piece, t) >= s.enough * piece.excess for t in tried):
        slices = [_sliced(piece, axis, s) for axis in range(3)]
        for one, two in ((0, 1), (0, 2), (1, 2)):
            tried.append(_cut_at(_cut_at([piece], one, (middles[one],)), two, (middles[two],)))
            for first, second in ((one, two), (two, one)):
                finer = [[c] if c.unfilled <= s.unfilled else _sliced(c, second, s) for c in slices[first]]
                tried.append([p for some in finer for p in some])
        tried += slices
    useful = [t for t in tried if 1 < len(t) <= room]
    return max(useful, key=lambda t: _saved(piece, t) / (len(t) - 1), default=[piece])


def _saved(piece: _Piece, pieces: Sequence[_Piece]) -> float:
    return piece.excess - sum(p.excess for p in pieces)


def _sliced(piece: _Piece, axis: int, s: ConvexSettings) -> list[_Piece]:
    return _cut_at([piece], axis, _steps(piece.cells, axis, s))


def _cut_at(pieces: Sequence[_Piece], axis: int, places: Sequence[int]) -> list[_Piece]:
    """Return what cuts above some layers of an axis leave of pieces."""
    out = []
    for piece in pieces:
        layer = np.searchsorted(np.sort(places), piece.cells[:, axis])
        out += [_Piece.of(c) for n in np.unique(layer) for c in _connected(piece.cells[layer == n])]
    return out


def _steps(cells: Cells, axis: int, s: ConvexSettings) -> tuple[int, ...]:
    """Return the layers above which the area changes most, as where a board begins."""
    at = cells[:, axis]
    change = np.abs(np.diff(np.bincount(at - at.min())))
    if not len(change):
        return ()
    most = np.argsort(-change, kind="stable")[: s.cuts]
    return tuple((at.min() + most[change[most] >= s.step * change.max()]).tolist())


def _middle(at: Cells) -> int:
    return int((at.min() + at.max() - 1) // 2)


_FLAT = 1e-3
"""Share of the longest side: thinner parts are skins that carry nothing."""
_DIRECTIONS = np.random.default_rng(0).normal(size=(400, 3))


def _hull(points: Array, most: int) -> ClosedSurface | None:
    """Return the hull of points with at most so many corners: those farthest along directions all around; None where
    the voxels were laid flat.
    """
    if np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2] < _FLAT * np.ptp(points, axis=0).max():
        return None
    whole = hull(points)
    if len(whole.vertices) <= most:
        return whole
    far = (whole.vertices @ _DIRECTIONS.T).argmax(axis=0)
    kept, first = np.unique(far, return_index=True)
    return hull(whole.vertices[kept[np.argsort(first)][:most]])
