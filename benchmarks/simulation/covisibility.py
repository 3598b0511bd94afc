"""Which frames show the same surface: the truth for revisits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from benchmarks.simulation.video import SimulatedVideo
from list3r.frames.base import Camera

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

MOST_DEG = 75.0
"""Angle between two lines of sight up to which a surface counts as seen again. Two cameras that face each other in a
corridor see the same walls but cannot be matched."""
_TOLERANCE = 0.03
"""Relative difference of depth up to which a point is seen, added to the range within a pixel of it."""
_POINTS = 320
"""About how many pixels of a frame are asked after."""


def covisibility(video: SimulatedVideo, frames_a: Sequence[int], frames_b: Sequence[int]) -> Floats:
    """Share of the picture that two frames have in common, the lesser of both directions. Shape (A, B), in [0, 1].

    Only static surfaces count: pixels of movers are left out on both sides, and surfaces behind a mover are not seen. A
    surface counts as seen again from a direction that differs by at most `MOST_DEG`.
    """
    a, b = np.asarray(frames_a, dtype=np.int64), np.asarray(frames_b, dtype=np.int64)
    return np.minimum(seen_share(video, a, b), seen_share(video, b, a).T)


def seen_share(
    video: SimulatedVideo,
    frames_a: Sequence[int] | NDArray[np.int64],
    frames_b: Sequence[int] | NDArray[np.int64],
    most_deg: float = MOST_DEG,
) -> Floats:
    """Share of the static pixels of each frame a that are seen in each frame b. Shape (A, B), in [0, 1].

    Lines of sight to a point differ by at most `most_deg`.
    """
    a, b = np.asarray(frames_a, dtype=np.int64), np.asarray(frames_b, dtype=np.int64)
    moving = [mover.id for mover in video.movers]
    depth_a = np.where(np.isin(video.ids[a], moving), 0, video.depth[a]) if moving else video.depth[a]
    depth_b = np.where(np.isin(video.ids[b], moving), 0, video.depth[b]) if moving else video.depth[b]
    out = np.zeros((len(a), len(b)), np.float32)
    for at_a, camera_a in video.cameras(a):
        views_a = Views(depth_a[at_a], video.T_world_cam[a[at_a]], camera_a)
        for at_b, camera_b in video.cameras(b):
            views_b = Views(depth_b[at_b], video.T_world_cam[b[at_b]], camera_b)
            out[np.ix_(at_a, at_b)] = shared_view(views_a, views_b, most_deg)
    return out


@dataclass(frozen=True)
class Views:
    """Pictures of one camera."""

    depth: Floats
    """Metres, 0 for ignored pixels. Shape (N, H, W)."""
    T_world_cam: Array
    """Shape (N, 4, 4)."""
    camera: Camera


def shared_view(a: Views, b: Views, most_deg: float = MOST_DEG) -> Floats:
    """Share of the pixels with depth in each picture a that are seen in each picture b. Shape (A, B).

    A point is seen where its depth in b is between the least and the greatest depth of the 3x3 pixels about it, 3 %
    added on either side, and where its two lines of sight differ by at most `most_deg`.
    """
    depth_a, T_world_a, depth_b, T_world_b, camera = a.depth, a.T_world_cam, b.depth, b.T_world_cam, a.camera
    step = max(1, int(np.sqrt(camera.width * camera.height / _POINTS)))
    rows, columns = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step].reshape(2, -1)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(rows))], axis=1)
    rays = rays.astype(np.float32)
    around = (1, 3, 3)
    least = minimum_filter(np.where(depth_b > 0, depth_b, np.inf), around).reshape(len(depth_b), -1)
    most = maximum_filter(depth_b, around).reshape(len(depth_b), -1)
    lower = np.asarray(least * (1 - _TOLERANCE), dtype=np.float32)
    upper = np.asarray(most * (1 + _TOLERANCE), dtype=np.float32)
    T_b_world = np.linalg.inv(T_world_b)
    out = np.zeros((len(depth_a), len(depth_b)), np.float32)
    for k, T_world_cam in enumerate(T_world_a):
        z = depth_a[k, rows, columns]
        known = z > 0
        if not known.any():
            continue
        T_b_a = (T_b_world @ T_world_cam).astype(np.float32)
        points = np.asarray(rays[known] * z[known, None], dtype=np.float32)
        local = np.matmul(T_b_a[:, :3, :3], points.T) + T_b_a[:, :3, 3:]
        seen = _seen(local, lower, upper, b.camera)
        if most_deg < 180:
            unit = points / np.linalg.norm(points, axis=1, keepdims=True)
            cosine = np.einsum("bkn,bkn->bn", np.matmul(T_b_a[:, :3, :3], unit.T), local)
            seen &= cosine >= np.cos(np.deg2rad(most_deg)) * np.linalg.norm(local, axis=1)
        out[k] = seen.mean(axis=1)
    return out


def _seen(local: Floats, lower: Floats, upper: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Whether points (B, 3, N) in the cameras' frames meet the depth that the pictures have there. Shape (B, N)."""
    x, y, z = local[:, 0], local[:, 1], local[:, 2]
    safe = np.where(z > 0.05, z, np.float32(1))
    u = np.rint(np.float32(camera.fx) * x / safe + np.float32(camera.cx))
    v = np.rint(np.float32(camera.fy) * y / safe + np.float32(camera.cy))
    inside = (z > 0.05) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixel = np.where(inside, v * camera.width + u, 0).astype(np.int64)
    low, high = np.take_along_axis(lower, pixel, 1), np.take_along_axis(upper, pixel, 1)
    return np.asarray(inside & (z >= low) & (z <= high))
