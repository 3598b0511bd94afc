"""An instance as a simulator needs it: its seen surface, closed by what is sure, and convex parts that collide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.exporters.components import has_box, point_spacing, thinned_support
from list3r.exporters.meshes.closed import ClosedSurface, hull, net
from list3r.exporters.meshes.instance_mesh import InstanceMesh, MeshSettings, dense, mesh_of
from list3r.exporters.solids.completion import completed
from list3r.exporters.solids.convex import convex_parts
from list3r.exporters.solids.evidence import Evidence, Mask, gather
from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Instance, Support
from list3r.memory.library.overlap.visibility import DepthView, chunk_views
from list3r.memory.library.world.world import WORLD
from list3r.memory.store.store import Store

_SEEN_CELLS = 1.5
"""A vertex so near a surface point was seen."""
_HALF_SHELL_CELLS = 0.3
"""Of a shell that was seen from both sides, so that it keeps a thickness."""
_CARRIED_CELLS = 12.0
"""A seen surface is carried on so far into gaps."""
_TURN_CELLS = 8.0
"""A turn of a radian counts as so many cells."""
_UP = 0.8
"""Cosine of the steepest slope of what is taken as level."""
_LEVEL_CORNERS = 40
"""Of a level surface, at least."""
_LEAST_AREA = 0.01
"""Of a face, in those of a voxel."""
_OTHERS = 4000
"""Points of each neighbour that are looked at."""
_AROUND_M = 0.1
"""Neighbours are so near."""
_STANDS_M = 0.25
"""What it stands on lies at most so far from the lowest that was seen of an instance."""
_INTO_M = 0.05
"""And at most so far above that."""
_UPRIGHT = 0.999
"""Cosine of the tilt from which what a thing stands on has no height along its axes."""
_KEPT = 512
"""Neighbours whose points are kept in memory."""
_CHUNKS = 64
"""Whose depth pictures are kept in memory."""
_LEAST_UNDER = 20
"""Points below an instance, for the height there."""


@dataclass(frozen=True)
class Solid:
    """A closed mesh, of which each face says whether a camera saw it, and the convex parts that it consists of."""

    mesh: InstanceMesh
    seen: NDArray[np.bool_]
    """Of faces; the others are completed. Shape (F,)."""
    parts: tuple[ClosedSurface, ...]
    """World."""


@dataclass(frozen=True)
class Surroundings:
    """What the solid of an instance follows from."""

    support: Support
    """World."""
    others: Array
    """Surface points of other things near it, world. Shape (N, 3)."""
    views: Sequence[DepthView]
    """Keyframes of the chunks that saw it; none of what moves, and of structure."""
    stands: float
    """Height of what it stands on, world."""
    metre: float
    """World units."""


class Solids:
    """Reads what the solids of a memory's instances follow from."""

    def __init__(self, store: Store) -> None:
        world = store.facts[WORLD]
        self._store, self._metre = store, 1.0 if world is None else world.unit
        self._all = {i.id: i for i in store.instances.all()}
        self._on = {r.subject: r.object for r in store.relations.all() if r.predicate == "on"}
        self._views = lru_cache(_CHUNKS)(self._read_views)
        self._points = lru_cache(_KEPT)(self._read_points)

    def of(self, instance: Instance) -> Solid | None:
        """Return the solid of an instance, None where its surface points allow none."""
        return solid_of(instance, self.around(instance))

    def around(self, instance: Instance) -> Surroundings:
        """Return what the solid of an instance follows from."""
        support = thinned_support(self._store, instance, MeshSettings().points)
        if instance.structure is not None or instance.dynamic or not has_box(instance):
            return Surroundings(support, np.zeros((0, 3)), (), 0.0, self._metre)
        low, high = instance.aabb + np.array([[-_AROUND_M], [_AROUND_M]]) * self._metre
        near = [self._all[n] for n in self._store.instances.ids_in_box(low, high) if n in self._all]
        beside = [i for i in near if i.component == instance.component and i.id != instance.id]
        others = np.concatenate([np.zeros((0, 3)), *(self._points(i.id) for i in beside)])
        others = others[((others > low) & (others < high)).all(axis=1)]
        chunks = sorted({o.chunk_id for o in self._store.observations.of(instance.id)})
        views = [view for k in chunks for view in self._views(k)]
        return Surroundings(support, others, views, self._stands(instance), self._metre)

    def _read_points(self, instance_id: int) -> Array:
        return thinned_support(self._store, self._all[instance_id], _OTHERS).points.astype(np.float64)

    def _read_views(self, chunk_id: int) -> list[DepthView]:
        keyframes = self._store.keyframes.of(chunk_id)
        return chunk_views(self._store.chunks.get(chunk_id), keyframes, self._metre)

    def _stands(self, instance: Instance) -> float:
        """Return the height of what an instance stands on, where that is near its lowest points, else theirs."""
        lowest, under = float(instance.aabb[0, 2]), self._all.get(self._on.get(instance.id, -1))
        if under is None:
            return lowest
        points = self._points(under.id)
        here = ((points[:, :2] > instance.aabb[0, :2]) & (points[:, :2] < instance.aabb[1, :2])).all(axis=1)
        heights = points[here if here.sum() >= _LEAST_UNDER else slice(None), 2]
        below = (lowest - heights) / self._metre
        heights = heights[(below < _STANDS_M) & (below > -_INTO_M)]
        return float(np.quantile(heights, 0.9)) if len(heights) else lowest


def solid_of(instance: Instance, around: Surroundings) -> Solid | None:
    """Return an instance's solid, None where its surface points allow none.

    Structure, and what no view has depth of, is closed as in `mesh_of`, and its hull is the only part.
    """
    mesh = mesh_of(instance, around.support)
    if mesh is None:
        return None
    points = around.support.points.astype(np.float64)
    points = points[dense(points)]
    axes = upright_axes(instance.box.rotation)
    stands = around.stands if axes[2, 2] > _UPRIGHT else np.inf
    evidence = gather(points, around.others, around.views, axes, stands, around.metre) if around.views else None
    solid = None if evidence is None else completed(evidence)
    if evidence is None or solid is None or not solid.any():
        away = np.asarray(cKDTree(points).query(mesh.surface.vertices)[0])
        seen: NDArray[np.bool_] = away < 2 * point_spacing(points.astype(np.float32))
        return Solid(mesh, np.asarray(seen[mesh.surface.faces].all(axis=1)), (hull(mesh.surface.vertices),))
    surface, seen, place = _surface(evidence, solid, points)
    nearest = np.asarray(cKDTree(around.support.points).query(surface.vertices, k=[1, 2, 3, 4])[1])
    rgb = np.round(around.support.rgb[nearest].astype(np.float64).mean(axis=1)).astype(np.uint8)
    parts = convex_parts(solid, place) or (hull(mesh.surface.vertices),)
    return Solid(InstanceMesh(surface, rgb, "solid"), seen, parts)


def upright_axes(rotation: Array) -> Array:
    """Return the axes of a box, as columns, such that the last one is the most upright and points up. Shape (3, 3)."""
    k = int(np.argmax(np.abs(rotation[2])))
    up = rotation[:, k] * np.sign(rotation[2, k])
    x = rotation[:, (k + 1) % 3]
    return np.stack([x, np.cross(up, x), up], axis=1)


def _surface(
    e: Evidence, solid: Mask, points: Array
) -> tuple[ClosedSurface, NDArray[np.bool_], Callable[[NDArray[np.int64]], Array]]:
    """Return the surface of solid voxels, drawn to the points that were seen, which faces were seen, and where corners
    of voxels (N, 3) lie then.
    """
    surface, corners = net(solid)
    vertices = surface.vertices
    normals = surface.normals()
    tree = cKDTree((points @ e.axes - e.low) / e.edge)
    away, which = map(np.asarray, tree.query(vertices, k=[1, 2, 3, 4, 5, 6], distance_upper_bound=3.0))
    near = (away[:, 0] < _SEEN_CELLS) & np.isfinite(away).all(axis=1)
    middle = tree.data[np.where(np.isfinite(away), which, 0)].mean(axis=1)
    before, behind = (_is_free(e.free, vertices + side * normals, side * normals) for side in (1, -1))
    seen: NDArray[np.bool_] = near & before
    keep = np.where(behind, _HALF_SHELL_CELLS, 0.0)
    shift = np.clip(np.einsum("ij,ij->i", middle - vertices, normals) + keep, -1.0, 1.0)
    moved = vertices + _carried_on(vertices, normals, seen, shift)[:, None] * normals
    _level(moved, normals, seen)
    for _ in range(2):  # no face may lose its area
        thin = surface.faces[_areas(moved, surface.faces) < _LEAST_AREA].ravel()
        moved[thin] = vertices[thin]
    at = {tuple(c): n for n, c in enumerate(corners.tolist())}

    def place(cells: NDArray[np.int64]) -> Array:
        places: Array = cells.astype(np.float64) - 0.5
        known = [(k, at[c]) for k, c in enumerate(map(tuple, cells.tolist())) if c in at]
        if known:
            which, of = np.array(known).T
            places[which] = moved[of]
        return e.world(places)

    return ClosedSurface(e.world(moved), surface.faces), np.asarray(seen[surface.faces].all(axis=1)), place


def _areas(vertices: Array, faces: NDArray[np.int64]) -> Array:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _carried_on(vertices: Array, normals: Array, seen: NDArray[np.bool_], shift: Array) -> Array:
    """Return shifts of vertices: of those that were not seen, that of seen ones near them on the same side and level,
    else none.
    """
    out = np.where(seen, shift, 0.0)
    if not seen.any() or seen.all():
        return out
    weighted = np.concatenate([vertices, _TURN_CELLS * normals], axis=1)
    away, which = cKDTree(weighted[seen]).query(weighted[~seen], k=4, distance_upper_bound=_CARRIED_CELLS)
    which = np.flatnonzero(seen)[np.minimum(which, seen.sum() - 1)]
    level = np.einsum("nkj,nj->nk", vertices[which] - vertices[~seen][:, None], normals[~seen])
    weight = np.where(np.isfinite(away) & (np.abs(level) < 1.0), 1.0, 0.0)
    out[~seen] = (weight * shift[which]).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0)
    return out


def _level(vertices: Array, normals: Array, seen: NDArray[np.bool_]) -> None:
    """Lay flat what is level within a voxel, in place: tops, seats and boards, on which hulls of noise would tilt."""
    z, left = vertices[:, 2], normals[:, 2] > _UP
    while left.any():
        heights = np.sort(z[left])
        count = np.searchsorted(heights, heights + 2.0) - np.arange(len(heights))
        first = int(count.argmax())
        if count[first] < _LEVEL_CORNERS:
            return
        here = left & (z >= heights[first]) & (z < heights[first] + 2.0)
        level = float(np.median(z[here & seen] if (here & seen).any() else z[here]))
        z[here | ((z > level) & (z < level + 1.0))] = level
        left &= ~here


def _is_free(free: Mask, places: Array, step: Array) -> NDArray[np.bool_]:
    """Return whether one of the next few voxels from places on was seen through. Shape (N, 3) -> (N,)."""
    out = np.zeros(len(places), bool)
    for k in range(4):
        index = np.clip(np.rint(places + k * step).astype(np.int64), 0, np.array(free.shape) - 1)
        out |= free[tuple(index.T)]
    return out
