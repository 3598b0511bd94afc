"""Anchor views: the depth of neighbouring frames fused into one frame, with normals and the remaining noise."""

from __future__ import annotations

import weakref
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.geometric.fusion import (
    Float,
    View,
    depth_edges,
    intrinsics_of,
    normals_of,
    single_sigma,
    small_color,
)
from list3r.instances.geometric.kernels import read_across
from list3r.instances.geometric.view_alignment import align_views, moved_view
from list3r.instances.settings import AnchorViewSettings, InstanceSettings
from list3r.reconstruction.base import Reconstruction, backproject


class ChunkViews:
    """The views of one chunk, made on demand and kept while the chunk is worked on."""

    def __init__(self, frames: Sequence[Frame], reconstruction: Reconstruction, settings: InstanceSettings) -> None:
        self.frames, self.reconstruction, self.settings = frames, reconstruction, settings
        self.stride = max(1, round(reconstruction.camera.width / settings.view.width_px))
        self.camera = reconstruction.camera.every(self.stride)
        self.unit = working_unit(reconstruction)
        self.anchors = pick_anchors(frames, reconstruction, settings.anchor_step)
        self.noise_scale = 1.0
        self._views: dict[int, View] = {}
        self._corrections: list[NDArray[np.float64]] = []
        if self.anchors:
            if reconstruction.depth_noise is None:
                self.noise_scale = self._measure_noise()
            given = [self._fuse(position) for position in self.anchors]
            aligned = align_views(given, self.unit)
            self._views = {view.position: view for view in aligned}
            self._corrections = [
                a.T_chunk_cam @ np.linalg.inv(g.T_chunk_cam) for a, g in zip(aligned, given, strict=True)
            ]

    def view(self, position: int) -> View:
        """The fused view of the frame at `position`."""
        if position not in self._views:
            self._views[position] = moved_view(self._fuse(position), self._correction(position))
        return self._views[position]

    def pose(self, position: int) -> NDArray[np.float64]:
        """T_chunk_cam of a frame with the correction of the nearest anchor. Shape (4, 4)."""
        return np.asarray(self._correction(position) @ self.reconstruction.T_chunk_cam[position])

    def _correction(self, position: int) -> NDArray[np.float64]:
        nearest = int(np.argmin(np.abs(np.array(self.anchors) - position)))
        return self._corrections[nearest]

    def sigma(self, depth: Float) -> Float:
        """Standard deviation of single depth readings. Shape (...)."""
        if self.reconstruction.depth_noise is not None:
            return self.reconstruction.depth_noise.sigma(depth)
        return single_sigma(depth, self.settings.view.noise, self.unit) * np.float32(self.noise_scale)

    @property
    def noise_law(self) -> tuple[np.float32, np.float32, np.float32, np.float32]:
        """Noise law of `sigma`: base and quadratic share in metres, units of a metre, and a scale."""
        computed, read = self.reconstruction.depth_noise, self.settings.view.noise
        if computed is not None:
            return np.float32(computed.base), np.float32(computed.quadratic), np.float32(1), np.float32(1)
        law = np.float32(read.base_m), np.float32(read.quadratic_per_m)
        return *law, np.float32(self.unit), np.float32(self.noise_scale)

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
        there = np.ascontiguousarray(self.reconstruction.depth[other])
        cameras = intrinsics_of(self.camera), intrinsics_of(self.reconstruction.camera)
        return read_across(depth, cameras[0], moved.astype(np.float32), cameras[1], there)

    def _most_sigma(self, depth: Float) -> Float:
        """Standard deviation beyond which depth shows no objects. Shape (...)."""
        view = self.settings.view
        share = 0.0 if self.reconstruction.depth_noise is None else view.max_computed
        return np.asarray(np.maximum(view.max_sigma_m * self.unit, share * depth), np.float32)

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
        edge = depth_edges(depth, sigma)
        sure = 2 * deny + 3 if self.reconstruction.depth_noise is None else np.inf
        confirmed = (depth > 0) & (agree >= np.maximum(deny, 1)) & ~(edge & (agree < sure))
        alone = (agree + deny == 0) & ~edge & (depth > 0)
        usable = sigma < self._most_sigma(depth)
        T = self.reconstruction.T_chunk_cam[position]
        camera_points = backproject(depth, self.camera)
        points = (camera_points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)).astype(np.float32)
        normals = normals_of(camera_points, depth, sigma) @ T[:3, :3].T.astype(np.float32)
        fused = np.maximum(sigma / np.sqrt(weight), 0.3 * sigma).astype(np.float32)
        rgb = small_color(self.frames[position].color, self.stride)
        return View(position, T, self.camera, depth, fused, sigma, (confirmed | alone) & usable, points, normals, rgb)


_LAST: list[tuple[weakref.ref[Reconstruction], InstanceSettings, ChunkViews]] = []


def chunk_views(frames: Sequence[Frame], reconstruction: Reconstruction, settings: InstanceSettings) -> ChunkViews:
    """The views of a chunk; the latest chunk's are cached, so that discovery and tracking share them."""
    if _LAST and _LAST[0][0]() is reconstruction and _LAST[0][1] == settings:
        return _LAST[0][2]
    views = ChunkViews(frames, reconstruction, settings)
    _LAST[:] = [(weakref.ref(reconstruction), settings, views)]
    return views


def forget_views() -> None:
    """Let go of the latest chunk's views."""
    _LAST.clear()


def pick_anchors(frames: Sequence[Frame], reconstruction: Reconstruction, step: int) -> list[int]:
    """The sharpest posed frame of each run, ascending.

    A run ends after `step` frames, or when the camera has turned by 12 degrees or moved by an eighth of the depth.
    """
    reach = 0.25 * working_unit(reconstruction)
    runs: list[list[int]] = []
    for position in np.flatnonzero(reconstruction.posed).tolist():
        if runs and len(runs[-1]) < step and _near(reconstruction.T_chunk_cam[[runs[-1][0], position]], reach):
            runs[-1].append(position)
        else:
            runs.append([position])
    return [run[int(np.argmax([_sharpness(frames[p].color) for p in run]))] for run in runs]


def _near(T_chunk_cam: NDArray[np.float64], reach: float) -> bool:
    """True where two poses (2, 4, 4) see nearly the same."""
    turn = (np.trace(T_chunk_cam[0, :3, :3].T @ T_chunk_cam[1, :3, :3]) - 1.0) / 2.0
    return bool(turn > np.cos(np.radians(12.0)) and np.linalg.norm(np.diff(T_chunk_cam[:, :3, 3], axis=0)) < reach)


def _sharpness(color: NDArray[np.uint8]) -> float:
    small = np.ascontiguousarray(color[::2, ::2, 1])
    return float(cv2.Laplacian(small, cv2.CV_16S).astype(np.float32).var())


def working_unit(reconstruction: Reconstruction) -> float:
    """Chunk units per metre: 1 when metric, else such that the median depth counts as two metres."""
    if reconstruction.scale_kind == "metric":
        return 1.0
    sample = reconstruction.depth[:: max(1, len(reconstruction.depth) // 10), ::8, ::8]
    sample = sample[sample > 0]
    return float(np.median(sample)) / 2.0 if len(sample) else 1.0


def _neighbours(reconstruction: Reconstruction, position: int, settings: AnchorViewSettings) -> list[int]:
    low, high = position - settings.reach, position + settings.reach + 1
    wanted = range(low + (position - low) % settings.step, high, settings.step)
    count = len(reconstruction.posed)
    return [p for p in wanted if 0 <= p < count and p != position and reconstruction.posed[p]]
