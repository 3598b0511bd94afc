"""The chunk's cloud cut into small pieces that no border of an object runs through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.learned.graph import ChunkSurface
from list3r.instances.learned.kernels import way_costs


@dataclass(frozen=True)
class SuperpointSettings:
    """Size of the pieces, and the borders they respect."""

    seed_m: float = 0.06
    """Spacing of the seeds from which pieces grow."""
    normal_weight: float = 3.0
    """Cost of crossing a right angle, in voxels of way."""
    color_weight: float = 0.12
    """Cost of a step of colour, in voxels of way for each unit of Lab (lightness halved)."""
    step_weight: float = 1.5
    """Cost of a step across the surface, in voxels of way for each voxel of height."""
    least: int = 4
    """Pieces of fewer voxels are no pieces."""


@dataclass(frozen=True)
class Superpoints:
    """P pieces of a cloud of N voxels."""

    labels: NDArray[np.int32]
    """Piece of each voxel, from 0; -1 for none. Shape (N,)."""
    count: int


def cut_superpoints(surface: ChunkSurface, settings: SuperpointSettings | None = None) -> Superpoints:
    """Grow pieces from seeds along the shortest ways over the surface, on which edges, steps and colours cost.

    Every voxel goes to the seed that is nearest by that cost (a geodesic Voronoi diagram), so pieces keep to creases
    and to borders of colour, and none is much wider than the spacing of the seeds.
    """
    s = settings or SuperpointSettings()
    cloud, (left, right) = surface.cloud, surface.pairs
    cost = _costs(surface, s)
    seeds = _seeds(cloud, left, right, cost, s.seed_m * surface.around.unit)
    size = len(cloud.keys)
    graph = coo_matrix((cost, (left, right)), shape=(size, size)).tocsr()
    _, _, source = dijkstra(graph, directed=False, indices=seeds, return_predecessors=True, min_only=True)
    known = source >= 0
    number = np.full(size, -1, np.int64)
    number[known] = np.searchsorted(seeds, source[known])
    labels, count = _without_fragments(number, s.least)
    return Superpoints(labels, count)


def _costs(surface: ChunkSurface, s: SuperpointSettings) -> NDArray[np.float32]:
    """Length of the way between neighbouring voxels. Shape (M,)."""
    cloud = surface.cloud
    weights = np.float32(s.normal_weight), np.float32(s.color_weight), np.float32(s.step_weight)
    return way_costs(surface.pairs, (cloud.points, cloud.normals, surface.lab), np.float32(cloud.voxel), weights)


def _seeds(
    cloud: Cloud, left: NDArray[np.int32], right: NDArray[np.int32], cost: NDArray[np.float32], spacing: float
) -> NDArray[np.int64]:
    """The calmest voxel of each cell of a grid and of each way that surfaces in it face, ascending."""
    size = len(cloud.keys)
    ways = np.maximum(np.bincount(left, minlength=size) + np.bincount(right, minlength=size), 1)
    rough = (np.bincount(left, cost, minlength=size) + np.bincount(right, cost, minlength=size)) / ways
    rough = rough + 2.0 * (ways < 5)
    cell = np.floor(cloud.points / spacing).astype(np.int64) + (1 << 14)
    axis = np.abs(cloud.normals).argmax(axis=1)
    facing = axis * 2 + (cloud.normals[np.arange(size), axis] > 0)
    key = ((cell[:, 0] << 30 | cell[:, 1] << 15 | cell[:, 2]) << 3) | facing
    order = np.lexsort((rough, key))
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(first, size))
    return np.sort(order[first[count >= 4]])


def _without_fragments(number: NDArray[np.int64], least: int) -> tuple[NDArray[np.int32], int]:
    """Pieces renumbered without those of fewer voxels than `least`, and how many are left."""
    size = np.bincount(number[number >= 0], minlength=1)
    keep = size >= least
    new = np.where(keep, np.cumsum(keep) - 1, -1)
    return np.asarray(np.where(number >= 0, new[number], -1), np.int32), int(keep.sum())
