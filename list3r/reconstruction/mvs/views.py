"""Choose the keyframes of the sweep, the frames that each is compared with, and the range of depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.mvs.images import Poses
from list3r.reconstruction.mvs.settings import DepthFusionSettings, SweepViewSettings

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ViewPairs:
    """Overlap of every keyframe with every frame at the typical depth. Shape (K, F) each."""

    overlap: Floats
    """Share of the keyframe's picture, in [0, 1]; 0 for itself and for frames without a pose."""
    angle_deg: Floats
    """Median angle of triangulation."""
    distance: Floats
    """Between the cameras, chunk units."""


def choose_keyframes(
    posed: NDArray[np.bool_], T_chunk_cam: Poses, depth: Floats, sharp: Floats, settings: SweepViewSettings
) -> list[int]:
    """Positions of the sharpest frame of each run of nearly equal views. `depth` (F,) is the typical one."""
    runs: list[list[int]] = []
    stride = max(1, min(settings.stride, int(posed.sum()) // settings.least_keyframes))
    for position in np.flatnonzero(posed).tolist():
        if runs and len(runs[-1]) < stride and _near(T_chunk_cam, runs[-1][0], position, depth, settings):
            runs[-1].append(position)
        else:
            runs.append([position])
    return [run[int(np.argmax(sharp[run]))] for run in runs]


def _near(T: Poses, first: int, second: int, depth: Floats, settings: SweepViewSettings) -> bool:
    shift = float(np.linalg.norm(T[first, :3, 3] - T[second, :3, 3]))
    cosine = (np.trace(T[first, :3, :3].T @ T[second, :3, :3]) - 1.0) / 2.0
    return bool(shift < settings.step * depth[first] and cosine > np.cos(np.radians(settings.turn_deg)))


def pair_views(
    keyframes: Sequence[int], posed: NDArray[np.bool_], T_chunk_cam: Poses, camera: Camera, depth: Floats
) -> ViewPairs:
    """Overlap and parallax of keyframes with all frames, from a few rays at the typical depth."""
    rays = _few_rays(camera)
    centers, into = T_chunk_cam[:, :3, 3], np.linalg.inv(T_chunk_cam)
    shape = (len(keyframes), len(posed))
    overlap, angle, distance = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for row, key in enumerate(keyframes):
        points = rays * depth[key] @ T_chunk_cam[key, :3, :3].T + centers[key]
        seen = _inside(points, into, camera)
        a, b = points - centers[key], points[None] - centers[:, None]
        cosine = np.einsum("ni,fni->fn", a, b) / np.linalg.norm(a, axis=1) / np.maximum(np.linalg.norm(b, axis=2), 1e-9)
        overlap[row] = seen.mean(axis=1) * posed
        overlap[row, key] = 0.0
        angle[row] = np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)), axis=1))
        distance[row] = np.linalg.norm(centers - centers[key], axis=1)
    return ViewPairs(overlap, angle, distance)


def _few_rays(camera: Camera) -> Floats:
    """Return 20 rays all over a picture, with z = 1. Shape (20, 3)."""
    u = np.linspace(0.1, 0.9, 5) * (camera.width - 1)
    v = np.linspace(0.1, 0.9, 4) * (camera.height - 1)
    grid = np.stack(np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy), axis=-1).reshape(-1, 2)
    return np.concatenate([grid, np.ones((len(grid), 1))], axis=1)


def _inside(points: Floats, T_cam_chunk: NDArray[np.floating], camera: Camera) -> NDArray[np.bool_]:
    """Return which points (N, 3) are in which cameras' pictures. Shape (C, N)."""
    local = np.einsum("fij,nj->fni", T_cam_chunk[:, :3, :3], points) + T_cam_chunk[:, None, :3, 3]
    z = np.maximum(local[..., 2], 1e-9)
    x, y = local[..., 0] / z * camera.fx + camera.cx, local[..., 1] / z * camera.fy + camera.cy
    return np.asarray((local[..., 2] > 1e-9) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))


def seen_parts(
    keyframes: Sequence[int], posed: NDArray[np.bool_], T_chunk_cam: Poses, camera: Camera, depth: Floats
) -> NDArray[np.bool_]:
    """Return which of a few rays of each frame, at its typical depth, each keyframe sees. Shape (F, K, N)."""
    rays, into = _few_rays(camera), np.linalg.inv(T_chunk_cam[list(keyframes)])
    out = np.zeros((len(posed), len(keyframes), len(rays)), dtype=bool)
    for position in np.flatnonzero(posed).tolist():
        points = rays * depth[position] @ T_chunk_cam[position, :3, :3].T + T_chunk_cam[position, :3, 3]
        out[position] = _inside(points, into, camera)
    return out


def choose_projected(
    overlap: Floats, parts: NDArray[np.bool_], apart: NDArray[np.int64], settings: DepthFusionSettings
) -> list[int]:
    """Return the keyframes whose depth is projected into a frame, best first.

    `overlap` (K,) is the share of each keyframe's picture that the frame sees: closer views measure depth best. `parts`
    (K, N) are the parts of the frame that each sees, `apart` (K,) the number of frames between. Keyframes with parts
    seen by few others come first: all close views of one part would leave the rest of the frame without depth.
    """
    order = [int(k) for k in np.lexsort((apart, -overlap)) if overlap[k] > 0]
    covered, first = np.zeros(parts.shape[1], dtype=np.int64), list[int]()
    for k in order:
        if (parts[k] & (covered < settings.projected_least)).sum() >= 2:
            first.append(k)
            covered += parts[k]
    first = first[: settings.projected_from]
    return first + [k for k in order if k not in first][: settings.projected_from - len(first)]


def choose_sources(
    row: int, pairs: ViewPairs, T_chunk_cam: Poses, sharp: Floats, key: int, settings: SweepViewSettings
) -> list[int]:
    """Positions of a keyframe's sources, alternating between its two sides. Empty without parallax.

    Best first by overlap, angle and sharpness; a camera near another source counts less.
    """
    angle, overlap = pairs.angle_deg[row], pairs.overlap[row]
    usable = (angle > settings.least_deg) & (angle < settings.most_deg) & (overlap > settings.least_overlap)
    fit = np.exp(-0.5 * np.square(np.log(np.maximum(angle, 1e-6) / settings.ideal_deg) / settings.angle_spread))
    score = np.where(usable, overlap * fit * np.sqrt(sharp / max(float(sharp.max()), 1e-12)), 0.0)
    centers, chosen = T_chunk_cam[:, :3, 3], list[int]()
    while len(chosen) < settings.sources and score.max() > 0:
        best = int(np.argmax(score))
        chosen.append(best)
        apart = np.linalg.norm(centers - centers[best], axis=1) / max(float(pairs.distance[row, best]), 1e-9)
        score = score * np.clip(apart / 0.5, 0.1, 1.0)
        score[best] = 0.0
    return _in_turn(chosen, centers, key) if len(chosen) >= 2 else []


def _in_turn(chosen: list[int], centers: Floats, key: int) -> list[int]:
    """Sources ordered so that they alternate between two sides of the keyframe as far as possible."""
    offsets = centers[chosen] - centers[key]
    axis = np.linalg.svd(offsets)[2][0]
    order = np.argsort(offsets @ axis, kind="stable")
    half = (len(order) + 1) // 2
    left, right = order[:half].tolist(), order[half:].tolist()
    return [chosen[k] for pair in zip(left, [*right, None], strict=False) for k in pair if k is not None]


def choose_neighbours(row: int, keyframes: Sequence[int], pairs: ViewPairs, settings: SweepViewSettings) -> list[int]:
    """Numbers of the keyframes of most overlap, from not too different positions."""
    overlap = pairs.overlap[row, list(keyframes)]
    angle = pairs.angle_deg[row, list(keyframes)]
    score = np.where((overlap > settings.least_overlap) & (angle < settings.most_deg), overlap - 0.01 * angle, 0.0)
    order = np.argsort(-score, kind="stable")[: settings.neighbours]
    return [int(k) for k in order if score[k] > 0]


def plane_depths(
    near: float, far: float, parallax_px: float, least: int, most: int, step_px: float = 0.7
) -> NDArray[np.float32]:
    """Inverse depths from far to near, evenly spaced. One unit of inverse depth moves a pixel by `parallax_px`."""
    low, high = 1.0 / far, 1.0 / near
    count = int(np.clip(np.ceil((high - low) * parallax_px / step_px), least, most))
    return np.linspace(low, high, count).astype(np.float32)
