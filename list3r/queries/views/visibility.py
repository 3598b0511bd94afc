"""Render what a camera would see: supports projected into its picture, each hidden by what is before it.

The picture is a depth buffer at a fraction of the image's size. Every surface point covers a square as wide as its
thing's points are apart, so that surfaces are closed as far as they are known; a thing shows where it is the nearest,
up to the noise of depth. Structure hides things too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.views.camera import PosedCamera
from list3r.queries.views.surfaces import inside_box

_WIDTH = 160
"""Cells across the depth buffer."""
_NEAR = 0.02
"""Nothing nearer than this share of the median depth is drawn: the camera is inside of it."""
_MAX_REACH = 40
"""Cells that one point reaches to each side at most."""
_BY_CELLS = 6
"""Points that reach further, few and near, are drawn one by one."""
_FEW = 9
"""With fewer points than this the box stands for the surface, this many points along each edge."""
_MANY = 5_000
"""In memories of more things than this those that would hardly show are not looked at."""
_LEAST_CELLS = 2.0
"""Their width."""
_MARGIN = 0.05
"""Share of the far end of the frustum by which it is searched further."""
_NOISE = 0.02
"""Depth noise between views over depth."""


@dataclass(frozen=True)
class Visibility:
    """How one thing shows in a picture."""

    instance: Instance
    inside: float
    """Share of its surface points in the picture, in [0, 1]."""
    visible: float
    """Share of its outline within the picture that nothing hides, in [0, 1]."""
    picture: float
    """Share of the picture that it fills, in [0, 1]."""
    distance: float
    """From the camera to its nearest point that shows, world units."""
    box_xyxy: tuple[float, float, float, float]
    """Round what shows of it, px of the image."""


@dataclass(frozen=True)
class _Drawn:
    instance: Instance
    inside: float
    cells: NDArray[np.int64]
    depth: NDArray[np.float64]


def look(
    store: Store,
    camera: PosedCamera,
    instances: Sequence[Instance],
    *,
    max_depth: float | None = None,
    occlusion: bool = True,
) -> list[Visibility]:
    """Return the instances of which something shows, by id; those of other components than the camera's cannot be seen.

    `instances` are all that may hide or show. `max_depth` is the far end of the frustum, world units along z. Without
    `occlusion` nothing hides anything.
    """
    step = max(1.0, camera.image_size[1] / _WIDTH)
    height, width = (max(1, int(np.ceil(n / step))) for n in camera.image_size)
    drawn = [
        d
        for i in instances
        if i.component == camera.component
        if (d := _draw(store, camera, i, step, (height, width), max_depth))
    ]
    nearest = np.full(height * width, np.inf)
    for d in drawn:
        np.minimum.at(nearest, d.cells, d.depth)
    out = []
    for d in drawn:
        shows = d.depth <= nearest[d.cells] * (1.0 + _NOISE) if occlusion else np.ones(len(d.cells), dtype=bool)
        if not shows.any():
            continue
        rows, columns = np.divmod(d.cells[shows], width)
        x0, y0, x1, y1 = columns.min() * step, rows.min() * step, (columns.max() + 1) * step, (rows.max() + 1) * step
        box = (float(x0), float(y0), float(min(x1, camera.image_size[1])), float(min(y1, camera.image_size[0])))
        share, part = float(shows.mean()), float(shows.sum()) / (height * width)
        out.append(Visibility(d.instance, d.inside, share, part, float(d.depth[shows].min()), box))
    return out


def in_front(store: Store, camera: PosedCamera, max_depth: float | None = None) -> list[Instance]:
    """Return what may show or hide in a picture, by id: what the R*Tree finds in the box around the frustum.

    In a memory of more than `_MANY` things those are left out that are narrower there than two cells of the buffer.
    """
    bounds = store.instances.bounds()
    if bounds is None:
        return []
    step = max(1.0, camera.image_size[1] / _WIDTH)
    ends = np.abs(bounds - camera.place).max(axis=0)
    far = float(np.linalg.norm(ends)) if max_depth is None else (1.0 + _MARGIN) * max_depth
    many = store.ids.largest() > _MANY
    fx, fy, cx, cy = camera.intrinsics
    height, width = camera.image_size
    beside = _MAX_REACH * step
    u, v = np.array([-beside, width + beside]), np.array([-beside, height + beside])
    rays = np.array([[(x - cx) / fx, (y - cy) / fy, 1.0] for x in u for y in v]) * far
    corners = np.vstack([rays @ camera.T_world_cam[:3, :3].T + camera.place, camera.place])
    slack = _MARGIN * far
    ids, boxes = store.instances.boxes_in_box(corners.min(axis=0) - slack, corners.max(axis=0) + slack)
    if many:
        apart = np.maximum(0.0, np.maximum(boxes[:, 0] - camera.place, camera.place - boxes[:, 1]))
        away = np.linalg.norm(apart, axis=1)
        wide = np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1) * fx >= _LEAST_CELLS * step * away
        ids = ids[wide & (_depths(boxes, camera).max(axis=1) > 0.0)]
    return [i for i in store.instances.of(sorted(ids.tolist())) if i.state != "removed"]


def _depths(boxes: NDArray[np.float64], camera: PosedCamera) -> NDArray[np.float64]:
    """Return depths of the corners of boxes (N, 2, 3). Shape (N, 8)."""
    ahead = camera.T_world_cam[:3, 2]
    parts = (boxes - camera.place) * ahead
    sums = parts[:, :, None, None, 0] + parts[:, None, :, None, 1] + parts[:, None, None, :, 2]
    return np.asarray(sums.reshape(len(boxes), 8))


def _draw(
    store: Store, camera: PosedCamera, instance: Instance, step: float, size: tuple[int, int], max_depth: float | None
) -> _Drawn | None:
    """Return the cells that an instance covers when nothing else is there, and its depth in each; None for none."""
    R, t = camera.T_world_cam[:3, :3], camera.T_world_cam[:3, 3]
    corners = (instance.box.corners() - t) @ R
    if corners[:, 2].max() <= 0.0 or (max_depth is not None and corners[:, 2].min() > max_depth * (1.0 + _MARGIN)):
        return None
    world, spacing = _surface(store, instance)
    points = (world - t) @ R
    fx, fy, cx, cy = camera.intrinsics
    ahead = points[:, 2] > max(1e-9, _NEAR * float(np.median(np.abs(points[:, 2]))))
    if max_depth is not None:
        ahead &= points[:, 2] <= max_depth
    x, y, z = points[ahead].T
    u, v = (fx * x / z + cx + 0.5) / step, (fy * y / z + cy + 0.5) / step
    within = (u >= 0) & (v >= 0) & (u < size[1]) & (v < size[0])
    reach = np.clip(np.round(0.5 * spacing * fx / (step * z)), 0, _MAX_REACH).astype(np.int64)
    meets = (u >= -reach) & (v >= -reach) & (u < size[1] + reach) & (v < size[0] + reach)
    if not meets.any():
        return None
    column, row = np.floor(u[meets]).astype(np.int64), np.floor(v[meets]).astype(np.int64)
    buffer = _splat(column, row, z[meets], reach[meets], size)
    cells = np.flatnonzero(np.isfinite(buffer))
    return _Drawn(instance, float(within.sum()) / len(points), cells, buffer[cells])


def _splat(
    column: NDArray[np.int64],
    row: NDArray[np.int64],
    depth: NDArray[np.float64],
    reach: NDArray[np.int64],
    size: tuple[int, int],
) -> NDArray[np.float64]:
    """Return least depth in each cell when every point covers `reach` cells to each side; infinite where nothing is."""
    height, width = size
    buffer = np.full((height, width), np.inf)
    flat = buffer.ravel()
    for r in np.unique(reach[reach <= _BY_CELLS]).tolist():
        at = reach == r
        for dy in range(-r, r + 1):
            for dx in range(-r, r + 1):
                c, w = column[at] + dx, row[at] + dy
                fits = (c >= 0) & (w >= 0) & (c < width) & (w < height)
                np.minimum.at(flat, w[fits] * width + c[fits], depth[at][fits])
    for k in np.flatnonzero(reach > _BY_CELLS).tolist():
        c, w, r = int(column[k]), int(row[k]), int(reach[k])
        part = buffer[max(w - r, 0) : w + r + 1, max(c - r, 0) : c + r + 1]
        np.minimum(part, depth[k], out=part)
    return flat


def _surface(store: Store, instance: Instance) -> tuple[NDArray[np.float64], float]:
    """Return the surface points in the world (N, 3), those of the box where nothing was measured, and how far they lie
    apart: of most of them the second neighbour is nearer, so that squares of that width close the surface.
    """
    known = store.surfaces.of_instance(instance).points
    points = known[inside_box(known, instance)].astype(np.float64)
    if len(points) < _FEW:
        side = np.linspace(-0.5, 0.5, _FEW)
        grid = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
        grid = grid[np.abs(grid).max(axis=1) > 0.499]
        return instance.box.center + (grid * instance.box.size) @ instance.box.rotation.T, float(
            np.max(instance.box.size) / (_FEW - 1)
        )
    sample = points[:: -(-len(points) // 200)]
    return points, float(np.quantile(np.asarray(cKDTree(points).query(sample, k=3)[0])[:, -1], 0.9))
