"""The space in which people can be, on a grid seen from above: what sight passed through, and the walls around it.

What a camera sees of a surface says that nothing stands in between. Sight below a door's lintel goes over tables and
beds, but through no wall, so the cells that it crosses are those of rooms, whatever stands there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array

Mask = NDArray[np.bool_]
CELL_M = 0.05
"""Edge of a cell: half of the thinnest walls."""
LINTEL_M = 2.0
"""Doors are about 2 m high (DIN 18100: 2.01 m): higher up sight passes over what divides rooms."""
_TALL_M = 1.2
"""What is taller than counters (0.9 m) and the backs of chairs may be a wall."""
_FLOOR_M = 0.1
"""What is so near the floor is floor."""
_SHORT_M = 0.1
"""Sight is followed up to so far before the surface, which is as known as that."""
_STEP = 0.7
"""Steps along sight, in cells."""
_FARTHEST_M = 6.0
_NOISE = 2
"""Crossed so often a cell is free, hit so often there is something."""
_GAP_CELLS = 3
"""Walls are taken as whole over gaps of twice this: 0.3 m, half of a door."""


@dataclass(frozen=True)
class Grid:
    """Where the cells are; rows go along y, columns along x."""

    low: Array
    """World x and y of the corner of cell (0, 0). Shape (2,)."""
    shape: tuple[int, int]
    cell: float
    """Edge of a cell, world units."""

    @staticmethod
    def over(points: Array, cell: float) -> Grid:
        """Return the grid that holds points, (N, 2), with room around them."""
        low = np.floor(points.min(axis=0) / cell) * cell - 4 * cell
        columns, rows = np.ceil((points.max(axis=0) - low) / cell).astype(int) + 4
        return Grid(low, (int(rows), int(columns)), cell)

    def cells(self, points: Array) -> NDArray[np.int64]:
        """Return row and column of points, those outside at the rim. Shape (N, 2+) -> (N, 2)."""
        at = np.floor((points[:, :2] - self.low) / self.cell).astype(np.int64)
        return np.clip(at, 0, np.array(self.shape[::-1]) - 1)[:, ::-1]

    def count(self, points: Array) -> NDArray[np.int64]:
        """Return how many points each cell holds."""
        rows, columns = self.cells(points).T
        flat = np.bincount(rows * self.shape[1] + columns, minlength=self.shape[0] * self.shape[1])
        return flat.reshape(self.shape)

    def xy(self, cells: Array) -> Array:
        """Return x and y of places given in (fractional) rows and columns; the middle of cell (0, 0) is at 0.5."""
        return np.asarray(self.low + np.asarray(cells)[..., ::-1] * self.cell)


@dataclass(frozen=True)
class Sight:
    """What one camera saw."""

    camera: Array
    """World. Shape (3,)."""
    points: Array
    """Surface points, world. Shape (N, 3)."""


@dataclass(frozen=True)
class Space:
    """One storey from above."""

    grid: Grid
    free: Mask
    """What sight crossed or stands in a room."""
    wall: Mask
    """Tall surfaces."""
    seen: Mask = field(repr=False)
    """Where a surface over the floor was seen."""


def find_space(sights: Sequence[Sight], floor: float, unit: float, things: Array) -> Space:
    """Return the space of a storey whose floor is at z = `floor`; `things` are points of what stands in it, (N, 3)."""
    from scipy.ndimage import binary_closing

    points = np.concatenate([s.points for s in sights])
    grid = Grid.over(np.concatenate([points[:, :2], *(s.camera[None, :2] for s in sights)]), CELL_M * unit)
    crossed = np.zeros(grid.shape, np.int64)
    for s in sights:
        crossed += grid.count(_passed(s, floor, unit)) > 0
    height = (points[:, 2] - floor) / unit
    inside = (height > -_FLOOR_M) & (height < LINTEL_M)
    tall, low = grid.count(points[inside & (height > _TALL_M)]), grid.count(points[inside & (height < _FLOOR_M)])
    wall = np.asarray(binary_closing((tall >= _NOISE) & (crossed < tall), iterations=_GAP_CELLS))
    of_things = things[(things[:, 2] > floor) & (things[:, 2] < floor + _TALL_M * unit)]
    held = (crossed >= _NOISE) | (low >= _NOISE) | (grid.count(of_things) >= 1)
    return Space(grid, held & ~wall, wall, grid.count(points[inside & (height > _FLOOR_M)]) > 0)


def _passed(sight: Sight, floor: float, unit: float) -> Array:
    """Return places along the sight of a camera that lie at the height of people. Shape (M, 3)."""
    along = sight.points - sight.camera
    length = np.linalg.norm(along, axis=1)
    keep = (length > 2 * _SHORT_M * unit) & (length < _FARTHEST_M * unit)
    along, length = along[keep] / length[keep, None], length[keep] - _SHORT_M * unit
    steps = np.arange(0.0, _FARTHEST_M * unit, _STEP * CELL_M * unit)
    which, step = np.nonzero(steps[None, :] < length[:, None])
    places = sight.camera + along[which] * steps[step, None]
    height = places[:, 2] - floor
    return np.asarray(places[(height > 0) & (height < LINTEL_M * unit)])
