"""Flat surfaces of the chunk's cloud: sequential RANSAC with noise-dependent tolerance, cut into connected pieces."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud

Float = NDArray[np.float32]


@dataclass(frozen=True)
class Raster:
    """A metric grid on a plane."""

    origin: NDArray[np.float64]
    """Point of cell (0, 0), chunk coordinates. Shape (3,)."""
    axes: NDArray[np.float64]
    """Two unit axes in the plane. Shape (2, 3)."""
    cell: float
    """Edge of a cell, chunk units."""
    shape: tuple[int, int]
    """(rows, columns): rows along the second axis."""

    def cells(self, points: Float) -> NDArray[np.int64]:
        """(row, column) of points, which may be outside. Shape (N, 3) -> (N, 2)."""
        local = (points - self.origin) @ self.axes.T / self.cell
        return np.floor(local[:, ::-1]).astype(np.int64)

    def look_up(self, image: NDArray[np.uint8], points: Float) -> NDArray[np.uint8]:
        """The image's value under each point, 0 outside. Shape (N, 3) -> (N,)."""
        rc = self.cells(points)
        inside = (rc >= 0).all(axis=1) & (rc[:, 0] < self.shape[0]) & (rc[:, 1] < self.shape[1])
        out = np.zeros(len(points), image.dtype)
        out[inside] = image[rc[inside, 0], rc[inside, 1]]
        return out


@dataclass(frozen=True)
class Plane:
    """One connected flat surface."""

    equation: NDArray[np.float64]
    """(n, d), n . p + d = 0 in chunk coordinates, n towards the cameras. Shape (4,)."""
    members: NDArray[np.int64]
    """Voxels of the cloud, ascending. Shape (M,)."""
    area: float
    """Square chunk units."""

    @property
    def normal(self) -> NDArray[np.float64]:
        """Shape (3,)."""
        return self.equation[:3]

    def height(self, points: Float) -> Float:
        """Signed distance of points, positive on the cameras' side. Shape (N, 3) -> (N,)."""
        return np.asarray(points @ self.equation[:3] + self.equation[3], dtype=np.float32)


def plane_tolerance(cloud: Cloud) -> Float:
    """How far from a plane a voxel may be and still belong to it. Shape (N,).

    Fused noise, or the residual of depth bias and pose drift between views, about the noise of a single reading.
    """
    return np.asarray(0.6 * cloud.voxel + np.maximum(3.5 * cloud.sigma, 2.0 * cloud.reading), dtype=np.float32)


def find_planes(cloud: Cloud, min_area: float, unit: float) -> list[Plane]:
    """Connected flat surfaces of at least `min_area` (square chunk units), largest hypotheses first."""
    rng = np.random.default_rng(7)
    free = np.linalg.norm(cloud.normals, axis=1) > 0.5
    tolerance = plane_tolerance(cloud)
    planes: list[Plane] = []
    floor_count = min_area / cloud.voxel**2
    for _ in range(60):
        pool = np.flatnonzero(free)
        if len(pool) < floor_count:
            break
        equation, count = _best_hypothesis(cloud, pool, tolerance, rng)
        if count < 0.6 * floor_count:
            break
        equation, inliers = _refine(cloud, pool, tolerance, equation)
        found = _pieces(cloud, inliers, equation, min_area, unit)
        planes.extend(found)
        taken = np.concatenate([p.members for p in found]) if found else inliers
        free[taken] = False
        if not found and len(inliers) < floor_count:
            break
    return planes


def _best_hypothesis(
    cloud: Cloud, pool: NDArray[np.int64], tolerance: Float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], float]:
    """The plane through one voxel with its normal that most voxels agree with, and about how many do."""
    sample = pool[rng.choice(len(pool), min(6000, len(pool)), replace=False)]
    seeds = sample[: min(250, len(sample))]
    n = cloud.normals[seeds]
    d = -np.sum(n * cloud.points[seeds], axis=1)
    near = np.abs(cloud.points[sample] @ n.T + d) < tolerance[sample][:, None]
    alike = cloud.normals[sample] @ n.T > 0.94
    votes = (near & alike).sum(axis=0)
    best = int(np.argmax(votes))
    share = len(pool) / len(sample)
    return np.append(n[best], d[best]).astype(np.float64), float(votes[best] * share)


def _refine(
    cloud: Cloud, pool: NDArray[np.int64], tolerance: Float, equation: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    inliers = pool
    for round_ in range(3):
        distance = np.abs(cloud.points[pool] @ equation[:3].astype(np.float32) + np.float32(equation[3]))
        alike = cloud.normals[pool] @ equation[:3].astype(np.float32) > (0.94 if round_ < 2 else 0.88)
        inliers = pool[(distance < tolerance[pool]) & alike]
        if len(inliers) < 10 or round_ == 2:
            break
        points = cloud.points[inliers].astype(np.float64)
        weight = 1.0 / np.square(cloud.sigma[inliers].astype(np.float64) + 0.3 * cloud.voxel)
        mean = np.average(points, axis=0, weights=weight)
        centred = (points - mean) * np.sqrt(weight)[:, None]
        n = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        n = n if n @ equation[:3] > 0 else -n
        equation = np.append(n, -n @ mean)
    return equation, inliers


def _pieces(
    cloud: Cloud, inliers: NDArray[np.int64], equation: NDArray[np.float64], min_area: float, unit: float
) -> list[Plane]:
    """The connected parts of a plane's inliers that are large enough."""
    if not len(inliers):
        return []
    cell = max(2.0 * cloud.voxel, 0.02 * unit)
    raster, image = _paint(equation, cloud.points[inliers], cell)
    closed = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    solid = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(solid, connectivity=4)
    rc = raster.cells(cloud.points[inliers])
    own = labels[rc[:, 0], rc[:, 1]]
    out = []
    for label in range(1, count):
        mask = (labels == label).astype(np.uint8)
        area = float((mask & image).sum()) * cell**2
        if area >= min_area:
            out.append(Plane(equation, inliers[own == label], area))
    return sorted(out, key=lambda plane: -plane.area)


def _paint(equation: NDArray[np.float64], points: Float, cell: float) -> tuple[Raster, NDArray[np.uint8]]:
    raster = plane_raster(equation, points, cell)
    rc = raster.cells(points)
    image = np.zeros(raster.shape, np.uint8)
    image[rc[:, 0], rc[:, 1]] = 1
    return raster, image


def plane_raster(equation: NDArray[np.float64], points: Float, cell: float) -> Raster:
    """A grid on the plane that covers the points with a margin."""
    n = equation[:3]
    first = np.cross(n, np.eye(3)[int(np.argmin(np.abs(n)))])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(n, first)])
    local = points @ axes.T
    low = local.min(axis=0) - 3.0 * cell
    size = np.ceil((local.max(axis=0) + 3.0 * cell - low) / cell).astype(int) + 1
    origin = low @ axes - equation[3] * n
    return Raster(origin, axes, cell, (int(size[1]), int(size[0])))


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
