"""A small room of textured boxes, ray-cast, with sensor noise: frames whose poses and depths are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from list3r.frames.base import Camera, Frame
from list3r.memory.core.geometry import rotation_exp
from list3r.reconstruction.base import SensorNoise

CAMERA = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)

ROOM = ((-2.0, -1.4, -1.0), (2.0, 1.0, 3.2))
"""Lower and upper corner, world, metres; y points down."""
BOXES = (
    ((-1.2, 0.2, 1.6), (0.3, 1.0, 2.4)),
    ((-0.9, -0.1, 1.8), (-0.5, 0.2, 2.1)),
    ((-0.2, 0.0, 1.7), (0.1, 0.2, 1.95)),
    ((0.9, -0.6, 2.2), (1.5, 1.0, 2.8)),
    ((-2.0, -0.8, 2.4), (-1.4, 1.0, 3.2)),
)


@lru_cache(maxsize=4)
def _texture(seed: int, contrast: float) -> np.ndarray:
    """A tile of 3 x 3 m at 5 mm with detail at several sizes. Shape (600, 600, 3)."""
    rng = np.random.default_rng(seed)
    out = np.full((600, 600, 3), 128.0, np.float32)
    for size, strength in ((6, 40.0), (25, 35.0), (100, 30.0)):
        noise = rng.normal(0.0, strength * contrast, (size, size, 1)) + rng.normal(0, 10 * contrast, (size, size, 3))
        out += cv2.resize(noise.astype(np.float32), (600, 600), interpolation=cv2.INTER_CUBIC)
    return np.clip(out, 5, 250)


def render(
    T_world_cam: np.ndarray,
    seed: int = 0,
    contrast: float = 1.0,
    boxes: tuple = BOXES,
    noise: bool = True,
    index: int = 0,
    time_s: float | None = None,
) -> Frame:
    """The frame that a camera at `T_world_cam` takes."""
    directions = [_rays() @ row for row in T_world_cam[:3, :3]]
    origin = T_world_cam[:3, 3]
    depth, axis = _far_side(origin, directions)
    which = np.zeros(depth.shape, int)
    for k, box in enumerate(boxes):
        z, a = _near_side(origin, directions, box)
        closer = z < depth
        depth[closer], axis[closer], which[closer] = z[closer], a[closer], k + 1
    color = _shade([o + depth * d for o, d in zip(origin, directions, strict=True)], axis, which, contrast, seed)
    rng = np.random.default_rng((seed, index))
    if noise:
        depth = depth + rng.normal(size=depth.shape) * SensorNoise().sigma(depth.astype(np.float32))
        color = np.clip(color + rng.normal(0, 2, color.shape), 0, 255)
    return Frame(
        index, index / 30 if time_s is None else time_s, color.astype(np.uint8), depth.astype(np.float32), T_world_cam
    )


@lru_cache(maxsize=1)
def _rays() -> np.ndarray:
    """Of every pixel, in the camera. Shape (h, w, 3)."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    return np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], axis=-1)


def _far_side(origin: np.ndarray, directions: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the room's walls and the axis that they are across."""
    away = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for low, high, o, d in zip(*ROOM, origin, directions, strict=True):
            away.append(np.where(d > 0, high - o, low - o) / d)
    x, y, z = (np.where(np.isnan(a), np.inf, a) for a in away)
    return np.minimum(np.minimum(x, y), z), np.where(np.minimum(x, y) <= z, y < x, 2)


def _near_side(origin: np.ndarray, directions: list[np.ndarray], box: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a box, infinite beside it, and the axis that the face is across."""
    near, far = [], []
    with np.errstate(divide="ignore", invalid="ignore"):
        for low, high, o, d in zip(*box, origin, directions, strict=True):
            a, b = (low - o) / d, (high - o) / d
            near.append(np.minimum(a, b))
            far.append(np.maximum(a, b))
    x, y, z = near
    enter, leave = np.maximum(np.maximum(x, y), z), np.minimum(np.minimum(far[0], far[1]), far[2])
    axis = np.where(np.maximum(x, y) >= z, y > x, 2)
    return np.where((enter < leave) & (enter > 0), enter, np.inf), axis


def _shade(points: list[np.ndarray], axis: np.ndarray, which: np.ndarray, contrast: float, seed: int) -> np.ndarray:
    """Texture by the two coordinates along the face, shifted for each thing."""
    first = np.where(axis == 0, points[1], points[0])
    second = np.where(axis == 2, points[1], points[2])
    x = ((first + 0.37 * which + 0.71 * axis) * 200 % 600).astype(np.float32)
    y = ((second + 0.53 * which + 0.29 * axis) * 200 % 600).astype(np.float32)
    tile = cv2.remap(_texture(seed, contrast), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return tile * np.array([1.0, 0.8, 0.9])[axis][..., None]


def walk(count: int, speed: float = 1.0, start: float = 0.0) -> np.ndarray:
    """Poses of a hand-held camera, `speed` times 12 mm and half a degree a frame. Shape (count, 4, 4)."""
    s = start + speed * np.arange(count) / 30.0
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = np.stack([0.4 * np.sin(0.8 * s), 0.08 * np.sin(1.7 * s), 0.12 * np.sin(0.9 * s)], axis=1)
    turn = np.stack([0.08 * np.sin(1.3 * s), -0.25 * np.sin(0.8 * s), 0.04 * np.sin(1.1 * s)], axis=1)
    T[:, :3, :3] = rotation_exp(turn)
    return T


def frames_along(poses: np.ndarray, step_s: float = 1 / 30, **more: object) -> list[Frame]:
    """Frames at poses, one each `step_s` seconds."""
    return [render(T, index=k, time_s=k * step_s, **more) for k, T in enumerate(poses)]  # type: ignore[arg-type]


def along_a_striped_wall(
    x_m: Sequence[float], contrast: float, period_m: float, dark: float, gains: Sequence[float] | None = None
) -> tuple[list[Frame], np.ndarray]:
    """Frames at places along a wall with stripes, nine a second, of which each has a gain of its own, and poses."""
    poses = np.tile(np.eye(4), (len(x_m), 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = x_m, 1.8
    out = []
    for k, frame in enumerate(frames_along(poses, step_s=1 / 9, contrast=contrast, boxes=())):
        assert frame.depth is not None
        across = x_m[k] + frame.depth * _rays()[..., 0] - ROOM[0][0]
        stripe = np.where(across % period_m < 0.5 * period_m, 1.0, dark) * (1.0 if gains is None else gains[k])
        out.append(replace(frame, color=np.clip(frame.color * stripe[..., None], 0, 255).astype(np.uint8)))
    return out, poses


def black(frame: Frame) -> Frame:
    """The frame with the lens covered."""
    assert frame.depth is not None
    return replace(frame, color=frame.color * 0, depth=frame.depth * 0)


def pose_errors(T_chunk_cam: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (metres) and angles (degrees) from the truth, both taken relative to the first frame."""
    moved = np.linalg.inv(np.linalg.inv(truth[0]) @ truth) @ (np.linalg.inv(T_chunk_cam[0]) @ T_chunk_cam)
    trace = np.trace(moved[:, :3, :3], axis1=1, axis2=2)
    return np.linalg.norm(moved[:, :3, 3], axis=1), np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
