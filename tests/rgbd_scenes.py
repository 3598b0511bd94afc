"""A small room of textured boxes, ray-cast, with sensor noise: frames whose poses and depths are known."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from list3r.frames.base import Camera, Frame
from list3r.memory.geometry import rotation_exp
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
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], axis=-1)
    directions = rays @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    depth, axis, which = _far_side(origin, directions)
    for k, box in enumerate(boxes):
        z, a = _near_side(origin, directions, box)
        closer = z < depth
        depth, axis, which = np.where(closer, z, depth), np.where(closer, a, axis), np.where(closer, k + 1, which)
    points = origin + depth[..., None] * directions
    color = _shade(points, axis, which, contrast, seed)
    rng = np.random.default_rng((seed, index))
    if noise:
        depth = depth + rng.normal(size=depth.shape) * SensorNoise().sigma(depth.astype(np.float32))
        color = np.clip(color + rng.normal(0, 2, color.shape), 0, 255)
    return Frame(
        index, index / 30 if time_s is None else time_s, color.astype(np.uint8), depth.astype(np.float32), T_world_cam
    )


def _far_side(origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    low, high = np.array(ROOM)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.where(directions > 0, (high - origin) / directions, (low - origin) / directions)
    away[np.isnan(away)] = np.inf
    return away.min(axis=-1), away.argmin(axis=-1), np.zeros(away.shape[:2], int)


def _near_side(origin: np.ndarray, directions: np.ndarray, box: tuple) -> tuple[np.ndarray, np.ndarray]:
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (np.array(box[0]) - origin) / directions, (np.array(box[1]) - origin) / directions
    near, far = np.minimum(a, b), np.maximum(a, b)
    enter, leave = near.max(axis=-1), far.min(axis=-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf), near.argmax(axis=-1)


def _shade(points: np.ndarray, axis: np.ndarray, which: np.ndarray, contrast: float, seed: int) -> np.ndarray:
    """Texture by the two coordinates along the face, shifted for each thing."""
    first = np.where(axis == 0, points[..., 1], points[..., 0])
    second = np.where(axis == 2, points[..., 1], points[..., 2])
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


def black(frame: Frame) -> Frame:
    """The frame with the lens covered."""
    assert frame.depth is not None
    return replace(frame, color=frame.color * 0, depth=frame.depth * 0)


def pose_errors(T_chunk_cam: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (metres) and angles (degrees) from the truth, both taken relative to the first frame."""
    moved = np.linalg.inv(np.linalg.inv(truth[0]) @ truth) @ (np.linalg.inv(T_chunk_cam[0]) @ T_chunk_cam)
    trace = np.trace(moved[:, :3, :3], axis1=1, axis2=2)
    return np.linalg.norm(moved[:, :3, 3], axis=1), np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
