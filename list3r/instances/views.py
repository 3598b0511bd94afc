"""Anchor views: the depth of neighbouring frames fused into one frame, with normals and what the noise leaves."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.instances.settings import InstanceSettings, NoiseSettings, ViewSettings
from list3r.reconstruction.base import Reconstruction, backproject

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
    confirmed: NDArray[np.bool_]
    """True where neighbouring frames agree that there is a surface. Shape (h, w)."""
    points: Float
    """Chunk coordinates. Shape (h, w, 3)."""
    normals: Float
    """Unit normals towards the camera, chunk frame, 0 where unknown. Shape (h, w, 3)."""
    rgb: NDArray[np.uint8]
    """Shape (h, w, 3)."""


class ChunkViews:
    """The views of one chunk, made on demand and kept while the chunk is worked on."""

    def __init__(self, frames: Sequence[Frame], reconstruction: Reconstruction, settings: InstanceSettings) -> None:
        self.frames, self.reconstruction, self.settings = frames, reconstruction, settings
        self.stride = max(1, round(reconstruction.camera.width / settings.view.width_px))
        self.camera = working_camera(reconstruction.camera, self.stride)
        self.unit = working_unit(reconstruction)
        self.anchors = pick_anchors(frames, reconstruction, settings.anchor_step)
        self.noise_scale = 1.0
        self._views: dict[int, View] = {}
        if len(self.anchors):
            self.noise_scale = self._measure_noise()

    def view(self, position: int) -> View:
        """The fused view of the frame at `position`."""
        if position not in self._views:
            self._views[position] = self._fuse(position)
        return self._views[position]

    def sigma(self, depth: Float) -> Float:
        """Standard deviation of single depth readings. Shape (...)."""
        return single_sigma(depth, self.settings.view.noise, self.unit) * np.float32(self.noise_scale)

    def _measure_noise(self) -> float:
        """How much larger the disagreement of frames is than the noise model says, poses included."""
        ratios = []
        for position in self.anchors[:: max(1, len(self.anchors) // 3)]:
            depth = self.small_depth(position)
            for other in _neighbours(self.reconstruction, position, self.settings.view)[::3]:
                residual, seen = self._residual(position, other, depth)
                sigma = single_sigma(depth, self.settings.view.noise, self.unit) * np.sqrt(2.0)
                near = seen & (np.abs(residual) < 12 * sigma)
                if near.sum() > 200:
                    ratios.append(float(np.median(np.abs(residual[near]) / sigma[near])) / 0.6745)
        return float(np.clip(np.median(ratios), 0.7, 3.0)) if ratios else 1.0

    def small_depth(self, position: int) -> Float:
        """Depth of one frame at working size."""
        return np.ascontiguousarray(self.reconstruction.depth[position][:: self.stride, :: self.stride])

    def _residual(self, position: int, other: int, depth: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Depth read in frame `other` less that predicted from `depth` at `position`, and where both are known."""
        moved = np.linalg.inv(self.reconstruction.T_chunk_cam[other]) @ self.reconstruction.T_chunk_cam[position]
        x, y, z = project_depth(depth, self.camera, moved, self.reconstruction.camera)
        read = cv2.remap(self.reconstruction.depth[other], x, y, cv2.INTER_NEAREST, borderValue=0)
        return read - z, (read > 0) & (depth > 0) & (z > 0)

    def _fuse(self, position: int) -> View:
        depth = self.small_depth(position)
        sigma = self.sigma(depth)
        weight, shift = np.ones_like(depth), np.zeros_like(depth)
        agree, deny = np.zeros(depth.shape, np.int32), np.zeros(depth.shape, np.int32)
        for other in _neighbours(self.reconstruction, position, self.settings.view):
            residual, seen = self._residual(position, other, depth)
            tolerance = 4.0 * sigma
            near = seen & (np.abs(residual) < tolerance)
            weight += near
            shift += np.where(near, residual, 0.0)
            agree += near
            deny += seen & (residual >= tolerance)
        depth = np.where(depth > 0, depth + shift / weight, 0.0).astype(np.float32)
        edge = _depth_edges(depth, sigma)
        confirmed = (depth > 0) & (agree >= np.maximum(deny, 1)) & ~(edge & (agree < 2 * deny + 3))
        alone = (agree + deny == 0) & ~edge & (depth > 0)
        T = self.reconstruction.T_chunk_cam[position]
        camera_points = backproject(depth, self.camera)
        points = (camera_points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)).astype(np.float32)
        normals = _normals(camera_points, depth, sigma) @ T[:3, :3].T.astype(np.float32)
        fused = np.maximum(sigma / np.sqrt(weight), 0.3 * sigma).astype(np.float32)
        rgb = small_color(self.frames[position].color, self.stride)
        return View(position, T, self.camera, depth, fused, confirmed | alone, points, normals, rgb)


_LAST: list[tuple[weakref.ref[Reconstruction], InstanceSettings, ChunkViews]] = []


def chunk_views(frames: Sequence[Frame], reconstruction: Reconstruction, settings: InstanceSettings) -> ChunkViews:
    """The views of a chunk; those of the latest chunk are kept, so that discovery and tracking share them."""
    if _LAST and _LAST[0][0]() is reconstruction and _LAST[0][1] == settings:
        return _LAST[0][2]
    views = ChunkViews(frames, reconstruction, settings)
    _LAST[:] = [(weakref.ref(reconstruction), settings, views)]
    return views


def forget_views() -> None:
    """Let go of the latest chunk's views."""
    _LAST.clear()


def pick_anchors(frames: Sequence[Frame], reconstruction: Reconstruction, step: int) -> list[int]:
    """The sharpest posed frame of each run of `step` frames, ascending."""
    posed = np.flatnonzero(reconstruction.posed)
    runs = np.array_split(posed, max(1, round(len(posed) / step))) if len(posed) else []
    return [int(run[np.argmax([_sharpness(frames[p].color) for p in run])]) for run in runs if len(run)]


def _sharpness(color: NDArray[np.uint8]) -> float:
    small = np.ascontiguousarray(color[::2, ::2, 1])
    return float(cv2.Laplacian(small, cv2.CV_16S).astype(np.float32).var())


def working_camera(camera: Camera, stride: int) -> Camera:
    """The camera of an image of which every `stride`-th pixel is kept."""
    height, width = -(-camera.height // stride), -(-camera.width // stride)
    return Camera(width, height, camera.fx / stride, camera.fy / stride, camera.cx / stride, camera.cy / stride)


def working_unit(reconstruction: Reconstruction) -> float:
    """Chunk units per metre: 1 when metric, else such that the median depth counts as two metres."""
    if reconstruction.scale_kind == "metric":
        return 1.0
    sample = reconstruction.depth[:: max(1, len(reconstruction.depth) // 10), ::8, ::8]
    sample = sample[sample > 0]
    return float(np.median(sample)) / 2.0 if len(sample) else 1.0


def small_color(color: NDArray[np.uint8], stride: int) -> NDArray[np.uint8]:
    """Colour at working size, smoothed before every `stride`-th pixel is kept."""
    blurred = cv2.blur(color, (2 * stride - 1, 2 * stride - 1)) if stride > 1 else color
    return np.ascontiguousarray(blurred[::stride, ::stride])


def single_sigma(depth: Float, noise: NoiseSettings, unit: float) -> Float:
    """Standard deviation of depth readings by the noise model. Shape (...)."""
    metres = depth / np.float32(unit)
    return np.asarray((noise.base_m + noise.quadratic_per_m * metres * metres) * unit, dtype=np.float32)


def project_depth(
    depth: Float, camera: Camera, T_other_cam: NDArray[np.float64], other: Camera
) -> tuple[Float, Float, Float]:
    """Where the pixels of a depth image lie in another camera: x, y in px and z. Shape (h, w) each."""
    height, width = depth.shape
    u = (np.arange(width, dtype=np.float32) - camera.cx) / np.float32(camera.fx)
    v = (np.arange(height, dtype=np.float32) - camera.cy) / np.float32(camera.fy)
    R, t = T_other_cam[:3, :3].astype(np.float32), T_other_cam[:3, 3].astype(np.float32)
    row = [R[i, 0] * u[None, :] + (R[i, 1] * v + R[i, 2])[:, None] for i in range(3)]
    X, Y, Z = (r * depth + t[i] for i, r in enumerate(row))
    safe = np.where(Z > 1e-6, Z, np.float32(1e-6))
    x = np.where(depth > 0, X / safe * np.float32(other.fx) + np.float32(other.cx), np.float32(-1e4))
    y = Y / safe * np.float32(other.fy) + np.float32(other.cy)
    return np.clip(x, -1e4, 1e4), np.clip(y, -1e4, 1e4), Z


def _neighbours(reconstruction: Reconstruction, position: int, settings: ViewSettings) -> list[int]:
    low, high = position - settings.reach, position + settings.reach + 1
    wanted = range(low + (position - low) % settings.step, high, settings.step)
    count = len(reconstruction.posed)
    return [p for p in wanted if 0 <= p < count and p != position and reconstruction.posed[p]]


def _depth_edges(depth: Float, sigma: Float) -> NDArray[np.bool_]:
    """Pixels beside a jump of depth or a hole."""
    kernel = np.ones((3, 3), np.uint8)
    far = np.where(depth > 0, depth, np.float32(1e3))
    low, high = cv2.erode(far, kernel), cv2.dilate(depth, kernel)
    return np.asarray((high - low) > 6.0 * sigma + 0.02 * depth)


def _normals(points: Float, depth: Float, sigma: Float) -> Float:
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
