"""Distances between objects of a simulated world, from their true shapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.simulation.worlds.objects import BOX, SPHERE, Part, SimulatedObject

Array = NDArray[np.float64]

_SLICES = 33
"""Discs that represent a sphere: they are within a hundredth of its radius of it."""


@dataclass(frozen=True)
class _Slabs:
    """Upright solids: each a rectangle, or a point, widened by a radius, between two heights. N of them."""

    corners: Array
    """Of the rectangles, in order, world, metres; four times the same for a point. Shape (N, 4, 2)."""
    radius: Array
    """Metres. Shape (N,)."""
    low: Array
    high: Array
    """World z, metres. Shape (N,) each."""


def surface_gap(a: SimulatedObject, b: SimulatedObject) -> float:
    """Distance between the surfaces of two objects, metres, 0 where they touch or reach into each other.

    Exact for boxes and cylinders, to a few tenths of a millimetre for spheres; open vessels count as full.
    """
    p, q = _slabs(a), _slabs(b)
    above = np.maximum(p.low[:, None] - q.high[None], q.low[None] - p.high[:, None])
    aside = _rectangle_gaps(p.corners, q.corners) - p.radius[:, None] - q.radius[None]
    return float(np.hypot(np.maximum(above, 0.0), np.maximum(aside, 0.0)).min())


def _slabs(obj: SimulatedObject) -> _Slabs:
    rows = [row for part in obj.parts for row in _rows(part)]
    rotation, place = obj.rotation()[:2, :2], np.array(obj.position)
    corners = np.array([r[0] for r in rows]) @ rotation.T + place[:2]
    radius, low, high = (np.array([r[k] for r in rows], dtype=np.float64) for k in (1, 2, 3))
    return _Slabs(corners, radius, low + place[2], high + place[2])


def _rows(part: Part) -> list[tuple[Array, float, float, float]]:
    """(corners (4, 2), radius, low, high) of the slabs of a part, in the frame of its object."""
    x, y, z = part.center
    hx, hy, hz = part.half
    if part.kind == BOX:
        c, s = np.cos(part.yaw), np.sin(part.yaw)
        local = np.array([[hx, hy], [-hx, hy], [-hx, -hy], [hx, -hy]])
        return [(local @ np.array([[c, s], [-s, c]]) + (x, y), 0.0, z - hz, z + hz)]
    point = np.tile([float(x), float(y)], (4, 1))
    if part.kind != SPHERE:
        return [(point, hx, z - hz, z + hz)]
    turn = np.linspace(-np.pi / 2, 0.0 if part.open_top else np.pi / 2, _SLICES)
    return [(point, float(hx * np.cos(t)), float(z + hx * np.sin(t)), float(z + hx * np.sin(t))) for t in turn]


def _rectangle_gaps(a: Array, b: Array) -> Array:
    """Distances between rectangles or points in the plane, 0 where they overlap. (N, 4, 2), (M, 4, 2) -> (N, M)."""
    nearest = np.minimum(_corner_to_side(a, b), _corner_to_side(b, a).T)
    return np.asarray(np.where(_overlap(a, b), 0.0, nearest))


def _corner_to_side(a: Array, b: Array) -> Array:
    """Least distance of a corner of each of `a` from a side of each of `b`. Shape (N, M)."""
    start, along = b, np.roll(b, -1, axis=1) - b
    away = a[:, None, :, None] - start[None, :, None]
    length = np.maximum((along**2).sum(axis=2), 1e-18)
    share = np.clip((away * along[None, :, None]).sum(axis=4) / length[None, :, None], 0.0, 1.0)
    gap = np.linalg.norm(away - share[..., None] * along[None, :, None], axis=4)
    return np.asarray(gap.min(axis=(2, 3)))


def _overlap(a: Array, b: Array) -> NDArray[np.bool_]:
    """Return whether two rectangles, or a rectangle and a point, overlap; two points never do. Shape (N, M)."""
    wide = np.any(a[:, 0] != a[:, 2], axis=1)[:, None] | np.any(b[:, 0] != b[:, 2], axis=1)[None]
    return np.asarray(~(_parted(a, b) | _parted(b, a).T) & wide)


def _parted(a: Array, b: Array) -> NDArray[np.bool_]:
    """Return whether a side of each of `a` has all of each of `b` beyond it. Shape (N, M)."""
    out = np.zeros((len(a), len(b)), dtype=bool)
    for k in (0, 1):
        axis = a[:, k + 1] - a[:, k]
        own, other = np.einsum("nd,nkd->nk", axis, a), np.einsum("nd,mkd->nmk", axis, b)
        out |= (other.min(axis=2) > own.max(axis=1)[:, None]) | (other.max(axis=2) < own.min(axis=1)[:, None])
    return out
