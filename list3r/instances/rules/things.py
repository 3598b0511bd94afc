"""What is left when the surfaces are taken away: connected components, joined to what they are parts of."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.instances.geometric.cloud import Cloud, linked_components, neighbour_pairs
from list3r.instances.geometric.planes import Plane
from list3r.instances.rules.surfaces import Labels, Scene, Surface, hull_of

REVEAL_M = 0.25
"""Walls up to this thick show their end faces beside doors."""
SEAT_AREA_M2 = 0.35
"""Level surfaces up to this may be parts (seat, lid, step) of a thing that is larger than they are."""


def connect_rest(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Connected components of the voxels that belong to no surface, numbered after the surfaces.

    The skirt, the thin layer of noise and sheets just above a level surface, joins nothing: it is given to the
    component it touches afterwards, or makes components of its own. Components too small to matter even as a part
    are dropped.
    """
    skirt = _skirt(scene, surfaces, labels)
    out = _components(scene, labels, np.flatnonzero((labels == 0) & ~skirt), len(surfaces))
    out = _grow_into(scene, out, np.flatnonzero(skirt), len(surfaces))
    left = np.flatnonzero(skirt & (out == 0))
    return _components(scene, out, left, int(out.max(initial=0)))


def _skirt(scene: Scene, surfaces: list[Surface], labels: Labels) -> NDArray[np.bool_]:
    """Voxels without a surface that lie less than a centimetre beyond the tolerance of a level one."""
    points = scene.cloud.points
    out = np.zeros(len(points), bool)
    for surface in surfaces:
        if surface.level:
            height = surface.plane.height(points)
            low = (height > 0) & (height < scene.tolerance + 0.01 * scene.unit)
            rows = np.flatnonzero(low & (labels == 0))
            raster = surface.plane.raster
            out[rows] |= raster.look_up(surface.plane.footprint, points[rows]) > 0
    return out


def _components(scene: Scene, labels: Labels, rest: NDArray[np.int64], taken: int) -> Labels:
    component, size = linked_components(scene.cloud.keys[rest], 2)
    keep = size >= 6
    number = np.cumsum(keep)
    out = labels.copy()
    out[rest] = np.where(keep[component], taken + number[component], 0) if len(rest) else 0
    return out


def _grow_into(scene: Scene, labels: Labels, free: NDArray[np.int64], taken: int) -> Labels:
    """Labels with free voxels given to the component within three voxels of them."""
    owners = np.flatnonzero(labels > taken)
    out = labels.copy()
    if len(owners) and len(free):
        tree = cKDTree(scene.cloud.points[owners])
        distance, nearest = tree.query(scene.cloud.points[free], distance_upper_bound=2.2 * scene.cloud.voxel)
        found = np.isfinite(distance)
        out[free[found]] = labels[owners[np.asarray(nearest)[found]]]
    return out


def least_voxels(scene: Scene) -> int:
    """Voxels on the visible half of the smallest thing."""
    return least_size(scene.settings.thing_size_m * scene.unit, scene.cloud.voxel)


def least_size(diameter: float, voxel: float) -> int:
    """Voxels on the visible half of a thing of some diameter."""
    return int(1.4 * (diameter / voxel) ** 2)


def attach_parts(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Give boards that are no structure what carries them, and seats the thing they are part of."""
    cloud = scene.cloud
    fixed = np.array([0] + [k + 1 for k, surface in enumerate(surfaces) if surface.structure])
    contact = contacts(cloud, np.where(np.isin(labels, fixed), 0, labels))
    parts = members_of(labels, len(surfaces))
    parent = np.arange(max(int(labels.max(initial=0)), len(surfaces)) + 1)
    for number, surface in enumerate(surfaces):
        if not surface.level or surface.structure or surface.sheet:
            continue
        for part, mine in parts.items():
            if parent[part] != part or part in parent[: len(surfaces) + 1]:
                continue
            points = cloud.points[mine]
            height = surface.plane.height(points)
            touching = contact.get((number + 1, part), 0)
            if np.mean(height < scene.tolerance[mine]) > 0.95:
                joined = touching >= 12 or _carries(scene, surface, points, height)
            else:
                joined = touching >= 12 and (
                    _is_back(scene, surface, points, height) or _spans(scene, surface, height, touching)
                )
            if joined:
                small = surface.plane.area < SEAT_AREA_M2 * scene.unit**2 and len(mine) > len(surface.plane.members)
                own = number + 1
                parent[part], parent[own] = (part, part) if small and parent[own] == own else (own, parent[own])
    for label in range(len(parent)):
        root = label
        while parent[root] != root:
            root = int(parent[root])
        parent[label] = root
    return np.asarray(parent[labels], dtype=np.int32)


def members_of(labels: Labels, taken: int) -> dict[int, NDArray[np.int64]]:
    """The voxels of each label above `taken`, ascending."""
    rows = np.flatnonzero(labels > taken)
    order = rows[np.argsort(labels[rows], kind="stable")]
    values, start = np.unique(labels[order], return_index=True)
    return {int(v): part for v, part in zip(values, np.split(order, start[1:]), strict=True)} if len(rows) else {}


def _carries(scene: Scene, surface: Surface, points: NDArray[np.float32], height: NDArray[np.float32]) -> bool:
    """True for a part under a board that ends close below it: a leg, a side, an apron.

    A view from above hides the topmost part of a leg behind the board's edge, so a gap of 15 cm is allowed.
    """
    wide = int(np.ceil(0.04 * scene.unit / surface.plane.raster.cell))
    footprint = cv2.dilate(surface.plane.footprint, np.ones((2 * wide + 1, 2 * wide + 1), np.uint8))
    under = surface.plane.raster.look_up(np.asarray(footprint, np.uint8), points) > 0
    return bool(under.mean() > 0.7 and np.quantile(height, 0.98) > -0.15 * scene.unit)


def adopt_islands(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Give surfaces the flat pieces of them that are seen on their own: through slats, between legs.

    A piece counts when nearly all of it is within tolerance of the plane and inside the hull of the footprint; what
    bounds the room goes on beyond its hull.
    """
    out = labels.copy()
    hulls = [hull_of(surface.plane.footprint) for surface in surfaces]
    for mine in members_of(labels, len(surfaces)).values():
        points, reading = scene.cloud.points[mine], scene.cloud.reading[mine]
        for number, surface in enumerate(surfaces):
            away = np.abs(surface.plane.height(points))
            if surface.sheet or np.mean(away < scene.tolerance[mine] + reading) < 0.85:
                continue
            inside = surface.plane.raster.look_up(hulls[number], points) > 0
            if surface.structure or inside.mean() > 0.7:
                out[mine] = number + 1
                break
    return out


def drop_slivers(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Give thin strips along a surface (edges of boards, plinths, mouldings) to the surface, or drop them."""
    out = labels.copy()
    for part, mine in members_of(labels, len(surfaces)).items():
        spread = scene.cloud.points[mine] - scene.cloud.points[mine].mean(axis=0)
        axes = np.linalg.eigh(spread.T @ spread)[1]
        size = np.ptp(np.quantile(spread @ axes, [0.03, 0.97], axis=0), axis=0)
        if size[1] > 0.06 * scene.unit or size[2] < 5.0 * size[1] or size[2] < 0.25 * scene.unit:
            continue
        contact = contacts(scene.cloud, _around(scene, labels, mine))
        touching = [contact.get((number + 1, part), 0) for number in range(len(surfaces))]
        best = int(np.argmax(touching)) if touching else 0
        out[mine] = best + 1 if touching and touching[best] > 0.5 * len(mine) else 0
    return out


def _around(scene: Scene, labels: Labels, mine: NDArray[np.int64]) -> Labels:
    """Labels of the voxels in reach of some, 0 elsewhere: enough for the contacts of these."""
    points, reach = scene.cloud.points, 4.0 * scene.cloud.voxel
    low, high = points[mine].min(axis=0) - reach, points[mine].max(axis=0) + reach
    return np.asarray(np.where(((points >= low) & (points <= high)).all(axis=1), labels, 0), np.int32)


def drop_reveals(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Labels without the end faces of walls, beside doors and windows: narrow upright strips that meet a wall along
    their length and are nowhere before it.
    """
    walls = [n for n, s in enumerate(surfaces) if scene.upright(s.plane) and _is_wall(scene, s.plane)]
    out = labels.copy()
    for part, mine in members_of(labels, 0).items():
        if part <= len(surfaces) and (part - 1 in walls or surfaces[part - 1].structure):
            continue
        points = scene.cloud.points[mine]
        tall = float(np.ptp(np.quantile(points @ scene.up, [0.03, 0.97])))
        spread = points - points.mean(axis=0)
        level = spread - np.outer(spread @ scene.up, scene.up)
        wide = float(np.ptp(np.quantile(level @ np.linalg.eigh(level.T @ level)[1][:, 2], [0.03, 0.97])))
        if wide > REVEAL_M * scene.unit or tall < 3.0 * wide or tall < 0.5 * scene.unit:
            continue
        contact = contacts(scene.cloud, _around(scene, labels, mine))
        for number in walls:
            touching = contact.get((min(number + 1, part), max(number + 1, part)), 0)
            height = surfaces[number].plane.height(points)
            behind = float(np.mean(height < scene.tolerance[mine] + scene.cloud.reading[mine]))
            if touching * scene.cloud.voxel > 0.5 * tall and behind > 0.9:
                out[mine] = 0
                break
    return out


def _is_wall(scene: Scene, plane: Plane) -> bool:
    """True for an upright surface as tall as no furniture but a wardrobe is."""
    tall = np.ptp(np.quantile(scene.cloud.points[plane.members] @ scene.up, [0.02, 0.98]))
    return bool(tall > 1.2 * scene.unit and plane.area > scene.settings.big_plane_area_m2 * scene.unit**2)


def _is_back(scene: Scene, surface: Surface, points: NDArray[np.float32], height: NDArray[np.float32]) -> bool:
    """True for what rises from a seat over its whole width: a back, not a thing put there."""
    plane = surface.plane
    if plane.area > SEAT_AREA_M2 * scene.unit**2:
        return False
    local = (points - plane.raster.origin) @ plane.raster.axes.T
    spread = cv2.minAreaRect(local.astype(np.float32))[1]
    return max(spread) > 0.6 * plane.extent()[0] and float(np.quantile(height, 0.95)) > 0.15 * scene.unit


def _spans(scene: Scene, surface: Surface, height: NDArray[np.float32], touching: int) -> bool:
    """True for a thing that goes on above and below a seat and touches it along a good part of its edge."""
    plane = surface.plane
    if plane.area > SEAT_AREA_M2 * scene.unit**2:
        return False
    away = 0.04 * scene.unit
    edge = 2.0 * float(plane.extent().sum()) / scene.cloud.voxel
    return float(np.mean(height > away)) > 0.15 and float(np.mean(height < -away)) > 0.15 and touching > edge


def contacts(cloud: Cloud, labels: Labels) -> dict[tuple[int, int], int]:
    """Number of neighbouring voxel pairs between different labels, by (smaller, larger) label."""
    known = np.flatnonzero(labels > 0)
    left, right = neighbour_pairs(cloud.keys[known], 2)
    a, b = labels[known[left]], labels[known[right]]
    low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
    codes, count = np.unique((low << 32 | high)[low != high], return_counts=True)
    return {(int(c >> 32), int(c & 0xFFFFFFFF)): int(n) for c, n in zip(codes, count, strict=True)}


def adopt_fragments(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Give small components to the larger thing they lie beside, unless they rest on a surface of their own.

    Slats of a chair, handles and rims come apart from their thing where depth edges leave a gap.
    """
    taken, points = len(surfaces), scene.cloud.points
    parts = members_of(labels, taken)
    parent = np.arange(max(int(labels.max(initial=0)), len(surfaces)) + 1)
    size = np.bincount(labels, minlength=len(parent)).astype(np.int64)
    free = np.flatnonzero(labels > taken)
    reach = 0.04 * scene.unit
    for part, mine in sorted(parts.items(), key=lambda item: (len(item[1]), item[0])):
        if 2 * len(mine) > max(size[taken + 1 :]) or _rests_alone(scene, surfaces, mine):
            continue
        low, high = points[mine].min(axis=0) - reach, points[mine].max(axis=0) + reach
        near = free[((points[free] >= low) & (points[free] <= high)).all(axis=1) & (parent[labels[free]] != part)]
        if not len(near):
            continue
        distance, which = cKDTree(points[near]).query(points[mine], distance_upper_bound=reach)
        owner = np.bincount(parent[labels[near[np.asarray(which)[np.isfinite(distance)]]]], minlength=1)
        best = int(np.argmax(owner))
        if size[part] < 0.5 * size[best] and owner[best] > min(0.3 * len(mine), 25):
            parent[parent == part] = best
            size[best] += size[part]
    return np.asarray(parent[labels], dtype=np.int32)


def _rests_alone(scene: Scene, surfaces: list[Surface], mine: NDArray[np.int64]) -> bool:
    """True for a component that is large enough to be a thing and stands on a surface."""
    if len(mine) < least_voxels(scene):
        return False
    return any(surface.level and _on(scene, surface, scene.cloud.points[mine]) for surface in surfaces)


def _on(scene: Scene, surface: Surface, points: NDArray[np.float32]) -> bool:
    """True for points that stand on a level surface."""
    low = float(np.quantile(surface.plane.height(points), 0.05))
    over = surface.plane.raster.look_up(surface.plane.footprint, points) > 0
    return bool(over.mean() > 0.5 and -0.01 * scene.unit < low < 0.03 * scene.unit)


def _scrap_under(scene: Scene, board: Surface, surfaces: list[Surface], points: NDArray[np.float32]) -> bool:
    """True for a scrap of a chair or leg seen under a board: small, and not standing broadly on the floor."""
    height = board.plane.height(points)
    if np.quantile(height, 0.95) > -0.05 * scene.unit:
        return False
    wide = int(np.ceil(0.15 * scene.unit / board.plane.raster.cell))
    reach = cv2.dilate(hull_of(board.plane.footprint), np.ones((2 * wide + 1, 2 * wide + 1), np.uint8))
    if np.mean(board.plane.raster.look_up(np.asarray(reach, np.uint8), points) > 0) < 0.7:
        return False
    level = points - np.outer(height, board.plane.normal).astype(np.float32)
    size = np.ptp(np.quantile(level, [0.03, 0.97], axis=0), axis=0)
    stands = any(s.structure and s.level and _on(scene, s, points) for s in surfaces)
    return bool(np.linalg.norm(size) < (0.12 if stands else 0.25) * scene.unit)


def drop_junk(scene: Scene, surfaces: list[Surface], labels: Labels) -> Labels:
    """Labels without components that are too small for a thing, or no larger than the noise of their depth.

    Off tables and the like, on the floor or in the air, small components are mostly parts of something hidden, so
    there a thing must show eight times the surface.
    """
    out = labels.copy()
    tops = [s for s in surfaces if s.level and not s.structure and not s.sheet]
    furniture = [s for s in tops if s.plane.area > 2.0 * scene.settings.support_area_m2 * scene.unit**2]
    for mine in members_of(labels, len(surfaces)).values():
        points = scene.cloud.points[mine]
        spread = np.linalg.norm(points.std(axis=0))
        least = least_voxels(scene) * (1 if any(_on(scene, s, points) for s in furniture) else 8)
        noisy = spread < 2.5 * np.median(scene.cloud.reading[mine])
        if len(mine) < least or noisy or any(_scrap_under(scene, s, surfaces, points) for s in furniture):
            out[mine] = 0
    return out
