"""A closed, coloured mesh of an instance from its surface points: reconstructed, a hull, or a slab of structure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import QhullError, cKDTree

from list3r.exporters.components import has_box, point_spacing, thinned_support
from list3r.exporters.meshes.closed import ClosedSurface, divided, filled, hull, outward, slab, zero_level
from list3r.memory.core.records import Instance, Support
from list3r.memory.store.store import Store
from list3r.queries.views.fused import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MeshSettings:
    """How meshes are made. Lengths are shares of an instance's longest side."""

    points: int = 20_000
    """Used points of an instance, at most."""
    least_points: int = 24
    """With fewer there is no mesh."""
    cells: int = 28
    """Along the longest side, at most."""
    reach_cells: float = 1.6
    """Radius of a point, cells; neighbours on a surface then touch."""
    convex_depth: float = 0.06
    """A point so deep under the convex hull is still on it: noise, and the roundness of sides."""
    convex_share: float = 0.85
    """With this many points on the hull, the hull is the better mesh: it closes unseen sides with planes."""
    convex_sides: float = 0.6
    """And where so much of its area has points, of two opposite sides the better: under a table nothing does."""
    hull_faces: int = 10_000
    """Of a hull, at most; more of them show colours finer."""
    faces_a_point: int = 8
    """Of a hull, at most: between few points there is no more to show."""
    least_part: float = 0.1
    """Parts of less than this share of the volume are left out."""
    slab_cells: int = 128
    """Along the longest side of structure, at most."""
    slab_thickness: float = 0.003


@dataclass(frozen=True)
class InstanceMesh:
    """A surface with colours, world coordinates; closed, unless it is only what was seen."""

    surface: ClosedSurface
    rgb: NDArray[np.uint8]
    """Of vertices, sRGB. Shape (V, 3)."""
    kind: str
    """reconstructed: follows the points; hull: convex, also on unseen sides; slab: a plane of structure; seen: fused
    from depth, open where nothing was seen."""

    @staticmethod
    def seen(surface: Surface) -> InstanceMesh:
        """Return triangles that were fused from depth."""
        vertices, faces = surface.vertices.astype(np.float64), surface.faces.astype(np.int64)
        return InstanceMesh(ClosedSurface(vertices, faces), surface.rgb, "seen")


def instance_mesh(store: Store, instance: Instance, settings: MeshSettings | None = None) -> InstanceMesh | None:
    """Return the mesh of an instance, None where its support allows none."""
    s = settings or MeshSettings()
    return mesh_of(instance, thinned_support(store, instance, s.points), s)


def mesh_of(instance: Instance, support: Support, settings: MeshSettings | None = None) -> InstanceMesh | None:
    """Return the mesh of surface points that were read, None where they allow none."""
    s = settings or MeshSettings()
    points = support.points.astype(np.float64)
    points = points[dense(points)]
    if len(points) < s.least_points or not np.ptp(points, axis=0).max() > 0:
        return None
    if instance.structure is not None and has_box(instance):
        surface, kind = _slab(points, instance, s), "slab"
    elif (convex := _hull(points, instance.box.rotation, s)) is not None:
        surface, kind = convex, "hull"
    else:
        surface, kind = _reconstructed(points, s), "reconstructed"
    if not len(surface.faces):
        return None
    near = np.asarray(cKDTree(support.points).query(surface.vertices, k=[1, 2, 3, 4])[1])
    rgb = support.rgb[near].astype(np.float64).mean(axis=1)
    return InstanceMesh(surface, np.round(rgb).astype(np.uint8), kind)


def dense(points: Array) -> NDArray[np.bool_]:
    """Return which points have neighbours as near as usual: outliers would distort a hull."""
    if len(points) < 10:
        return np.ones(len(points), bool)
    away = np.asarray(cKDTree(points).query(points, k=[9])[0])[:, 0]
    return np.asarray(away <= 4.0 * np.median(away) + 1e-12)


def _hull(points: Array, axes_world: Array, s: MeshSettings) -> ClosedSurface | None:
    """Return the convex hull where nearly all points are on it and its sides have points."""
    size = float(np.ptp(points, axis=0).max())
    _, spread, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if spread[2] < 0.01 * spread[0]:
        points = np.concatenate([points - 0.005 * size * axes[2], points + 0.005 * size * axes[2]])
    try:
        found = hull(points)
    except QhullError:
        return None
    a, b, c = (found.vertices[found.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    some = points[:: max(1, len(points) // 2000)]
    depth = -(some @ normal.T - np.einsum("ij,ij->i", normal, a)).max(axis=1)
    if float((depth < s.convex_depth * size).mean()) < s.convex_share:
        return None
    spacing = point_spacing(points.astype(np.float32))
    found = divided(found, size / 16, min(s.hull_faces, s.faces_a_point * len(points)))
    reach = max(s.convex_depth * size, spacing)
    return found if _borne_sides(found, points, axes_world, reach) >= s.convex_sides else None


def _borne_sides(surface: ClosedSurface, points: Array, axes_world: Array, reach: float) -> float:
    """Return the share of the area of a hull that has points, of two opposite sides that which has more."""
    corners = surface.vertices[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ axes_world
    area = np.linalg.norm(across, axis=1)
    axis = np.abs(across).argmax(axis=1)
    side = 2 * axis + (across[np.arange(len(axis)), axis] > 0)
    covered = cKDTree(points).query(corners.mean(axis=1))[0] < reach
    areas, covered_areas = np.bincount(side, area, 6), np.bincount(side, area * covered, 6)
    share = (covered_areas / np.maximum(areas, 1e-30)).reshape(3, 2).max(axis=1)
    return float(share @ areas.reshape(3, 2).sum(axis=1) / areas.sum())


def _reconstructed(points: Array, s: MeshSettings) -> ClosedSurface:
    """Return the surface around all that is near a point, or enclosed by that, drawn back to the points."""
    cell = max(float(np.ptp(points, axis=0).max()) / s.cells, point_spacing(points.astype(np.float32)))
    reach = s.reach_cells * cell
    low = points.min(axis=0) - reach - 2 * cell
    shape = np.ceil((points.max(axis=0) + reach + 2 * cell - low) / cell).astype(int) + 1
    centers = low + cell * np.indices(tuple(shape)).reshape(3, -1).T
    tree = cKDTree(points)
    away = tree.query(centers, distance_upper_bound=3 * reach)[0]
    field = (reach - np.minimum(away, 3 * reach)).reshape(tuple(shape))
    solid = _large_parts(filled(field > 0), s.least_part)
    enclosed = solid & (field <= 0)
    field = np.where(enclosed, reach, np.where(solid, field, np.minimum(field, -0.1 * reach)))
    surface = zero_level(field)
    vertices = low + cell * surface.vertices
    near = points[np.asarray(tree.query(vertices, k=[1, 2, 3, 4])[1])].mean(axis=1)
    return outward(replace(surface, vertices=near + 0.4 * (vertices - near)))


def _large_parts(solid: NDArray[np.bool_], least: float) -> NDArray[np.bool_]:
    parts, count = ndimage.label(solid)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray((sizes >= least * sizes.max())[parts] & solid)


def _slab(points: Array, instance: Instance, s: MeshSettings) -> ClosedSurface:
    """Return the plate that the points of a plane cover, with its holes."""
    thin = int(np.argmin(instance.box.size))
    axes = instance.box.rotation[:, [(thin + 1) % 3, (thin + 2) % 3, thin]]
    local = points @ axes
    size = float(np.ptp(local[:, :2], axis=0).max())
    cell = max(size / s.slab_cells, 2 * point_spacing(points.astype(np.float32)))
    low = local[:, :2].min(axis=0)
    index = np.floor((local[:, :2] - low) / cell).astype(int)
    cells = np.zeros(tuple(index.max(axis=0) + 1), bool)
    cells[tuple(index.T)] = True
    plate = slab(ndimage.binary_closing(np.pad(cells, 2), iterations=2)[2:-2, 2:-2] | cells)
    flat = plate.vertices * [cell, cell, s.slab_thickness * size] + [*low, float(np.median(local[:, 2]))]
    return outward(ClosedSurface(flat @ axes.T, plate.faces))
