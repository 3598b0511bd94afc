"""Global instances as geometry: what structure, relations and descriptions are computed on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.geometry import Array, OrientedBox, upright_box


@dataclass(frozen=True)
class InstanceGeometry:
    """One instance in the world."""

    id: int
    points: Array
    """SampledSurface points without strays, world. Shape (N, 3), N >= 1."""
    rgb: NDArray[np.uint8]
    """Shape (N, 3)."""
    box: OrientedBox
    """Upright where gravity is known."""
    aabb: Array
    """Lower and upper corner of the points. Shape (2, 3)."""
    normal: Array | None
    """Unit normal where it is flat, towards the cameras. Shape (3,)."""
    structure: str | None = None
    """floor, ceiling, wall, plane, or None for an instance."""
    flagged: float = 0.0
    """Share of its points that the chunks themselves took for structure."""
    component: int = 0
    """Frame of reference."""
    confidence: float = 1.0

    @property
    def size(self) -> float:
        """Length of the longest edge of its box."""
        return float(np.max(self.box.size))


def neighbours_of(points: Array, tree: cKDTree, count: int = 1) -> tuple[Array, NDArray[np.int64]]:
    """Return distances to, and numbers of, the nearest points of a tree. Shape (N, D) -> (N, count) each."""
    distance, at = tree.query(points, k=count)
    shape = (len(points), count)
    return np.asarray(distance).reshape(shape), np.asarray(at, dtype=np.int64).reshape(shape)


def without_strays(points: Array, neighbours: int = 4, factor: float = 4.0) -> NDArray[np.int64]:
    """Return positions of the points that keep company: what lies `factor` times further from its neighbours than is
    usual for the instance is depth noise at an edge, or a bit of something else. Shape (N, 3) -> (M,).
    """
    if len(points) < 4 * neighbours:
        return np.arange(len(points))
    distance = neighbours_of(points, cKDTree(points), neighbours + 1)[0][:, -1]
    keep = np.flatnonzero(distance <= factor * max(float(np.median(distance)), 1e-9))
    return keep if len(keep) else np.arange(len(points))


def fit_box(points: Array, *, upright: bool, trim: float = 0.01) -> OrientedBox:
    """Return the box of an instance: upright where gravity is known, else along its own principal axes, longest
    first.
    """
    if upright:
        return upright_box(points, trim)
    center = points.mean(axis=0)
    axes = np.linalg.svd(points - center, full_matrices=False)[2].T if len(points) > 2 else np.eye(3)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    local = points @ axes
    low, high = np.quantile(local, [trim, 1.0 - trim], axis=0)
    return OrientedBox(axes @ ((low + high) / 2), high - low, axes)
