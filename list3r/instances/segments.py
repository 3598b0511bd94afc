"""The chunk's cloud cut into things: surfaces first, then what stands on, hangs under or leans before them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from list3r.instances.cloud import Cloud, neighbour_pairs
from list3r.instances.planes import Plane, find_planes, plane_tolerance
from list3r.instances.settings import SegmentSettings

Labels = NDArray[np.int32]


@dataclass(frozen=True)
class Segment:
    """One thing of the chunk."""

    kind: str
    """plane, thing, sheet."""
    plane: NDArray[np.float64] | None
    """Its plane in chunk coordinates where it is flat. Shape (4,)."""
    structure: bool
    """A surface that bounds the room."""
    score: float
    """How sure it is one thing, in [0, 1]."""


@dataclass(frozen=True)
class Segmentation:
    """Every voxel's thing."""

    labels: Labels
    """0 for none, s + 1 for segment s. Shape (N,)."""
    segments: tuple[Segment, ...]
    up: NDArray[np.float64]
    """Upward direction, chunk frame. Shape (3,)."""


@dataclass(frozen=True)
class Scene:
    """What every step of the segmentation looks at."""

    cloud: Cloud
    up: NDArray[np.float64]
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


def segment_cloud(
    cloud: Cloud, T_chunk_cam: NDArray[np.float64], unit: float, settings: SegmentSettings
) -> Segmentation:
    """Cut the cloud into things. `T_chunk_cam` are the posed cameras, shape (F, 4, 4)."""
    planes = find_planes(cloud, settings.plane_area_m2 * unit**2, unit)
    up = estimate_up(planes, T_chunk_cam)
    scene = Scene(cloud, up, plane_tolerance(cloud.sigma, cloud.voxel), T_chunk_cam[:, :3, 3], unit, settings)
    surfaces = [plane for plane in planes if _cuts(plane, scene)]
    labels = assign_surfaces(scene, surfaces)
    labels = connect_rest(scene, labels, len(surfaces))
    labels = attach_parts(scene, surfaces, labels)
    return _describe(scene, surfaces, labels)


def estimate_up(planes: list[Plane], T_chunk_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """The normal, within 55 degrees of the cameras' mean up, that the most area is level or upright to."""
    prior = -T_chunk_cam[:, :3, 1].mean(axis=0)
    prior /= max(float(np.linalg.norm(prior)), 1e-9)
    best, best_area = prior, 0.0
    for candidate in planes:
        if candidate.normal @ prior < 0.57:
            continue
        cosines = [abs(float(plane.normal @ candidate.normal)) for plane in planes]
        area = sum(p.area for p, c in zip(planes, cosines, strict=True) if c > 0.985 or c < 0.09)
        area *= float(candidate.normal @ prior)
        if area > best_area:
            best, best_area = candidate.normal, area
    return np.asarray(best)


def _cuts(plane: Plane, scene: Scene) -> bool:
    """True for a surface that parts what it touches: a big one, or a level one that things rest on."""
    area = plane.area / scene.unit**2
    return area >= scene.settings.big_plane_area_m2 or (area >= scene.settings.support_area_m2 and scene.level(plane))


def assign_surfaces(scene: Scene, surfaces: list[Plane]) -> Labels:
    """Voxels of the surfaces: those within tolerance of the footprint, and the edge of a board under its top."""
    cloud = scene.cloud
    labels = np.zeros(len(cloud.keys), np.int32)
    heights = [plane.height(cloud.points) for plane in surfaces]
    for number, plane in enumerate(surfaces):
        footprint = _dilated(plane.footprint, np.ones((3, 3), np.uint8))
        inside = plane.raster.look_up(footprint, cloud.points) > 0
        labels[(labels == 0) & inside & (np.abs(heights[number]) < scene.tolerance)] = number + 1
    for number, plane in enumerate(surfaces):
        if not scene.level(plane):
            continue
        wide = int(np.ceil(0.025 * scene.unit / plane.raster.cell))
        footprint = _dilated(plane.footprint, np.ones((2 * wide + 1, 2 * wide + 1), np.uint8))
        inside = plane.raster.look_up(footprint, cloud.points) > 0
        board = (heights[number] < scene.tolerance) & (heights[number] > -0.1 * scene.unit)
        labels[(labels == 0) & inside & board] = number + 1
    return labels


def _dilated(image: NDArray[np.uint8], kernel: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.dilate(image, kernel), np.uint8)


def connect_rest(scene: Scene, labels: Labels, taken: int) -> Labels:
    """Connected components of the voxels that belong to no surface, numbered after the `taken` surfaces."""
    rest = np.flatnonzero(labels == 0)
    left, right = neighbour_pairs(scene.cloud.keys[rest], 2)
    graph = coo_matrix((np.ones(len(left), np.int8), (left, right)), shape=(len(rest), len(rest)))
    _, component = connected_components(graph, directed=False)
    size = np.bincount(component)
    order = np.cumsum(size >= _min_voxels(scene))
    out = labels.copy()
    out[rest] = np.where(size[component] >= _min_voxels(scene), taken + order[component], 0)
    return out


def _min_voxels(scene: Scene) -> int:
    """Voxels on the visible half of the smallest thing."""
    return int(0.7 * (scene.settings.thing_size_m * scene.unit / scene.cloud.voxel) ** 2 * 2)


def attach_parts(scene: Scene, surfaces: list[Plane], labels: Labels) -> Labels:
    """Give boards that are no structure what carries them: parts that touch them and lie below."""
    cloud = scene.cloud
    contact = _contacts(cloud, labels)
    parent = np.arange(labels.max() + 1)
    for number, plane in enumerate(surfaces):
        if not scene.level(plane) or is_structure(scene, plane):
            continue
        height = plane.height(cloud.points)
        for part in range(len(surfaces) + 1, len(parent)):
            touching = contact.get((number + 1, part), 0)
            if parent[part] != part or touching < 12:
                continue
            mine = labels == part
            below = float(np.mean(height[mine] < scene.tolerance[mine]))
            if below > 0.95 or _is_back(scene, plane, cloud.points[mine], height[mine]):
                parent[part] = number + 1
    return np.asarray(parent[labels], dtype=np.int32)


def _is_back(scene: Scene, plane: Plane, points: NDArray[np.float32], height: NDArray[np.float32]) -> bool:
    """True for what rises from a seat over its whole width: a back, not a thing put there."""
    if plane.area > 0.4 * scene.unit**2:
        return False
    local = (points - plane.raster.origin) @ plane.raster.axes.T
    spread = cv2.minAreaRect(local.astype(np.float32))[1]
    return max(spread) > 0.6 * plane.extent()[0] and float(height.max()) > 0.15 * scene.unit


def _contacts(cloud: Cloud, labels: Labels) -> dict[tuple[int, int], int]:
    """Number of neighbouring voxel pairs between different labels, by (smaller, larger) label."""
    known = np.flatnonzero(labels > 0)
    left, right = neighbour_pairs(cloud.keys[known], 2)
    a, b = labels[known[left]], labels[known[right]]
    low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
    codes, count = np.unique((low << 32 | high)[low != high], return_counts=True)
    return {(int(c >> 32), int(c & 0xFFFFFFFF)): int(n) for c, n in zip(codes, count, strict=True)}


def is_structure(scene: Scene, plane: Plane) -> bool:
    """True for a floor, ceiling or wall: a large surface with the cameras before it and nothing behind it."""
    height = plane.height(scene.cloud.points)
    behind = float(np.mean(height < -0.12 * scene.unit))
    area = plane.area / scene.unit**2
    if behind > 0.02:
        return False
    if scene.level(plane):
        camera = float(np.median(plane.height(scene.camera_centers.astype(np.float32)))) / scene.unit
        return area > 2.0 or (camera > 0.9 and area > 0.25)
    upright_or_ceiling = abs(plane.normal @ scene.up) < 0.2 or plane.normal @ scene.up < -0.94
    return bool(upright_or_ceiling and area > scene.settings.big_plane_area_m2)


def _describe(scene: Scene, surfaces: list[Plane], labels: Labels) -> Segmentation:
    """Number the labels that are left from 1 and say what each is."""
    present = np.unique(labels[labels > 0])
    renumber = np.zeros(labels.max() + 1, np.int32)
    renumber[present] = np.arange(1, len(present) + 1)
    segments = []
    for label in present:
        mine = labels == label
        if label <= len(surfaces):
            plane = surfaces[label - 1]
            flat = float(np.mean(np.abs(plane.height(scene.cloud.points[mine])) < 2 * scene.tolerance[mine]))
            equation = plane.equation if flat > 0.6 else None
            segments.append(Segment("plane", equation, is_structure(scene, plane), 0.95))
            continue
        score = 1.0 - np.exp(-mine.sum() / (4.0 * _min_voxels(scene)))
        segments.append(Segment("thing", None, False, float(score)))
    return Segmentation(np.asarray(renumber[labels], np.int32), tuple(segments), scene.up)
