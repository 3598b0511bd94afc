"""A model of surface elements that grows and sharpens as views are fused into it.

Surface elements instead of a volume: no resolution or extent to choose, and cost follows what is seen (Keller et al.,
"Real-time 3D reconstruction in dynamic scenes using point-based fusion", 2013).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.rgbd.registration import Samples
from list3r.reconstruction.rgbd.settings import SurfelSettings
from list3r.reconstruction.rgbd.view import Floats, WorkingFrame


class SurfelModel:
    """Surface elements in the coordinates of the first view, N of them."""

    def __init__(self, settings: SurfelSettings, noise: SensorNoise) -> None:
        self._settings, self._noise = settings, noise
        self.points = np.zeros((0, 3), np.float32)
        self.normals = np.zeros((0, 3), np.float32)
        self.gray = np.zeros(0, np.float32)
        self.weight = np.zeros(0, np.float32)

    def __len__(self) -> int:
        return len(self.points)

    def visible(self, T_model_cam: NDArray[np.float64], camera: Camera) -> NDArray[np.int64]:
        """Number of the foremost element at each pixel, -1 for none. Shape (h * w,)."""
        R, t = T_model_cam[:3, :3].astype(np.float32), T_model_cam[:3, 3].astype(np.float32)
        rays = self.points - t
        facing = np.einsum("ij,ij->i", rays, self.normals) < 0
        candidates = np.flatnonzero(facing & (rays @ R[:, 2] > 0.1))
        p = rays[candidates] @ R
        u = np.rint(p[:, 0] / p[:, 2] * np.float32(camera.fx) + np.float32(camera.cx))
        v = np.rint(p[:, 1] / p[:, 2] * np.float32(camera.fy) + np.float32(camera.cy))
        inside = np.flatnonzero((u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height))
        order = inside[np.argsort(-p[inside, 2], kind="stable")]
        foremost = np.full(camera.height * camera.width, -1, np.int64)
        foremost[v[order].astype(np.int64) * camera.width + u[order].astype(np.int64)] = candidates[order]
        return foremost

    def samples(self, T_model_cam: NDArray[np.float64], camera: Camera, count: int) -> Samples:
        """About `count` visible elements, evenly spread over the image."""
        foremost = self.visible(T_model_cam, camera)
        index = foremost[foremost >= 0]
        if len(index) > count:
            index = index[np.arange(count) * len(index) // count]
        return Samples(self.points[index], self.normals[index], self.gray[index])

    def fuse(self, view: WorkingFrame, T_model_cam: NDArray[np.float64]) -> None:
        """Average the view into the elements that it agrees with, add what is new, weaken what it sees through."""
        pixel = np.flatnonzero(view.valid)
        R, t = T_model_cam[:3, :3].astype(np.float32), T_model_cam[:3, 3].astype(np.float32)
        local = view.points.reshape(-1, 3)[pixel]
        sigma = self._noise.sigma(local[:, 2])
        points, normals = local @ R.T + t, view.normals.reshape(-1, 3)[pixel] @ R.T
        gray, weight = view.gray.ravel()[pixel], (np.float32(self._noise.constant_m) / sigma) ** 2
        if not len(self):
            self._append(points, normals, gray, weight)
            return
        element = self.visible(T_model_cam, view.camera)[pixel]
        behind = np.einsum("ij,j->i", points - self.points[element], R[:, 2])
        limit = 3 * sigma + np.float32(0.01) * local[:, 2]
        hit = element >= 0
        alike = np.einsum("ij,ij->i", self.normals[element], normals) > self._settings.normal_agreement
        same = hit & (np.abs(behind) < limit) & alike
        self._average(element[same], points[same], normals[same], gray[same], weight[same])
        through = element[hit & (behind > limit)]
        self.weight[through] *= 0.5
        new = ~hit | (np.abs(behind) > limit)
        if (self.weight[through] <= self._settings.drop_below).any():
            self._drop()
        self._append(points[new], normals[new], gray[new], weight[new])

    def forget(self, view: WorkingFrame, mask: NDArray[np.bool_], T_model_cam: NDArray[np.float64]) -> None:
        """Drop the elements at the surface that the view shows inside a mask."""
        pixel = np.flatnonzero(view.valid & mask)
        if not len(pixel) or not len(self):
            return
        local = view.points.reshape(-1, 3)[pixel]
        element = self.visible(T_model_cam, view.camera)[pixel]
        R, t = T_model_cam[:3, :3].astype(np.float32), T_model_cam[:3, 3].astype(np.float32)
        depth = (self.points[element] - t) @ R[:, 2]
        near = (element >= 0) & (np.abs(depth - local[:, 2]) < np.float32(0.05) * local[:, 2])
        self.weight[element[near]] = 0.0
        if near.any():
            self._drop()

    def _average(self, index: NDArray[np.int64], points: Floats, normals: Floats, gray: Floats, weight: Floats) -> None:
        old = self.weight[index]
        total = old + weight
        share = (weight / total)[:, None]
        self.points[index] += (points - self.points[index]) * share
        normal = self.normals[index] + (normals - self.normals[index]) * share
        self.normals[index] = normal / np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None]
        self.gray[index] += (gray - self.gray[index]) * share[:, 0]
        self.weight[index] = np.minimum(total, self._settings.weight_cap)

    def _drop(self) -> None:
        keep = self.weight > self._settings.drop_below
        self.points, self.normals = self.points[keep], self.normals[keep]
        self.gray, self.weight = self.gray[keep], self.weight[keep]

    def _append(self, points: Floats, normals: Floats, gray: Floats, weight: Floats) -> None:
        self.points = np.concatenate([self.points, points])
        self.normals = np.concatenate([self.normals, normals])
        self.gray = np.concatenate([self.gray, gray])
        self.weight = np.concatenate([self.weight, weight])
