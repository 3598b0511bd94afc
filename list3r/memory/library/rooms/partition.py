"""Free space cut into rooms at doorways.

The distance of each free cell to what is not free has a peak in each room and a saddle in each passage (Hughes et al.,
Hydra, RSS 2022, follow it by dilating the walls). Passages are taken from the widest to the narrowest; each joins what
it lies between, unless it is a doorway: as narrow as one, narrower than what it opens from, and between walls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array
from list3r.memory.library.rooms.space import Space

Labels = NDArray[np.int32]
DOOR_M = (0.6, 1.3)
"""Doorways are 0.6 to 1.2 m wide (DIN 18101: 0.61 to 1.24 m); a cell and a half more, by which walls are misplaced."""
_NARROWER_M = 0.3
"""A doorway is narrower than the wider space beside it by this; beyond it there may be a glimpse of a room alone."""
_JAMB_M = 0.25
"""Walls begin so near to the edge of a doorway,"""
_OPPOSITE = -0.5
"""and lie on opposite sides: the cosine between them is at most this."""
LEAST_M2 = 2.0
"""The smallest rooms: a toilet."""
_PEAK_M = 0.3
"""Half of what a person needs to pass: what is nowhere so wide is a nook of what it opens to."""


@dataclass(frozen=True)
class Passage:
    """The widest way from one region into another."""

    a: int
    b: int
    row: int
    column: int
    width: float
    """World units."""


def cut(space: Space, unit: float) -> tuple[Labels, list[Passage]]:
    """Return the room of each cell, counted from 1 by size, 0 where there is none, and the doorways between rooms."""
    from scipy.ndimage import distance_transform_edt

    reach = np.asarray(distance_transform_edt(np.pad(space.free, 1))[1:-1, 1:-1]) * space.grid.cell
    basins = _basins(reach)
    peak = np.zeros(int(basins.max()) + 1)
    np.maximum.at(peak, basins, reach)
    root = np.arange(len(peak))
    parted: list[Passage] = []
    for p in sorted(_passages(basins, reach, stretches=False), key=lambda p: (-p.width, p.a, p.b)):
        a, b = _root(root, p.a), _root(root, p.b)
        if a == b or any({a, b} == {_root(root, d.a), _root(root, d.b)} for d in parted):
            continue
        wider = float(max(peak[a], peak[b]))
        if _is_doorway(p, wider, space, unit):
            parted.append(p)
        elif p.width >= DOOR_M[0] * unit or min(peak[a], peak[b]) < _PEAK_M * unit:
            root[max(a, b)], peak[min(a, b)] = min(a, b), wider
    least, size = LEAST_M2 * (unit / space.grid.cell) ** 2, np.bincount(basins.ravel(), minlength=len(peak))
    for p in parted:
        areas = np.bincount([_root(root, n) for n in range(len(root))], size * (np.arange(len(root)) > 0))
        a, b = _root(root, p.a), _root(root, p.b)
        if a != b and min(areas[a], areas[b]) < least:
            root[max(a, b)] = min(a, b)
    labels = np.array([_root(root, n) for n in range(len(root))])[basins]
    areas = np.bincount(labels.ravel(), minlength=len(peak))
    order = [n for n in np.argsort(-areas, kind="stable").tolist() if n and areas[n] >= least]
    number = np.zeros(len(peak), np.int32)
    number[order] = np.arange(1, len(order) + 1)
    rooms = number[labels]
    return rooms, [p for p in _passages(rooms, reach, stretches=True) if _is_doorway(p, np.inf, space, unit)]


def _root(root: NDArray[np.int64], n: int) -> int:
    while root[n] != n:
        n = int(root[n])
    return n


def _basins(reach: Array) -> Labels:
    """Return free cells by the peak that is reached from them by going up steepest. From 1, 0 where nothing is free."""
    from scipy.ndimage import label

    rows, columns = reach.shape
    padded = np.pad(reach, 1)
    around = [(r, c) for r in (0, 1, -1) for c in (0, 1, -1)]
    heights = np.stack([padded[1 + r : rows + 1 + r, 1 + c : columns + 1 + c] for r, c in around])
    best = np.argmax(heights, axis=0)
    up = np.arange(reach.size).reshape(reach.shape) + np.array([r * columns + c for r, c in around])[best]
    flat = np.where(reach > 0, up, np.arange(reach.size).reshape(reach.shape)).ravel()
    while not np.array_equal(flat, flat[flat]):
        flat = flat[flat]
    tops, _ = label((best == 0) & (reach > 0), np.ones((3, 3)))
    return np.where(reach > 0, tops.ravel()[flat].reshape(reach.shape), 0).astype(np.int32)


def _passages(regions: Labels, reach: Array, *, stretches: bool) -> list[Passage]:
    """Return the widest place where two regions meet, or of each stretch along which they do."""
    from scipy.ndimage import label

    meets: dict[tuple[int, int], list[tuple[float, int, int]]] = {}
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        left, right = max(0, -dc), regions.shape[1] - max(0, dc)
        here, there = regions[: regions.shape[0] - dr, left:right], regions[dr:, left + dc : right + dc]
        rows, columns = np.nonzero((here != there) & (here > 0) & (there > 0))
        ends = np.sort(np.stack([here[rows, columns], there[rows, columns]], axis=1), axis=1)
        widths = 2 * np.minimum(reach[rows, columns + left], reach[rows + dr, columns + left + dc])
        for (a, b), width, row, column in zip(
            ends.tolist(), widths.tolist(), rows.tolist(), (columns + left).tolist(), strict=True
        ):
            meets.setdefault((a, b), []).append((width, row, column))
    out = []
    for (a, b), found in sorted(meets.items()):
        if not stretches:
            width, row, column = max(found)
            out.append(Passage(a, b, row, column, width))
            continue
        mask = np.zeros(regions.shape, bool)
        mask[[row for _, row, _ in found], [column for _, _, column in found]] = True
        parts, _ = label(mask, np.ones((3, 3)))
        best: dict[int, tuple[float, int, int]] = {}
        for meeting in found:
            part = int(parts[meeting[1:]])
            best[part] = max(meeting, best.get(part, meeting))
        out += [Passage(a, b, row, column, width) for width, row, column in best.values()]
    return out


def _is_doorway(p: Passage, peak: float, space: Space, unit: float) -> bool:
    """Return whether a passage is a doorway; the wider space beside it is at most `peak` from its walls."""
    if not DOOR_M[0] * unit <= p.width <= DOOR_M[1] * unit or 2 * peak - p.width < _NARROWER_M * unit:
        return False
    cells = (p.width / 2 + _JAMB_M * unit) / space.grid.cell
    top, left = max(0, int(p.row - cells)), max(0, int(p.column - cells))
    window = space.wall[top : int(p.row + cells) + 2, left : int(p.column + cells) + 2]
    away = np.argwhere(window) + np.array([top - p.row, left - p.column])
    far = np.linalg.norm(away, axis=1)
    jambs = (away / np.maximum(far, 1.0)[:, None])[(far > 0) & (far <= cells)]
    return bool(len(jambs)) and float((jambs @ jambs.T).min()) <= _OPPOSITE
