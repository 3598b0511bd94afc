"""What is known of the space in and around an instance, by voxels: its surface, what was seen through, other things."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from list3r.compiled import compiled
from list3r.memory.core.geometry import Array
from list3r.memory.library.overlap.visibility import DepthView, VisibilitySettings, tally

Mask = NDArray[np.bool_]

_SIGHT = VisibilitySettings(tolerance_m=0.012, noise_per_m2=0.003)
"""Frames of the instance's own chunks are asked, which lie better than those of two sessions."""
_LEAST = 2
"""Frames, or rays, that agree on free space: one may be a mistake of depth at an edge."""
_AROUND_M = 0.08
"""So much of what lies around is asked too: a surface has free space before it."""


_FEW = 0.2
"""Of the points of the fullest voxel beside it."""


@dataclass(frozen=True)
class VoxelSettings:
    """How fine voxels are."""

    along: int = 40
    """Along the longest side."""
    finest_m: float = 0.007
    coarsest_m: float = 0.03


@dataclass(frozen=True)
class Evidence:
    """Voxels along the axes of an instance, the last one up. Masks have shape (X, Y, Z)."""

    axes: Array
    """Columns: the axes in the world. Shape (3, 3)."""
    low: Array
    """Middle of the first voxel along the axes. Shape (3,)."""
    edge: float
    """Of a voxel, world units."""
    metre: float
    """World units."""
    rim: int
    """So many layers on each side lie around the instance."""
    shell: Mask
    """Surface points of the instance."""
    free: Mask
    """Seen through."""
    other: Mask
    """Surface points of other things."""

    def index(self, points: Array) -> NDArray[np.int64]:
        """Return the voxels of points, world; some may lie outside. Shape (N, 3) -> (N, 3)."""
        return np.rint((points @ self.axes - self.low) / self.edge).astype(np.int64)

    def world(self, places: Array) -> Array:
        """Return places given in (fractional) voxels, world. Shape (N, 3)."""
        return np.asarray((self.low + self.edge * np.asarray(places)) @ self.axes.T)


def gather(
    points: Array,
    others: Array,
    views: Sequence[DepthView],
    axes: Array,
    stands: float,
    metre: float,
    settings: VoxelSettings | None = None,
) -> Evidence:
    """Return what is known about an instance's space.

    `points` and `others` are surface points of it and of other things, world, (N, 3); `stands` is the height of what
    it stands on; `metre` is one in world units.
    """
    s = settings or VoxelSettings()
    local = points @ axes
    top = local.max(axis=0)
    bottom = np.minimum(local.min(axis=0), [np.inf, np.inf, stands])
    edge = float(np.clip((top - bottom).max() / s.along, s.finest_m * metre, s.coarsest_m * metre))
    around = int(np.ceil(_AROUND_M * metre / edge))
    count = np.ceil((top - bottom) / edge).astype(int)  # the middle of the instance is that of the grid
    low = (top + bottom) / 2 - edge * (count / 2 + around)
    low[2] = bottom[2] + edge * (0.5 - around)
    shape = tuple((count + 1 + 2 * around).tolist())
    grid = Evidence(axes, low, edge, metre, around, *(np.zeros(shape, bool) for _ in range(3)))
    grid.shell[:] = _surface(grid.index(points), shape)
    _mark(grid.other, grid.index(others))
    grid.other[grid.shell] = False
    places = grid.world(np.indices(shape).reshape(3, -1).T)
    free, met = tally(places, views, _SIGHT)
    rays = np.zeros(shape, np.int32)
    one_each = points[np.unique(np.ravel_multi_index(tuple(grid.index(points).T), shape), return_index=True)[1]]
    for view in views:
        eye = view.S_cam_world.inverse().translation
        slack = (_SIGHT.tolerance_m * view.unit, _SIGHT.noise_per_m2 / view.unit)
        in_camera = view.S_cam_world.apply(one_each)
        cells = [np.ascontiguousarray((p @ axes - low) / edge) for p in (eye[None], one_each)]
        _march(in_camera, view.depth, view.camera, slack, cells[0][0], cells[1], rays)
    grid.free[:] = ((free >= _LEAST) & (free > met)).reshape(shape) | (rays >= _LEAST)
    grid.free[grid.shell] = False
    return grid


def _surface(index: NDArray[np.int64], shape: tuple[int, ...]) -> Mask:
    """Return the voxels with points, without those that have few beside one with many: noise of the same surface."""
    counts = np.zeros(shape, np.int64)
    np.add.at(counts, tuple(index.T), 1)
    return np.asarray((counts > 0) & (counts >= _FEW * ndimage.maximum_filter(counts, 3)))


def _mark(mask: Mask, index: NDArray[np.int64]) -> None:
    inside = ((index >= 0) & (index < mask.shape)).all(axis=1)
    mask[tuple(index[inside].T)] = True


@compiled
def _march(
    in_camera: Array,
    depth: NDArray[np.float32],
    camera: tuple[float, float, float, float],
    slack: tuple[float, float],
    eye: Array,
    cells: Array,
    rays: NDArray[np.int32],
) -> None:
    """Count the rays from a camera to the points that its depth confirms, in the voxels between.

    Points in the camera, in units of `depth`, and in voxels, (N, 3) each; `eye` is in voxels. A ray ends two voxels
    before its point.
    """
    fx, fy, cx, cy = camera
    for n in range(len(cells)):
        z = in_camera[n, 2]
        if z <= 0:
            continue
        u, v = int(np.rint(in_camera[n, 0] / z * fx + cx)), int(np.rint(in_camera[n, 1] / z * fy + cy))
        if not (0 <= u < depth.shape[1] and 0 <= v < depth.shape[0]):
            continue
        if abs(depth[v, u] - z) > slack[0] + slack[1] * z**2:
            continue
        way = eye - cells[n]
        length = np.sqrt((way**2).sum())
        step = 2.0
        while step < length:
            x = int(np.rint(cells[n, 0] + way[0] * step / length))
            y = int(np.rint(cells[n, 1] + way[1] * step / length))
            k = int(np.rint(cells[n, 2] + way[2] * step / length))
            if not (0 <= x < rays.shape[0] and 0 <= y < rays.shape[1] and 0 <= k < rays.shape[2]):
                break
            rays[x, y, k] += 1
            step += 0.7
