"""Which flat surfaces part the things that touch them, and which of them bound the room."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.planes import Plane, footprint_of
from list3r.instances.settings import SegmentSettings

Labels = NDArray[np.int32]


MIN_FILL = 0.15
"""Share of its rectangle that a surface of several pieces must fill to be one surface."""


@dataclass(frozen=True)
class Scene:
    """What every step of the segmentation looks at."""

    cloud: Cloud
    up: NDArray[np.float64]
    """Upward direction, chunk frame. Shape (3,)."""
    tolerance: NDArray[np.float32]
    """Distance from a plane within which a voxel may belong to it. Shape (N,)."""
    camera_centers: NDArray[np.float64]
    """Chunk coordinates. Shape (F, 3)."""
    unit: float
    """Chunk units per metre."""
    settings: SegmentSettings

    def level(self, plane: Plane) -> bool:
        """True for a surface that things can rest on."""
        return bool(plane.normal @ self.up > 0.94)

    def upright(self, plane: Plane) -> bool:
        """True for a surface like a wall."""
        return bool(abs(plane.normal @ self.up) < 0.2)


@dataclass(frozen=True)
class Surface:
    """A plane that parts what it touches."""

    plane: Plane
    level: bool
    structure: bool
    """Floor, ceiling or wall."""
    sheet: bool
    """A thin flat thing that lies on another level surface."""


def choose_surfaces(scene: Scene, planes: list[Plane]) -> list[Surface]:
    """The planes that cut, largest first: big ones, what bounds the room, what things rest on, and sheets."""
    out: list[Surface] = []
    joined = sorted(merge_coplanar(scene, planes), key=lambda p: -p.area)
    for plane in joined:
        level = scene.level(plane)
        structure = is_structure(scene, plane) and (level or not _mounted(scene, plane, joined))
        sheet = level and any(_lies_on(scene, plane, other) for other in out if other.level)
        area = plane.area / scene.unit**2
        long = plane.extent()[0] / scene.unit > 0.9 and area > 0.2 and scene.upright(plane)
        rest = level and area >= scene.settings.support_area_m2
        bounds = scene.upright(plane) and area > 0.15 and _share_behind(scene, plane) < 0.02
        if area >= scene.settings.big_plane_area_m2 or long or rest or bounds or sheet or structure:
            out.append(Surface(plane, level, structure, sheet))
    return out


def merge_coplanar(scene: Scene, planes: list[Plane]) -> list[Plane]:
    """Pieces of one wide surface joined: level with each other within tolerance and bend, and side by side."""
    out: list[Plane] = []
    bounds = [_share_behind(scene, p) < 0.02 and not _mounted(scene, p, planes) for p in planes]
    bounding = {id(p) for p, flag in zip(planes, bounds, strict=True) if flag}
    for plane in sorted(planes, key=lambda p: -p.area):
        for number, big in enumerate(out):
            both = id(plane) in bounding and id(big) in bounding
            joined = _joined(scene, big, plane, both)
            if joined is None:
                continue
            out[number] = joined
            if id(big) in bounding:
                bounding.add(id(joined))
            break
        else:
            out.append(plane)
    return out


def _joined(scene: Scene, big: Plane, plane: Plane, both_bound: bool) -> Plane | None:
    """Two pieces as one surface; None where they are not one, or would fill too little of it."""
    if not _same_surface(scene, big, plane, both_bound):
        return None
    members = np.union1d(big.members, plane.members)
    joined = _repaint(scene, replace(big, members=members, area=big.area + plane.area))
    return joined if joined.area >= MIN_FILL * float(np.prod(joined.extent())) else None


def _mounted(scene: Scene, plane: Plane, planes: list[Plane]) -> bool:
    """True for what hangs on a wall: a plane less than 15 cm before a parallel one that goes on behind it."""
    points = scene.cloud.points[plane.members]
    least = 1.5 * float(np.median(scene.tolerance[plane.members]))
    for other in planes:
        if other.area < 0.5 * plane.area or other.normal @ plane.normal < 0.96:
            continue
        if least < float(np.median(other.height(points))) < 0.15 * scene.unit:
            if np.mean(other.raster.look_up(hull_of(other.footprint), points) > 0) > 0.3:
                return True
    return False


def _same_surface(scene: Scene, big: Plane, small: Plane, bounding: bool) -> bool:
    """True for two pieces of one surface; `bounding` says that both bound the room, so that gaps do not matter."""
    if big.normal @ small.normal < 0.97:
        return False
    points = scene.cloud.points[small.members]
    height = big.height(points)
    bend = 0.6 * scene.cloud.reading[small.members]
    if np.median(np.abs(height) - bend - scene.tolerance[small.members]) > 0:
        return False
    if scene.level(big) and np.median(height) > 0.5 * np.median(scene.tolerance[small.members]):
        return False
    small_level = scene.level(big) and big.area < 0.35 * scene.unit**2
    reach = 2.0 * big.raster.cell if small_level else 0.25 * float(small.extent()[0])
    if bounding:
        return True
    rc = np.argwhere(big.footprint > 0)
    local = (points - big.raster.origin) @ big.raster.axes.T / big.raster.cell
    low, high = rc.min(axis=0)[::-1], rc.max(axis=0)[::-1]
    gap = np.maximum(np.maximum(low - local, local - high), 0.0).max(axis=1)
    return bool(gap.min() * big.raster.cell < reach)


def _repaint(scene: Scene, plane: Plane) -> Plane:
    """The plane with raster and footprint of all its members."""
    raster, footprint = footprint_of(plane.equation, scene.cloud.points[plane.members], plane.raster.cell, scene.unit)
    return replace(plane, raster=raster, footprint=footprint)


def _lies_on(scene: Scene, plane: Plane, other: Surface) -> bool:
    """True where a small level plane is less than 4 cm above a larger one, over it or at its edge of view."""
    points = scene.cloud.points[plane.members]
    height = float(np.median(other.plane.height(points)))
    if not 0.0 < height < 0.04 * scene.unit or other.plane.area < max(1.5 * plane.area, 0.12 * scene.unit**2):
        return False
    hull = hull_of(_dilated(other.plane.footprint, 2))
    return float(np.mean(other.plane.raster.look_up(hull, points) > 0)) > 0.3


def hull_of(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The convex hull of a mask, 1 inside. Shape (h, w) -> (h, w)."""
    corners = cv2.convexHull(np.argwhere(mask > 0)[:, ::-1].astype(np.int32))
    return np.asarray(cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), corners, (1.0,)), np.uint8)


def _share_behind(scene: Scene, plane: Plane) -> float:
    return float(np.mean(plane.height(scene.cloud.points) < -0.12 * scene.unit - 2.0 * scene.cloud.reading))


def is_structure(scene: Scene, plane: Plane) -> bool:
    """True for a floor, ceiling or wall: a large surface with the cameras before it and nothing behind it."""
    area = plane.area / scene.unit**2
    if _share_behind(scene, plane) > 0.02:
        return False
    if scene.level(plane):
        camera = float(np.median(plane.height(scene.camera_centers.astype(np.float32)))) / scene.unit
        return area > 2.0 or (camera > 0.9 and area > 0.2) or camera > 1.2
    wide = area > 0.3 and plane.extent()[0] > 1.2 * scene.unit
    ceiling = plane.normal @ scene.up < -0.94
    return bool((scene.upright(plane) or ceiling) and (area > scene.settings.big_plane_area_m2 or wide))


def assign_surfaces(scene: Scene, surfaces: list[Surface]) -> Labels:
    """Surface + 1 of each voxel, 0 for none. Shape (N,).

    A voxel belongs to a surface when it is within tolerance of the footprint; sheets come before what they lie on.
    Then boards take their edge, and walls, floors and fronts what is seen of them through gaps, and what bending of
    depth has lifted off them.
    """
    cloud = scene.cloud
    labels = np.zeros(len(cloud.keys), np.int32)
    order = sorted(range(len(surfaces)), key=lambda k: not surfaces[k].sheet)
    for number in order:
        plane = surfaces[number].plane
        inside = plane.raster.look_up(_dilated(plane.footprint, 1), cloud.points) > 0
        height = plane.height(cloud.points)
        if surfaces[number].sheet:
            base = min(abs(_base_height(scene, plane, other)) for other in surfaces if other.level and not other.sheet)
            near = (height < scene.tolerance) & (height > -0.5 * base)
        else:
            near = np.abs(height) < scene.tolerance
        labels[(labels == 0) & inside & near] = number + 1
    for number, surface in enumerate(surfaces):
        plane = surface.plane
        height = plane.height(cloud.points)
        alike = cloud.normals @ plane.normal.astype(np.float32)
        if surface.structure or not surface.level:
            reach = _dilated(hull_of(plane.footprint), 2)
            near = (np.abs(height) < scene.tolerance + cloud.reading) & ((alike > 0.9) | (alike == 0.0))
        elif not surface.sheet:
            reach = _dilated(plane.footprint, int(np.ceil(0.025 * scene.unit / plane.raster.cell)))
            near = (height < scene.tolerance) & (height > -0.1 * scene.unit)
        else:
            continue
        labels[(labels == 0) & (plane.raster.look_up(reach, cloud.points) > 0) & near] = number + 1
    return labels


def _base_height(scene: Scene, plane: Plane, other: Surface) -> float:
    return float(np.median(other.plane.height(scene.cloud.points[plane.members])))


def _dilated(mask: NDArray[np.uint8], cells: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.dilate(mask, np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)), np.uint8)
