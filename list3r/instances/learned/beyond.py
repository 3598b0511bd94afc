"""What lies before and behind the planes of parts: what bounds a room has nothing behind it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.kernels import sums_by
from list3r.instances.learned.graph import ChunkSurface, PieceGraph, upright_frame
from list3r.instances.learned.kernels import beyond_planes

BEYOND = 4
"""Columns of `beyond`."""
CELL_M = 0.1
"""Edge of the cells by which surfaces are counted."""
LEVEL_M = 0.06
"""Within this distance a cell lies in a plane: three deviations of depth of a sensor at some metres."""
DEEP_M = 1.0
"""Cells farther before or behind a plane tell nothing: through a doorway the next room is behind every wall."""
ASIDE_M = 0.5
"""How far past its outline a part is looked around."""


def beyond(surface: ChunkSurface, labels: NDArray[np.int32], graph: PieceGraph) -> NDArray[np.float32]:
    """Return what lies around the plane of each part within `DEEP_M`. `labels` has shape (N,). Shape (P, BEYOND).

    The share of surface behind it; the share behind it of the surface that faces its way; how far behind that lies,
    metres; and the share of surface before it. The front of a shelf has its wall behind it, a table the floor.
    """
    cloud, unit = surface.cloud, surface.around.unit
    frame = upright_frame(surface.around.up)
    points = np.ascontiguousarray((cloud.points @ frame.T) / unit, np.float64)
    normals = np.ascontiguousarray(cloud.normals @ frame.T, np.float64)
    key = np.floor(points / CELL_M).astype(np.int64)
    key -= key.min(axis=0, initial=0)
    span = key.max(axis=0, initial=0) + 1
    _, cell = np.unique((key[:, 0] * span[1] + key[:, 1]) * span[2] + key[:, 2], return_inverse=True)
    cells = sums_by(cell.astype(np.int64), np.column_stack([points, normals, np.ones(len(points))]), _count(cell))
    middle, facing = cells[:, :3] / cells[:, 6:], _unit(cells[:, 3:6])
    known, count = labels >= 0, len(graph.nodes)
    normal = _unit(sums_by(labels[known].astype(np.int64), normals[known], count))
    m = graph.moments.astype(np.float64)
    reach = ASIDE_M + np.sqrt(3.0 * (m[:, 4:7].sum(axis=1)))
    return beyond_planes(m[:, 1:4].copy(), normal, reach, middle, facing, (LEVEL_M, DEEP_M)).astype(np.float32)


def _count(cell: NDArray[np.int64]) -> int:
    return int(cell.max(initial=-1)) + 1


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)
