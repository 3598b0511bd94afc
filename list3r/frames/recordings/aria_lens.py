"""The fisheye camera of Aria glasses, and the upright pinhole camera that its pictures are taken to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.recordings.axes import CLOCKWISE
from list3r.frames.selection import working_size

_GRID = 8
"""Spacing of the pixels at which the lens is computed; between these it is straight to a few thousandths of one."""


@dataclass(frozen=True)
class AriaLens:
    """The lens of the colour camera, as the recording's calibration has it."""

    calibration: Any
    """Projects points of the camera, see `projectaria_tools.core.calibration.CameraCalibration`."""
    T_device_cam: NDArray[np.float64]
    """Shape (4, 4)."""

    def pixels(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where directions of the camera are seen, px. Shape (N, 3) -> (N, 2)."""
        return np.array([self.calibration.project_no_checks(ray) for ray in rays])


class UprightView:
    """Takes fisheye pictures to those of an upright pinhole camera of the same size and focal length."""

    def __init__(self, lens: AriaLens, size: tuple[int, int], turns: int, limit: int) -> None:
        """`turns` are clockwise quarter turns of the picture that put it upright."""
        focal, (width, height) = float(lens.calibration.get_focal_lengths()[0]), size[::-1]
        if turns % 2:
            width, height = height, width
        whole = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self.camera = whole.resized(*working_size((height, width), limit))
        self.T_cam_upright = np.linalg.matrix_power(CLOCKWISE, turns)
        column, row = (_grid(n) for n in (self.camera.width, self.camera.height))
        x, y = (column - self.camera.cx) / self.camera.fx, (row - self.camera.cy) / self.camera.fy
        rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1) @ self.T_cam_upright[:3, :3].T
        coarse = lens.pixels(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2).astype(np.float32)
        at = np.meshgrid(*(np.arange(n, dtype=np.float32) / _GRID for n in (self.camera.width, self.camera.height)))
        self._at = cv2.remap(coarse, at[0], at[1], cv2.INTER_LINEAR)
        from_centre = np.linalg.norm(self._at - np.asarray(lens.calibration.get_principal_point(), np.float32), axis=2)
        inside = (self._at >= 0).all(axis=2) & (self._at <= np.array(size[::-1]) - 1).all(axis=2)
        self._seen = inside & (from_centre <= (lens.calibration.get_valid_radius() or np.inf))
        self._small = self.camera.width / whole.width

    def color(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the picture in RGB, black where the lens sees nothing. Shape (H, W, 3)."""
        if image.ndim == 2:
            image = np.repeat(image[:, :, None], 3, axis=2)
        at = self._at
        if self._small < 1:
            image = cv2.resize(image, None, fx=self._small, fy=self._small, interpolation=cv2.INTER_AREA)
            at = (at + 0.5) * np.float32(self._small) - 0.5
        straight = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        return np.asarray(straight * self._seen[:, :, None], np.uint8)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth of the nearest pixel, 0 where unknown. Shape (H, W)."""
        return np.asarray(
            cv2.remap(depth, self._at[..., 0], self._at[..., 1], cv2.INTER_NEAREST) * self._seen, np.float32
        )


def _grid(count: int) -> NDArray[np.float64]:
    """Pixels at that spacing, and one beyond the last."""
    return np.arange(0, count + _GRID, _GRID, dtype=np.float64)
