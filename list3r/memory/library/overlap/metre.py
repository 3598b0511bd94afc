"""What a metre is in a chunk of relative scale: by the depth of what was seen, and by the height over a wide floor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.geometry import Array

Floats = NDArray[np.float32]

ROOM_DEPTH_M = 2.0
"""Median depth of what is seen in a room of a home. In offices, shops and halls it is 1.3 to 5 m."""
CAMERA_M = 1.4
"""Height at which people hold a camera; medians of recordings of others are 1.10, 1.42, 1.47 and 1.57 m (TUM
fr3_cabinet, 7-Scenes RedKitchen, TUM fr2_desk and fr1_xyz)."""
DEPTH_SPREAD, CAMERA_SPREAD = 0.45, 0.15
"""Standard deviation of the logarithms of both, over all kinds of rooms."""
WIDE = 6.0
"""A level surface of fewer squares of the cameras' height above it may be a table that fills the picture: seen from
half a metre, one of 1.5 m2."""
_POINTS, _AROUND, _TRIES, _LEAST = 2000, 10, 60, 20
"""Points that tell where a floor may be, those around each that tell its normal, tries, and points of a floor."""
_LEVEL_DEG, _TILT_DEG = 10.0, 35.0
"""How far normals of a floor are from its own, and that from the cameras' mean up."""
_THICK, _BELOW = 0.06, 0.03
"""Of the cameras' height: thickness of a floor. Share of the points that may lie below it."""
_CELL = 0.25
"""Edge of the cells that measure a floor, of the cameras' height."""
_MOST_APART = 2.0
"""Deviations between what height and depths say, see `metre_by_height`."""


def metre_by_sight(points: Array | Floats, depth: Array | Floats, T_chunk_cam: Array) -> float:
    """Return about what a metre is in chunk units.

    `points` (N, 3) are what posed cameras (F, 4, 4) saw, `depth` (N,) how far along z, chunk units. The median depth
    counts as two metres, which is wrong by a third in many rooms and by far in halls. Where the floor was seen, the
    cameras' height tells more.
    """
    seen = depth > 0
    if not seen.any():
        return 1.0
    unit = float(np.median(depth[seen])) / ROOM_DEPTH_M
    return metre_by_height(height_over_floor(points[seen], T_chunk_cam), unit)


def metre_by_height(height: float | None, unit: float) -> float:
    """Return what a metre is by how high the cameras were, too, in units; `unit` is what it is by the depths.

    Where both are too far apart, the camera was not held by a person, or the floor is none.
    """
    more = math.log(height / CAMERA_M / unit) if height is not None and height > 0 else 0.0
    if abs(more) > _MOST_APART * math.hypot(CAMERA_SPREAD, DEPTH_SPREAD):
        return unit
    return unit * math.exp(more / (1.0 + (CAMERA_SPREAD / DEPTH_SPREAD) ** 2))


def height_over_floor(points: Array | Floats, T_chunk_cam: Array) -> float | None:
    """Return the median height of the cameras over the floor; None where too little of one was seen."""
    if len(points) < _POINTS // 10 or len(T_chunk_cam) == 0:
        return None
    up = -T_chunk_cam[:, :3, 1].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    few = np.asarray(points[:: max(1, len(points) // _POINTS)], np.float64)
    normals = _normals(few, up)
    best, support = None, 0
    flat = np.flatnonzero(normals @ up > math.cos(math.radians(_TILT_DEG)))
    for row in flat[:: max(1, len(flat) // _TRIES)].tolist():
        floor = _floor_at(few, normals, row, T_chunk_cam[:, :3, 3])
        if floor is not None and floor[3] > support:
            best, support = floor, floor[3]
    if best is None:
        return None
    normal, level, height, _ = best
    on = np.abs(points @ normal - level) < 0.5 * _THICK * height
    axes = np.linalg.svd(normal[None])[2][1:]
    cells = np.unique(np.floor(points[on] @ axes.T / (_CELL * height)).astype(np.int64), axis=0)
    return height if len(cells) * _CELL**2 > WIDE else None


def _floor_at(points: Array, normals: Array, row: int, centers: Array) -> tuple[Array, float, float, int] | None:
    """Return normal, level, height of the cameras and points of the level surface through a point, if it is a floor.

    Nearly all points lie above it.
    """
    normal, near = normals[row], math.cos(math.radians(_LEVEL_DEG))
    for _ in range(2):
        along = points @ normal
        level = float(along[row])
        height = float(np.median(centers @ normal)) - level
        on = (np.abs(along - level) < 0.5 * _THICK * height) & (normals @ normal > near)
        if on.sum() < _LEAST:
            return None
        level = float(np.median(along[on]))
        if (along < level - _THICK * height).mean() > _BELOW:
            return None
        turned = np.linalg.svd(points[on] - points[on].mean(axis=0), full_matrices=False)[2][2]
        found = normal, level, height, int(on.sum())
        normal = turned if turned @ normal > 0 else -turned
    return found


def _normals(points: Array, up: Array) -> Array:
    """Return normals that point up. Shape (N, 3)."""
    _, near = cKDTree(points).query(points, k=min(_AROUND, len(points)))
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    return np.asarray(normals * np.where(normals @ up < 0, -1.0, 1.0)[:, None])
