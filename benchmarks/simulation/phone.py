"""A simulated walk as a phone with LiDAR records it: sparse depth of 256 x 192 drawn over edges, poses that drift.

The numbers of the sensor are our own model of published facts: 576 spots that are drawn to 256 x 192 along the picture,
an error of centimetres that neighbouring pixels share, and confidence that is lost next to edges.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.blind import DARK, TURN, WALKED, BlindWalk, exposed
from list3r.evaluation.trajectory import Trajectory, write_tum
from list3r.frames.base import Camera, Frame
from list3r.frames.writers.record3d import Record3dWriter
from list3r.memory.core.geometry import rotation_exp
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import RenderedFrame, Renderer
from list3r.simulation.rendering.sensor import sense

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
DEPTH_SIZE = (256, 192)


@dataclass(frozen=True)
class LidarSettings:
    """Noise of a phone's depth."""

    sigma_m: float = 0.004
    """Deviation at zero distance, metres."""
    sigma_per_m: float = 0.004
    """Growth of the deviation with depth."""
    patch_px: float = 8.0
    """Width over which errors are alike: spots are 10 px apart."""
    blur_px: float = 1.5
    """Width over which edges are drawn out."""
    edge_step: float = 0.04
    """Jump of depth, as a share of it, that counts as an edge."""
    range_m: tuple[float, float] = (0.25, 5.0)
    sure_cosine: float = 0.3
    """Cosine of incidence under which depth is not sure; under a third of it the sensor is not sure at all."""
    unsure_times: float = 1.0
    """So many times larger is the error where depth is not sure."""


@dataclass(frozen=True)
class DriftSettings:
    """How far given poses are from the truth."""

    share: float = 0.01
    """Error of every length."""
    yaw_deg: float = 1.0
    """Drift of heading at the end; gravity keeps pitch and roll."""
    tilt_deg: float = 0.15
    """Deviation of pitch and roll, which come and go."""
    jump_m: float = 0.12
    """Jump of the pose, as after a relocalisation."""
    jump_deg: float = 3.0
    """And turns by, about the vertical."""
    jump_at: float = 0.55
    """Share of the walk after which it does."""


def drifted(T_world_cam: Array, settings: DriftSettings, seed: int) -> Array:
    """Return the poses with drift and a jump, the first one true. Shape (F, 4, 4)."""
    rng = np.random.default_rng([seed, 17])
    count, steps = len(T_world_cam), np.diff(T_world_cam[:, :3, 3], axis=0)
    walk = np.cumsum(rng.standard_normal(count))
    net = max(abs(walk[-1] - walk[0]), 3.0)  # of a heading that ends where it began any drift would be blown up
    yaw = np.radians(settings.yaw_deg) * (walk - walk[0]) / net
    tilt = np.radians(settings.tilt_deg) * np.stack([_slow(rng, count), _slow(rng, count), np.zeros(count)], axis=1)
    tilt -= tilt[0]
    stretched = (1.0 + settings.share * rng.choice([-1.0, 1.0])) * steps
    turned = np.stack(
        [rotation_exp(np.array([0.0, 0.0, a])) @ step for a, step in zip(yaw[1:], stretched, strict=True)]
    )
    out = T_world_cam.copy()
    out[1:, :3, 3] = T_world_cam[0, :3, 3] + np.cumsum(turned, axis=0)
    for k in range(count):
        out[k, :3, :3] = rotation_exp(np.array([0.0, 0.0, yaw[k]])) @ rotation_exp(tilt[k]) @ T_world_cam[k, :3, :3]
    return _jumped(out, settings, rng)


def _jumped(T_world_cam: Array, settings: DriftSettings, rng: np.random.Generator) -> Array:
    """Return the poses with all that come after some moment moved and turned about the camera of that moment."""
    at = round(settings.jump_at * len(T_world_cam))
    angle = np.radians(settings.jump_deg) * rng.choice([-1.0, 1.0])
    way = rng.uniform(0, 2 * np.pi)
    J, pivot = np.eye(4), T_world_cam[at, :3, 3]
    J[:3, :3] = rotation_exp(np.array([0.0, 0.0, angle]))
    J[:3, 3] = pivot - J[:3, :3] @ pivot + settings.jump_m * np.array([np.cos(way), np.sin(way), 0.0])
    out = T_world_cam.copy()
    out[at:] = J @ T_world_cam[at:]
    return out


def _slow(rng: np.random.Generator, count: int) -> Array:
    """Noise of unit deviation that stays alike for a second. Shape (count,)."""
    width = 12
    return np.asarray(np.convolve(rng.standard_normal(count + width - 1), np.ones(width) / np.sqrt(width), "valid"))


def lidar_depth(
    frame: RenderedFrame, settings: LidarSettings, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return depth as a phone states it, metres, 0 where unknown, and its confidence (0, 1, 2). Shapes (h, w)."""
    true = np.where(frame.depth > 0, frame.depth, settings.range_m[1] + 1).astype(np.float32)
    drawn = cv2.GaussianBlur(true, (0, 0), settings.blur_px)
    patch = cv2.GaussianBlur(rng.standard_normal(true.shape, dtype=np.float32), (0, 0), settings.patch_px)
    window = np.ones((5, 5), np.uint8)
    edge = cv2.dilate(true, window) - cv2.erode(true, window) > settings.edge_step * true + 5 * _slope(true)
    confidence = np.full(true.shape, 2, np.uint8)
    confidence[edge | (frame.incidence < settings.sure_cosine)] = 1
    confidence[frame.incidence < settings.sure_cosine / 3] = 0
    sigma = (settings.sigma_m + settings.sigma_per_m * drawn) * np.where(confidence < 2, settings.unsure_times, 1.0)
    depth = (drawn + sigma * patch / patch.std()).astype(np.float32)
    known = (depth > settings.range_m[0]) & (depth < settings.range_m[1]) & (frame.depth > 0)
    confidence[~known] = 0
    return np.where(known, depth, 0).astype(np.float32), confidence


def _slope(depth: Floats) -> Floats:
    """Return the median step of depth from a pixel to its neighbours around it. Shape (h, w)."""
    across = np.abs(np.diff(depth, axis=1, append=depth[:, -1:]))
    down = np.abs(np.diff(depth, axis=0, append=depth[-1:]))
    return np.asarray(cv2.medianBlur(np.maximum(across, down).astype(np.float32), 5), np.float32)


def write_phone_walk(
    folder: Path,
    walk: WalkSettings,
    lidar: LidarSettings | None = None,
    drift: DriftSettings | None = None,
    way: BlindWalk | None = None,
) -> Path:
    """Film a walk into `folder`: `walk.r3d`, and next to it `groundtruth.txt` and `truth.json`.

    `way` is the walk with stretches where the camera cannot be followed; `stretches.json` has the name of each frame's.
    """
    lidar, drift = lidar or LidarSettings(), drift or DriftSettings()
    folder.mkdir(parents=True, exist_ok=True)
    camera = walk.camera()
    small = Camera(*DEPTH_SIZE, *_shrunk(camera))
    if way is None:
        times, poses = walk.poses()
        way = BlindWalk(times, poses, (WALKED,) * len(times))
    given = drifted(way.T_world_cam, drift, walk.seed)
    pictures, depths = Renderer(walk.world(), camera), Renderer(walk.world(), small)
    seen: dict[int, dict[str, int]] = {}
    out = Record3dWriter(folder, camera, walk.path.fps)
    for k, (T_world_cam, stretch) in enumerate(zip(way.T_world_cam, way.stretch, strict=True)):
        drawn, time_s = pictures.render(T_world_cam), float(way.time_s[k])
        if stretch == TURN:
            during = exposed(way.T_world_cam, k, walk.path.fps, way.exposure_s)
            drawn = replace(drawn, color=np.mean([pictures.render(T).color for T in during], axis=0, dtype=np.float32))
        elif stretch == DARK:
            drawn = replace(drawn, color=np.zeros_like(drawn.color), ids=np.zeros_like(drawn.ids))
        color = sense(drawn, walk.sensor, walk.seed, k, time_s).color
        depth, sure = lidar_depth(depths.render(T_world_cam), lidar, np.random.default_rng([walk.seed, 18, k]))
        if stretch == DARK:
            depth, sure = np.zeros_like(depth), np.zeros_like(sure)
        out.add(Frame(k, time_s, color, depth, given[k]), sure)
        for obj, area in zip(*np.unique(drawn.ids[drawn.ids > 0], return_counts=True), strict=True):
            entry = seen.setdefault(int(obj), {"frames": 0, "largest_px": 0})
            entry["frames"], entry["largest_px"] = entry["frames"] + 1, max(entry["largest_px"], int(area))
    out.close()
    write_tum(folder / "groundtruth.txt", Trajectory(way.time_s, way.T_world_cam))
    (folder / "stretches.json").write_text(json.dumps(way.stretch), encoding="utf-8")
    (folder / "truth.json").write_text(json.dumps(walk.truth(seen)), encoding="utf-8")
    return folder / "walk.r3d"


def _shrunk(camera: Camera) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of the pictures' camera at the size of depth."""
    c = camera.resized(DEPTH_SIZE[1], DEPTH_SIZE[0])
    return c.fx, c.fy, c.cx, c.cy
