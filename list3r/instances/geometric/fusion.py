"""One anchor at working size: the image operations under its fused view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.instances.geometric.kernels import Intrinsics
from list3r.instances.settings import DepthNoiseSettings

Float = NDArray[np.float32]


@dataclass(frozen=True)
class View:
    """One frame at working size with fused depth. All images share their shape (h, w)."""

    position: int
    """Position of the frame in the chunk."""
    T_chunk_cam: NDArray[np.float64]
    """Shape (4, 4)."""
    camera: Camera
    """Pinhole camera at working size."""
    depth: Float
    """Fused depth along z, chunk units, 0 where unknown. Shape (h, w)."""
    sigma: Float
    """Standard deviation of the fused depth. Shape (h, w)."""
    reading: Float
    """Standard deviation of a single reading of this depth. Shape (h, w)."""
    confirmed: NDArray[np.bool_]
    """True where neighbouring frames agree that there is a surface. Shape (h, w)."""
    points: Float
    """Chunk coordinates. Shape (h, w, 3)."""
    normals: Float
    """Unit normals towards the camera, chunk frame, 0 where unknown. Shape (h, w, 3)."""
    rgb: NDArray[np.uint8]
    """Shape (h, w, 3)."""


def small_color(color: NDArray[np.uint8], stride: int) -> NDArray[np.uint8]:
    """Colour at working size, smoothed before every `stride`-th pixel is kept."""
    blurred = cv2.blur(color, (2 * stride - 1, 2 * stride - 1)) if stride > 1 else color
    return np.ascontiguousarray(blurred[::stride, ::stride])


def single_sigma(depth: Float, noise: DepthNoiseSettings, unit: float) -> Float:
    """Standard deviation of depth readings by the noise model. Shape (...)."""
    metres = depth / np.float32(unit)
    return np.asarray((noise.base_m + noise.quadratic_per_m * metres * metres) * unit, dtype=np.float32)


def intrinsics_of(camera: Camera) -> Intrinsics:
    """Return the intrinsics of a camera as compiled loops read them."""
    return np.float32(camera.fx), np.float32(camera.fy), np.float32(camera.cx), np.float32(camera.cy)


def depth_edges(depth: Float, sigma: Float) -> NDArray[np.bool_]:
    """Pixels next to a jump of depth or a hole."""
    kernel = np.ones((3, 3), np.uint8)
    far = np.where(depth > 0, depth, np.float32(1e3))
    low, high = cv2.erode(far, kernel), cv2.dilate(depth, kernel)
    return np.asarray((high - low) > 6.0 * sigma + 0.02 * depth)


def normals_of(points: Float, depth: Float, sigma: Float) -> Float:
    """Normals in camera coordinates from differences of smoothed points, 0 where a depth edge is in the window."""
    known = (depth > 0).astype(np.float32)
    mass = cv2.boxFilter(known, -1, (5, 5), normalize=False)
    mean = cv2.boxFilter(points * known[..., None], -1, (5, 5), normalize=False) / np.maximum(mass, 1.0)[..., None]
    step = 3
    dx, dy = np.zeros_like(mean), np.zeros_like(mean)
    dx[:, step:-step] = mean[:, 2 * step :] - mean[:, : -2 * step]
    dy[step:-step] = mean[2 * step :] - mean[: -2 * step]
    normal = np.cross(dy, dx).astype(np.float32)
    length = np.linalg.norm(normal, axis=-1)
    far = np.where(depth > 0, depth, np.float32(0))
    kernel = np.ones((2 * step + 1, 2 * step + 1), np.uint8)
    near = cv2.erode(np.where(depth > 0, depth, np.float32(1e3)), kernel)
    smooth = (cv2.dilate(far, kernel) - near) < 10.0 * sigma + 0.09 * depth
    ok = (length > 1e-12) & smooth & (mass > 12) & (depth > 0)
    normal = np.where(ok[..., None], normal / np.maximum(length, 1e-12)[..., None], 0.0)
    facing = np.sign(-np.sum(normal * points, axis=-1, keepdims=True))
    return np.asarray(normal * facing, dtype=np.float32)
