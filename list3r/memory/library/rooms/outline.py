"""Outlines of regions of a grid, and which places they enclose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.geometry import Array
from list3r.memory.library.rooms.space import Grid, Mask

_STRAIGHT_CELLS = 2.0
"""Corners of an outline lie within so many cells of the region's own."""


def outline(mask: Mask, grid: Grid) -> Array:
    """Return the outer outline of a region's largest part, world x and y, counterclockwise, open. Shape (N, 2)."""
    from scipy.ndimage import binary_fill_holes, label

    parts, _ = label(mask)
    largest = int(np.argmax(np.bincount(parts[mask], minlength=1)))
    corners = _traced(np.pad(np.asarray(binary_fill_holes(parts == largest)), 1)) - 1.0
    return grid.xy(_simplified(corners, _STRAIGHT_CELLS))


def _traced(mask: Mask) -> Array:
    """Return the corners of the cells along the edge of a region without holes, in order: x and y counterclockwise."""
    rows, columns = np.nonzero(mask)
    steps: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for r, c in zip(rows.tolist(), columns.tolist(), strict=True):
        sides = (
            (mask[r - 1, c], (r, c), (r, c + 1)),
            (mask[r, c + 1], (r, c + 1), (r + 1, c + 1)),
            (mask[r + 1, c], (r + 1, c + 1), (r + 1, c)),
            (mask[r, c - 1], (r + 1, c), (r, c)),
        )
        for inner, start, end in sides:
            if not inner:
                steps.setdefault(start, []).append(end)
    at = start = min(steps)
    came, way = (0, 0), []
    while True:
        way.append(at)
        ends = steps[at]
        # Where two cells touch at a corner the way turns into the cell that it goes round.
        ends.sort(key=lambda e: came[0] * (e[1] - at[1]) - came[1] * (e[0] - at[0]))
        following = ends.pop(0)
        came, at = (following[0] - at[0], following[1] - at[1]), following
        if at == start:
            return np.array(way, np.float64)


def _simplified(way: Array, tolerance: float) -> Array:
    """Return a closed way without corners from which it deviates by no more than this (Ramer, Douglas, Peucker)."""
    far = int(np.argmax(np.linalg.norm(way - way[0], axis=1)))
    closed = np.concatenate([way, way[:1]])
    keep = np.zeros(len(closed), bool)
    keep[[0, far]] = True
    spans = [(0, far), (far, len(way))]
    while spans:
        a, b = spans.pop()
        across = closed[b] - closed[a]
        away = closed[a + 1 : b] - closed[a]
        if not len(away):
            continue
        length = float(np.hypot(*across))
        off = np.abs(across[0] * away[:, 1] - across[1] * away[:, 0]) / max(length, 1e-9)
        n = int(np.argmax(off))
        if off[n] > tolerance:
            keep[a + 1 + n] = True
            spans += [(a, a + 1 + n), (a + 1 + n, b)]
    return closed[:-1][keep[:-1]]


def encloses(polygon: Array, places: ArrayLike) -> NDArray[np.bool_]:
    """Return which places lie inside a polygon, (N, 2), by how often its sides cross a ray. Shape (P, 2) -> (P,)."""
    x, y = np.atleast_2d(np.asarray(places, np.float64))[:, :2].T
    inside = np.zeros(len(x), bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if crosses.any():
            inside ^= crosses & (x < ax + (y - ay) * (bx - ax) / (by - ay if by != ay else 1.0))
    return inside


def area_of(polygon: Array) -> float:
    """Return the area of a polygon, positive where it is counterclockwise."""
    x, y = polygon.T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
