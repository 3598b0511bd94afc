"""A frame at the small working resolution of tracking: depth without edges, points, normals, grey values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

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
    """Brightness, 0 to 255. Shape (h, w)."""


@lru_cache(maxsize=8)
def pixel_rays(camera: Camera) -> Floats:
    """Rays (x, y, 1) through the pixels. Shape (h, w, 3)."""
    x, y = np.meshgrid(
        (np.arange(camera.width) - camera.cx) / camera.fx, (np.arange(camera.height) - camera.cy) / camera.fy
    )
    return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)


def shrink_depth(depth: Floats, camera: Camera, noise: SensorNoise) -> Floats:
    """Depth averaged over blocks; 0 where a block lies across an edge or is mostly unknown. Shape (h, w).

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
    points = depth[..., None] * pixel_rays(camera)
    across, down = np.zeros_like(points), np.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    steepest = np.float32(2 * _MAX_GRAZING_SLOPE / camera.fx) * depth
    known = (depth > 0).astype(np.uint8)
    valid = cv2.erode(known, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    valid[[0, -1]] = valid[:, [0, -1]] = False
    valid &= (np.abs(across[..., 2]) < steepest) & (np.abs(down[..., 2]) < steepest)
    normals = _cross(down, across) * valid[..., None]
    normals /= np.maximum(_norm(normals), 1e-12)
    normals = np.asarray(cv2.blur(normals, (3, 3)), np.float32)
    normals /= np.maximum(_norm(normals), 1e-6)
    return points, normals, valid


def make_view(color: NDArray[np.uint8], depth: Floats, camera: Camera, noise: SensorNoise) -> WorkingFrame:
    """Return the view of a frame for `camera`, which is the frame's own camera shrunk. `color` is RGB (H, W, 3)."""
    small = shrink_depth(depth, camera, noise)
    points, normals, valid = surface(small, camera)
    gray = cv2.cvtColor(
        cv2.resize(color, (camera.width, camera.height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY
    )
    return WorkingFrame(camera, small, points, normals, valid, gray.astype(np.float32))


def _norm(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None])


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product over the last axis, several times faster than `np.cross` on images."""
    ax, ay, az, bx, by, bz = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
