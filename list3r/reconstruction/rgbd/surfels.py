"""A model of surface elements that grows and sharpens as views are fused into it.

Surface elements instead of a volume: no resolution or extent to choose, and cost grows with the visible surface (Keller
et al., "Real-time 3D reconstruction in dynamic scenes using point-based fusion", 2013).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.rgbd.frame_registration import Samples
from list3r.reconstruction.rgbd.kernels import foremost, fuse
from list3r.reconstruction.rgbd.settings import SurfelSettings
from list3r.reconstruction.rgbd.view import Floats, WorkingFrame


class SurfelModel:
    """Surface elements in the coordinates of the first view, N of them."""

    def __init__(self, settings: SurfelSettings, noise: SensorNoise) -> None:
        self._settings, self._noise = settings, noise
        self._room, self._count = np.zeros((0, 8), np.float32), 0

    def __len__(self) -> int:
        return self._count

    @property
    def elements(self) -> Floats:
        """Point, normal, grey value and weight of each. Shape (N, 8)."""
        return self._room[: self._count]

    def visible(self, T_model_cam: NDArray[np.float64], camera: Camera) -> NDArray[np.int32]:
        """Number of the foremost element at each pixel, -1 for none. Shape (h * w,)."""
        intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
        return foremost(self.elements, np.ascontiguousarray(T_model_cam), intrinsics, camera.height, camera.width)

    def samples(self, T_model_cam: NDArray[np.float64], camera: Camera, count: int) -> Samples:
        """About `count` visible elements, evenly spread over the image."""
        index = self.visible(T_model_cam, camera)
        index = index[index >= 0]
        if len(index) > count:
            index = index[np.arange(count) * len(index) // count]
        chosen = self.elements[index]
        points, normals, gray = (np.ascontiguousarray(part) for part in (chosen[:, :3], chosen[:, 3:6], chosen[:, 6]))
        return Samples(points, normals, gray)

    def fuse(self, view: WorkingFrame, T_model_cam: NDArray[np.float64]) -> None:
        """Average the view into the elements that it agrees with, add new ones, weaken those that it sees through.

        Its brightness is brought to the exposure of the model first, where that is another.
        """
        pixel = np.flatnonzero(view.valid)
        R, t = T_model_cam[:3, :3].astype(np.float32), T_model_cam[:3, 3].astype(np.float32)
        local = view.points.reshape(-1, 3)[pixel]
        sigma = self._noise.sigma(local[:, 2])
        rows = np.empty((len(pixel), 8), np.float32)
        rows[:, :3], rows[:, 3:6] = local @ R.T + t, view.normals.reshape(-1, 3)[pixel] @ R.T
        rows[:, 6], rows[:, 7] = view.gray.ravel()[pixel], (np.float32(self._noise.constant_m) / sigma) ** 2
        element = self.visible(T_model_cam, view.camera)[pixel]
        met = np.flatnonzero(element >= 0)[::8]
        step = float(np.median(rows[met, 6] - self.elements[element[met], 6])) if len(met) else 0.0
        if abs(step) > self._settings.exposure_step:
            rows[:, 6] -= np.float32(step)
        seen = rows, np.ascontiguousarray(local[:, 2]), sigma
        limits = self._settings.normal_agreement, self._settings.weight_cap
        new, through = fuse(self.elements, element, seen, np.ascontiguousarray(T_model_cam[:3, 2]), limits)
        if (self.elements[through, 7] <= self._settings.drop_below).any():
            self._drop()
        self._append(rows[new])

    def forget(self, view: WorkingFrame, mask: NDArray[np.bool_], T_model_cam: NDArray[np.float64]) -> None:
        """Drop the elements at the surface that the view shows inside a mask."""
        pixel = np.flatnonzero(view.valid & mask)
        if not len(pixel) or not len(self):
            return
        local = view.points.reshape(-1, 3)[pixel]
        element = self.visible(T_model_cam, view.camera)[pixel]
        R, t = T_model_cam[:3, :3].astype(np.float32), T_model_cam[:3, 3].astype(np.float32)
        depth = (self.elements[element, :3] - t) @ R[:, 2]
        near = (element >= 0) & (np.abs(depth - local[:, 2]) < np.float32(0.05) * local[:, 2])
        self.elements[element[near], 7] = 0.0
        if near.any():
            self._drop()

    def _drop(self) -> None:
        kept = self.elements[self.elements[:, 7] > self._settings.drop_below]
        self._room[: len(kept)], self._count = kept, len(kept)

    def _append(self, rows: Floats) -> None:
        count = self._count + len(rows)
        if count > len(self._room):
            self._room = np.concatenate([self.elements, np.zeros((2 * count - self._count, 8), np.float32)])
        self._room[self._count : count], self._count = rows, count
