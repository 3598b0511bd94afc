"""Depth of one camera onto the pixels of another: forward projection with a z-buffer, and no invented surfaces."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.registration.kernels import close_gaps, project

# Two neighbouring depth pixels lie on one surface when their depths differ by less than this share of the depth for
# every radian between them (a slant of 80 degrees), or by less than the sensor's own noise, quadratic in depth.
_SLANT = math.tan(math.radians(80.0))
_NOISE_PER_M = 0.006


class DepthReprojection:
    """Moves depth images of one camera onto the pixels of another, with everything that does not change tabulated."""

    def __init__(self, depth_camera: Camera, color_camera: Camera, T_color_depth: NDArray[np.float64]) -> None:
        """`color_camera` is taken as a pinhole; `T_color_depth` is rigid, metres, shape (4, 4)."""
        ratio = max(color_camera.fx / depth_camera.fx, color_camera.fy / depth_camera.fy)
        self.depth_camera, self.color_camera, self.T_color_depth = depth_camera, color_camera, T_color_depth
        self.factor = max(1, math.ceil(ratio - 0.15))
        """Samples for each depth pixel and axis, so that neighbours land at most about one colour pixel apart."""
        self._source = _finer(depth_camera, self.factor)
        self._jump = _SLANT / min(self._source.fx, self._source.fy)
        rotation, translation = T_color_depth[:3, :3], T_color_depth[:3, 3]
        x = (np.arange(self._source.width) - self._source.cx) / self._source.fx
        y = (np.arange(self._source.height) - self._source.cy) / self._source.fy
        rays = np.stack([np.broadcast_to(x, (len(y), len(x))), np.broadcast_to(y[:, None], (len(y), len(x)))], axis=-1)
        rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).reshape(-1, 3)
        projection = color_camera.matrix() @ rotation
        slope = (rays @ projection.T).astype(np.float32)
        self._shift = (color_camera.matrix() @ translation).astype(np.float32)
        self._slope = np.ascontiguousarray(slope.T)
        self._straight = bool(np.allclose(slope[:, 2], 1.0, atol=1e-7)) and abs(float(self._shift[2])) < 1e-9

    def __call__(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Depth along the colour camera's z on its pixels, metres, 0 where unknown.

        `depth` is the depth camera's, metres, 0 where unknown, shape (H, W) of the depth camera.
        """
        fine = _refine(depth, self.factor, self._jump) if self.factor > 1 else depth
        size = self.color_camera.height, self.color_camera.width
        out, origin = project(fine.ravel(), self._slope, self._shift, self._straight, *size)
        return close_gaps(out, origin, fine, self._jump, _NOISE_PER_M)


def _finer(camera: Camera, factor: int) -> Camera:
    """Return the camera of an image with `factor` samples for each pixel and axis, sharing the first pixel's centre."""
    return Camera(
        (camera.width - 1) * factor + 1,
        (camera.height - 1) * factor + 1,
        camera.fx * factor,
        camera.fy * factor,
        camera.cx * factor,
        camera.cy * factor,
    )


def _refine(depth: NDArray[np.float32], factor: int, jump: float) -> NDArray[np.float32]:
    """Depth with samples between neighbours of one surface, none between others. Shape (H, W) -> finer."""
    for axis in (0, 1):
        depth = _refine_axis(depth, factor, jump * factor, axis)
    return depth


def _refine_axis(depth: NDArray[np.float32], factor: int, jump: float, axis: int) -> NDArray[np.float32]:
    lines = np.moveaxis(depth, axis, 0)
    a, b = lines[:-1], lines[1:]
    smooth = (a > 0) & (b > 0) & (np.abs(a - b) <= jump * np.minimum(a, b) + _NOISE_PER_M * a * b)
    out = np.zeros(((len(lines) - 1) * factor + 1, *lines.shape[1:]), dtype=np.float32)
    out[::factor] = lines
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_a, inverse_b = 1.0 / a, 1.0 / b
    for k in range(1, factor):
        w = k / factor
        with np.errstate(invalid="ignore"):
            between = 1.0 / ((1 - w) * inverse_a + w * inverse_b)
        out[k::factor] = np.where(smooth, between, 0.0)
    return np.ascontiguousarray(np.moveaxis(out, 0, axis))


class Undistortion:
    """Takes images of a lens to those of a pinhole camera."""

    def __init__(self, camera: Camera, target: Camera | None = None) -> None:
        """Without a `target` the pinhole camera has the focal length and centre of the lens."""
        pinhole = target or camera.pinhole()
        size = (pinhole.width, pinhole.height)
        coefficients = np.array(camera.distortion, dtype=np.float64)
        matrix, new = camera.matrix(), pinhole.matrix()
        if camera.fisheye:
            angles = np.resize([*coefficients, 0.0, 0.0, 0.0, 0.0], 4)
            self._maps = cv2.fisheye.initUndistortRectifyMap(matrix, angles, np.eye(3), new, size, cv2.CV_16SC2)
        else:
            self._maps = cv2.initUndistortRectifyMap(matrix, coefficients, np.eye(3), new, size, cv2.CV_16SC2)
        self.seen = self._remap(np.ones((camera.height, camera.width), np.uint8), cv2.INTER_NEAREST) > 0
        """False where the pinhole image looks beyond the lens's picture. Shape (H, W)."""

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Bilinear, black beyond the picture. Shape (H, W, 3)."""
        return self._remap(image, cv2.INTER_LINEAR)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Nearest pixel, for depth that lies on the lens's picture. Shape (H, W)."""
        return self._remap(depth, cv2.INTER_NEAREST)

    def _remap(self, image: NDArray, method: int) -> NDArray:  # type: ignore[type-arg]
        return np.asarray(cv2.remap(image, self._maps[0], self._maps[1], method, borderMode=cv2.BORDER_CONSTANT))
