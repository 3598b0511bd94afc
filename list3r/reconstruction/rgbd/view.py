"""A frame at the small working resolution of tracking: depth without edges, points, normals, grey values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled
from list3r.frames.base import Camera
from list3r.reconstruction.base import SensorNoise

Floats = NDArray[np.float32]

_MAX_GRAZING_SLOPE = 4.0
"""Tangent of the steepest angle between view ray and surface normal that still counts as a surface (76 degrees)."""


@dataclass(frozen=True)
class WorkingFrame:
    """A frame at working resolution."""

    camera: Camera
    """Pinhole camera of the small images, px."""
    depth: Floats
    """Depth along z, metres, 0 where unknown or across an edge. Shape (h, w)."""
    points: Floats
    """Camera coordinates, metres. Shape (h, w, 3)."""
    normals: Floats
    """Unit normals towards the camera, 0 where unknown. Shape (h, w, 3)."""
    valid: NDArray[np.bool_]
    """Where depth and normal are both known. Shape (h, w)."""
    gray: Floats
    """Brightness, see `tones`. Shape (h, w)."""

    @cached_property
    def known_share(self) -> float:
        """Share of the pixels with depth and normal."""
        return float(self.valid.mean())

    @cached_property
    def middle_depth(self) -> float:
        """Median of the known depth, metres."""
        return float(np.median(self.depth[self.depth > 0]))


_DARK = np.float32(24.0)
_SCALE = np.float32(128.0) + _DARK


@lru_cache(maxsize=8)
def pixel_rays(camera: Camera) -> Floats:
    """Rays (x, y, 1) through the pixels. Shape (h, w, 3)."""
    x, y = np.meshgrid(
        (np.arange(camera.width) - camera.cx) / camera.fx, (np.arange(camera.height) - camera.cy) / camera.fy
    )
    return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)


def shrink_depth(depth: Floats, camera: Camera, noise: SensorNoise) -> Floats:
    """Depth averaged over blocks; 0 where a block is across an edge or is mostly unknown. Shape (h, w).

    A block of a plane seen at a slope s spreads by s * footprint / sqrt(12); more spread than the steepest slope
    gives, plus noise, is an edge.
    """
    size, area = (camera.width, camera.height), cv2.INTER_AREA
    if depth.shape == (camera.height, camera.width):
        return np.ascontiguousarray(depth)
    share, mean, square = (
        np.asarray(cv2.resize(image, size, interpolation=area), np.float32)
        for image in ((depth > 0).astype(np.float32), depth, depth * depth)
    )
    known = np.maximum(share, np.float32(1e-6))
    mean = np.asarray(mean / known, np.float32)
    variance = square / known - mean * mean
    spread = np.float32(_MAX_GRAZING_SLOPE / (camera.fx * np.sqrt(12.0))) * mean + 2 * noise.sigma(mean)
    return np.where((share >= 0.5) & (variance < spread * spread), mean, np.float32(0))


def surface(depth: Floats, camera: Camera) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Points, unit normals and where both are known, of a depth image. Shapes (h, w, 3), (h, w, 3), (h, w)."""
    known = (depth > 0).astype(np.uint8)
    valid = cv2.erode(known, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    valid[[0, -1]] = valid[:, [0, -1]] = False
    points, normals = _surface(depth, pixel_rays(camera), valid, 2 * _MAX_GRAZING_SLOPE / camera.fx)
    return points, _unit(np.ascontiguousarray(cv2.blur(normals, (3, 3)))), valid


def cosines(points: Floats, normals: Floats, valid: NDArray[np.bool_]) -> Floats:
    """Cosine of the angle between the ray to the camera and the normal, NaN where unknown. Shape (h, w)."""
    distance = np.sqrt(np.einsum("...i,...i->...", points, points))
    cosine = -np.einsum("...i,...i->...", points, normals) / np.maximum(distance, 1e-6)
    return np.where(valid, cosine, np.float32(np.nan))


@compiled
def _surface(depth: Floats, rays: Floats, valid: NDArray[np.bool_], steepest: float) -> tuple[Floats, Floats]:
    """Points and unit normals of a depth image; `valid` is cleared, in place, where depth is too steep."""
    points, normals = np.empty(rays.shape, np.float32), np.zeros(rays.shape, np.float32)
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            for c in range(3):
                points[row, column, c] = depth[row, column] * rays[row, column, c]
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            if not valid[row, column]:
                continue
            ax = points[row, column + 1, 0] - points[row, column - 1, 0]
            ay = points[row, column + 1, 1] - points[row, column - 1, 1]
            az = points[row, column + 1, 2] - points[row, column - 1, 2]
            bx = points[row + 1, column, 0] - points[row - 1, column, 0]
            by = points[row + 1, column, 1] - points[row - 1, column, 1]
            bz = points[row + 1, column, 2] - points[row - 1, column, 2]
            limit = steepest * depth[row, column]
            if abs(az) >= limit or abs(bz) >= limit:
                valid[row, column] = False
                continue
            x, y, z = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-12))
            normals[row, column, 0], normals[row, column, 1] = x / length, y / length
            normals[row, column, 2] = z / length
    return points, normals


@compiled
def _unit(vectors: Floats) -> Floats:
    """Vectors (h, w, 3) of length one, in place."""
    for row in range(vectors.shape[0]):
        for column in range(vectors.shape[1]):
            v = vectors[row, column]
            length = max(np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), np.float32(1e-6))
            for c in range(3):
                v[c] /= length
    return vectors


def make_view(color: NDArray[np.uint8], depth: Floats, camera: Camera, noise: SensorNoise) -> WorkingFrame:
    """Return the view of a frame for `camera`, which is the frame's own camera shrunk. `color` is RGB (H, W, 3)."""
    small = shrink_depth(depth, camera, noise)
    points, normals, valid = surface(small, camera)
    gray = cv2.cvtColor(
        cv2.resize(color, (camera.width, camera.height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY
    )
    return WorkingFrame(camera, small, points, normals, valid, tones(gray))


def tones(gray: NDArray[Any]) -> Floats:
    """Return brightness on a logarithmic scale, to which another exposure adds a constant. Shape (h, w).

    Its unit is a grey level at middle grey; below `_DARK` grey levels most differences are noise.
    """
    return np.asarray(_SCALE * np.log1p(gray.astype(np.float32) / _DARK), np.float32)
