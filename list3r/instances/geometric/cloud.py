"""The chunk's cloud: the confirmed points of all anchor views on one voxel grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.fusion import View
from list3r.instances.geometric.kernels import meeting, sums_by

Float = NDArray[np.float32]

_BITS = 20
_OFFSET = 1 << (_BITS - 1)


@dataclass(frozen=True)
class Cloud:
    """N occupied voxels, ordered by key."""

    keys: NDArray[np.int64]
    """Packed grid coordinates, ascending. Shape (N,)."""
    points: Float
    """Mean of the points in each voxel, chunk coordinates. Shape (N, 3)."""
    normals: Float
    """Unit mean normals, 0 where unknown. Shape (N, 3)."""
    rgb: Float
    """Mean colour in [0, 255]. Shape (N, 3)."""
    sigma: Float
    """Mean standard deviation of the fused depth that fell here, chunk units. Shape (N,)."""
    reading: Float
    """Mean standard deviation of the single readings of depth that fell here, chunk units. Shape (N,)."""
    weight: Float
    """Points that fell here. Shape (N,)."""
    voxel: float
    """Edge of a voxel, chunk units."""
    index: tuple[NDArray[np.int32], ...]
    """For each view the voxel of each pixel, -1 for none. Shape (h, w) each."""


def pack(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sortable keys of grid coordinates. Shape (N, 3) -> (N,)."""
    shifted = cells + _OFFSET
    return np.asarray((shifted[:, 0] << (2 * _BITS)) | (shifted[:, 1] << _BITS) | shifted[:, 2])


def unpack(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Grid coordinates of keys, the inverse of `pack`. Shape (N,) -> (N, 3)."""
    low = (1 << _BITS) - 1
    return np.stack([keys >> (2 * _BITS), (keys >> _BITS) & low, keys & low], axis=1) - _OFFSET


def key_shift(offset: tuple[int, int, int]) -> int:
    """Offset from a key to that of a neighbouring cell."""
    return (offset[0] << (2 * _BITS)) + (offset[1] << _BITS) + offset[2]


def build_cloud(views: Sequence[View], voxel: float) -> Cloud:
    """Collect the confirmed points of the views on a grid of `voxel` (chunk units)."""
    chosen = [view.confirmed for view in views]
    points = _gather(views, chosen, "points")
    keys, inverse, count = np.unique(
        pack(np.floor(points / voxel).astype(np.int64)), return_inverse=True, return_counts=True
    )
    weight = count.astype(np.float32)
    normals = _mean(inverse, _gather(views, chosen, "normals"), weight)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0.3, normals / np.maximum(length, 1e-9), 0.0).astype(np.float32)
    rgb = np.concatenate([view.rgb[mask] for view, mask in zip(views, chosen, strict=True)])
    index, start = [], 0
    for mask in chosen:
        image = np.full(mask.shape, -1, np.int32)
        stop = start + int(mask.sum())
        image[mask] = inverse[start:stop]
        index.append(image)
        start = stop
    sigma = _mean(inverse, _gather(views, chosen, "sigma")[:, None], weight)[:, 0]
    reading = _mean(inverse, _gather(views, chosen, "reading")[:, None], weight)[:, 0]
    return Cloud(
        keys=keys,
        points=_mean(inverse, points, weight),
        normals=normals,
        rgb=_mean(inverse, rgb, weight),
        sigma=sigma,
        reading=reading,
        weight=weight,
        voxel=voxel,
        index=tuple(index),
    )


def _gather(views: Sequence[View], chosen: Sequence[NDArray[np.bool_]], name: str) -> Float:
    parts = [getattr(view, name)[mask] for view, mask in zip(views, chosen, strict=True)]
    return np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)


def _mean(inverse: NDArray[np.int64], values: NDArray[np.generic], weight: Float) -> Float:
    return (sums_by(inverse, np.ascontiguousarray(values), len(weight)) / weight[:, None]).astype(np.float32)


def half_offsets(radius: int) -> list[tuple[int, int, int]]:
    """One of each pair of opposite neighbours within a ball of `radius` cells (1 gives 26-connectivity)."""
    limit = max(3, radius * radius + radius)
    span = range(-radius, radius + 1)
    cells = [(i, j, k) for i in span for j in span for k in span]
    return [c for c in cells if c > (0, 0, 0) and c[0] ** 2 + c[1] ** 2 + c[2] ** 2 <= limit]


def neighbour_pairs(keys: NDArray[np.int64], radius: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of positions into ascending `keys` that are neighbours within `radius` cells. Shape (E,) each."""
    left, right = [], []
    for offset in half_offsets(radius):
        here, there = meeting(keys, key_shift(offset))
        left.append(here)
        right.append(there)
    return np.concatenate(left), np.concatenate(right)
