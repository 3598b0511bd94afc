"""Free-space carving between sessions: which surfaces of one do the frames of the other see through? Surfaces are
tested cell by cell, in the frames that may see the cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import pack
from list3r.memory.core.geometry import Array
from list3r.memory.library.overlap.point_verdicts import FREE, MET
from list3r.memory.library.overlap.visibility import DepthView, VisibilitySettings, point_visibility

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ChangedPlaceSettings:
    """When surfaces that another session sees through are an object."""

    voxel_m: float = 0.02
    """Edge of the cells in which a chunk's surfaces are asked about."""
    least_frames: int = 2
    """Frames of the other session that must see through a surface, and of its own that must see it."""
    free_share: float = 0.7
    """Share of the other session's frames observing a surface that must see through it."""
    own_free: float = 0.25
    """Share of its own session's frames up to which they may do so: else it is noise or moves."""
    link_m: float = 0.045
    """Surfaces within this distance are one object."""
    least_cells: int = 12
    """Cells of the smallest object."""
    least_side_m: float = 0.05
    """Its second longest side."""
    largest_m: float = 1.2
    """Diagonal of the largest; larger ones are doors, curtains or registration errors."""
    explained: float = 0.7
    """Share of an instance's observed points at removed or replaced surfaces, for it to explain the change."""
    mixed: float = 0.2
    """Share of a found object on another instance of the chunk that does not explain it, for a cannot-link."""
    explained_share: float = 0.35
    """A cluster of which instances explain at most this share is segmented again as a whole object."""
    part: float = 0.3
    """Share of a cluster that its unexplained rest must have, to be an object of its own."""
    least_mask_px: int = 12
    """Pixels of the small depth image in which a keyframe must see it."""
    block_m: float = 0.5
    """Edge of the cells that are tested against a frame's view."""
    max_points: int = 2500
    """Support points of one object."""
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)


@dataclass(frozen=True)
class CarvedSurfaces:
    """The surfaces of one chunk, one point for each occupied cell, world coordinates, with how frames see them."""

    points: Array
    """Shape (N, 3)."""
    free: Ints
    """Frames of other sessions that see through them. Shape (N,)."""
    met: Ints
    """Frames of other sessions that see them. Shape (N,)."""
    own: Bools
    """Whether their own session is sure of them. Shape (N,)."""


def lift(view: DepthView) -> tuple[Array, Ints, Ints]:
    """Points of a keyframe's depth in the world (N, 3), with their rows and columns."""
    fx, fy, cx, cy = view.camera
    row, column = np.nonzero(view.depth > 0)
    z = view.depth[row, column].astype(np.float64)
    p = np.stack([(column - cx) / fx * z, (row - cy) / fy * z, z], axis=1)
    return view.S_cam_world.inverse().apply(p), row, column


def ask(own: Sequence[DepthView], others: Sequence[DepthView], unit: float, s: ChangedPlaceSettings) -> CarvedSurfaces:
    """Return the surfaces that a chunk's keyframes see, and how the frames of the other sessions see them."""
    points = _cells([lift(v) for v in own], own, unit, s)
    blocks = _SurfaceBlocks(points, s.block_m * unit)
    counts = {}
    for name, views in (("own", own), ("others", others)):
        met, free = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
        for view in views:
            rows = blocks.seen_by(view, s.visibility.most_depth_m)
            seen = point_visibility(points[rows], view, s.visibility)
            met[rows[seen == MET]] += 1
            free[rows[seen == FREE]] += 1
        counts[name] = met, free
    met, free = counts["own"]
    sure = (met >= s.least_frames) & (free <= s.own_free * met)
    return CarvedSurfaces(points, counts["others"][1], counts["others"][0], sure)


class _SurfaceBlocks:
    """Points sorted into large cells, so that a frame tests only those in its view."""

    def __init__(self, points: Array, edge: float) -> None:
        block = np.floor(points / edge).astype(np.int64)
        _, first, at = np.unique(pack(block), return_index=True, return_inverse=True)
        self._order = np.argsort(at, kind="stable")
        self._bounds = np.searchsorted(at[self._order], np.arange(len(first) + 1))
        self._centers = (block[first] + 0.5) * edge
        self._radius = edge * np.sqrt(3.0) / 2

    def seen_by(self, view: DepthView, most_depth_m: float) -> Ints:
        """Rows of the points in blocks that reach into the frustum of a frame."""
        p = view.S_cam_world.apply(self._centers)
        fx, fy, cx, cy = view.camera
        height, width = view.depth.shape
        radius = self._radius * float(view.S_cam_world.scale)
        inside = (p[:, 2] > -radius) & (p[:, 2] < most_depth_m * view.unit + radius)
        for axis, focal, low, high in ((0, fx, -cx, width - cx), (1, fy, -cy, height - cy)):
            inside &= (focal * p[:, axis] - low * p[:, 2]) > -radius * np.hypot(focal, low)
            inside &= (high * p[:, 2] - focal * p[:, axis]) > -radius * np.hypot(focal, high)
        chosen = np.flatnonzero(inside)
        parts = [self._order[self._bounds[n] : self._bounds[n + 1]] for n in chosen]
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def _cells(
    lifted: Sequence[tuple[Array, Ints, Ints]], views: Sequence[DepthView], unit: float, s: ChangedPlaceSettings
) -> Array:
    """The mean point of each occupied cell, of points within reach. Shape (N, 3)."""
    parts = []
    for (p, row, column), view in zip(lifted, views, strict=True):
        parts.append(p[view.depth[row, column] < s.visibility.most_depth_m * view.unit])
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    if len(points) == 0:
        return points
    cell = np.floor(points / (s.voxel_m * unit)).astype(np.int64)
    _, at, count = np.unique(pack(cell), return_inverse=True, return_counts=True)
    return np.stack([np.bincount(at, points[:, k]) / count for k in range(3)], axis=1)


def gone(seen: CarvedSurfaces, s: ChangedPlaceSettings) -> Array:
    """Return the surfaces that the other sessions see through. Shape (N, 3)."""
    through = (seen.free >= s.least_frames) & (seen.free >= s.free_share * (seen.free + seen.met))
    return np.asarray(seen.points[seen.own & through])


def compared(seen: CarvedSurfaces, s: ChangedPlaceSettings) -> Array:
    """Return the surfaces that the other sessions see or see through. Shape (K, 3)."""
    return np.asarray(seen.points[seen.free + seen.met >= s.least_frames])
