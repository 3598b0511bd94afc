"""Rooms that others scanned and labelled: point clouds in PCD with a label for each point, to measure on.

Every point is drawn as a small square along the surface round it. The scans have no colour and their floors are cut
away, so one is drawn; what nobody labelled (label 0: walls, and what was left out) is none of the things.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.errors import SourceError
from training.worlds.collada import TexturedMesh
from training.worlds.film import Truth

GREY = (150.0, 150.0, 150.0)
NEIGHBOURS = 12
"""Points by which the surface round a point is told."""
FLOOR_SHARE = 0.002
"""Share of points that may lie below the floor."""
LARGEST_M = 0.012
"""Half of the longest edge of a square."""


def read_scan(file: Path) -> tuple[list[TexturedMesh], list[int], list[Truth]]:
    """Return the squares of a scan by label and a floor, whose they are, and its things.

    Raises `SourceError` for other files.
    """
    points, label = _read_pcd(file)
    points[:, 2] -= np.quantile(points[:, 2], FLOOR_SHARE)
    distance, near = cKDTree(points).query(points, k=NEIGHBOURS)
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    half = np.minimum(distance[:, 4], LARGEST_M)[:, None]
    corners = np.stack(
        [points + half * (i * axes[:, :, 2] + j * axes[:, :, 1]) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))], 1
    )
    meshes, owner, things = [], [], []
    for k in np.unique(label).tolist():
        own = corners[label == k]
        first = 4 * np.arange(len(own))[:, None]
        triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
        uv = np.zeros((len(triangles), 3, 2), np.float32)
        meshes.append(TexturedMesh(own.reshape(-1, 3), triangles, uv, None, GREY))
        owner.append(k + 1)
        name = f"thing {k}" if k else "unlabelled"
        things.append(Truth(k + 1, name, name, name, k == 0))
    low, high = points.min(axis=0), points.max(axis=0)
    slab = trimesh.creation.box(bounds=[[low[0] - 1, low[1] - 1, -0.1], [high[0] + 1, high[1] + 1, 0.0]])
    uv = np.zeros((len(slab.faces), 3, 2), np.float32)
    meshes.append(TexturedMesh(np.asarray(slab.vertices), np.asarray(slab.faces), uv, None, GREY))
    owner.append(max(owner) + 1)
    things.append(Truth(owner[-1], "floor", "floor", "floor", True))
    return meshes, owner, things


def _read_pcd(file: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points (N, 3) and labels (N,), without points at the origin, which scanners write for none."""
    import open3d as o3d

    if not file.is_file():
        raise SourceError(f"{file} does not exist")
    found = o3d.t.io.read_point_cloud(str(file))
    if "positions" not in found.point or "label" not in found.point:
        raise SourceError(f"{file.name} is no point cloud with labels: PCD with x, y, z and label is read")
    points, label = found.point["positions"].numpy().astype(np.float64), found.point["label"].numpy().ravel()
    known = np.isfinite(points).all(axis=1) & (np.abs(points[:, :2]).max(axis=1) > 0)
    return points[known], label[known].astype(np.int64)
