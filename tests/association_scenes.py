"""Two chunks of one simulated walk past a wall, a floor and things, with exact truth: for tests of edges and motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.masks import encode_mask
from list3r.memory.core.records import FrameSamples, LocalInstance, LocalLibrary, MaskTrack, Support

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
WALL, FLOOR, BOX, MOVER = 0, 1, 2, 3
FRAMES = 24
STEP = 8


@dataclass(frozen=True)
class Thing:
    """An upright rectangle that faces the camera."""

    label: int
    center: tuple[float, float, float]
    half: tuple[float, float]
    speed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres per frame."""


BOXES = (Thing(BOX, (-0.9, 0.5, 2.6), (0.3, 0.4)), Thing(4, (1.0, 0.6, 2.8), (0.25, 0.3)))


def walk(frames: int = FRAMES) -> np.ndarray:
    """A camera that steps aside and turns. Shape (F, 4, 4), x right, y down, z forward."""
    return np.stack([Sim3.exp([0.02 * k, 0, 0.01 * k, 0, 0.008 * k, 0, 0]).as_matrix() for k in range(frames)])


def cast(T_world_cam: np.ndarray, things: tuple[Thing, ...], time: float) -> tuple[np.ndarray, ...]:
    """Depth, instance and pixel of every grid pixel: a wall at z = 4, a floor at y = 1.2, and the things."""
    rows, columns = (n.ravel() for n in np.mgrid[STEP // 2 : 120 : STEP, STEP // 2 : 160 : STEP])
    rays = np.column_stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(len(rows))])
    turned, origin = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    depth, label = (4.0 - origin[2]) / turned[:, 2], np.full(len(rows), WALL)
    floor = (1.2 - origin[1]) / np.where(turned[:, 1] > 1e-6, turned[:, 1], 1e-6)
    label, depth = np.where(floor < depth, FLOOR, label), np.minimum(depth, floor)
    for thing in things:
        center = np.array(thing.center) + time * np.array(thing.speed)
        at = (center[2] - origin[2]) / turned[:, 2]
        hit = np.abs(origin + at[:, None] * turned - center)
        hits = (hit[:, 0] < thing.half[0]) & (hit[:, 1] < thing.half[1]) & (at > 0) & (at < depth)
        label, depth = np.where(hits, thing.label, label), np.where(hits, at, depth)
    return depth, label, rows * CAMERA.width + columns, rays


def film(
    things: tuple[Thing, ...] = BOXES,
    S_chunk_world: Sim3 | None = None,
    *,
    noise: float = 0.0,
    seed: int = 0,
    mover_depth: float = 1.0,
    first: int = 0,
    frames: int = FRAMES,
) -> FrameSamples:
    """What a chunk makes of frames `first` to `first + frames`: its own gauge, noise, and its own depth of movers."""
    S = S_chunk_world or Sim3.identity()
    rng = np.random.default_rng(seed)
    parts, poses = [], []
    for k, T in enumerate(walk(first + frames)[first:]):
        depth, label, pixel, rays = cast(T, things, first + k)
        wrong = depth * (1 + noise * rng.normal(size=len(depth))) * np.where(label == MOVER, mover_depth, 1.0)
        points = S.apply((wrong[:, None] * rays) @ T[:3, :3].T + T[:3, 3])
        parts.append((np.full(len(pixel), first + k), pixel, points, label))
        poses.append((S @ Sim3.from_matrix(T)).as_matrix())
        poses[-1][:3, :3] /= float(S.scale)
    frame, pixel, points, label = (np.concatenate(column) for column in zip(*parts, strict=True))
    return FrameSamples(
        frame=frame.astype(np.int64),
        pixel=pixel.astype(np.int32),
        points=points.astype(np.float32),
        confidence=np.full(len(frame), 0.8, np.float32),
        instance=label.astype(np.int32),
        camera_frames=np.arange(first, first + frames),
        T_chunk_cam=np.stack(poses),
    )


def library_of(samples: FrameSamples) -> LocalLibrary:
    """One instance for each label, visible where its samples are."""
    instances = []
    for label in [int(k) for k in np.unique(samples.instance) if k >= 0]:
        mine = samples.instance == label
        frames, count = np.unique(samples.frame[mine], return_counts=True)
        track = MaskTrack(
            frames=frames,
            boxes_xyxy=np.zeros((len(frames), 4), np.float32),
            centers_xy=np.zeros((len(frames), 2), np.float32),
            areas_px=(count * STEP * STEP).astype(np.int32),
            visible_fraction=np.ones(len(frames), np.float32),
            masks=tuple(encode_mask(np.zeros((120, 160), bool)) for _ in frames),
            image_size=(120, 160),
        )
        points = samples.points[mine][::10]
        support = Support(points, np.ones(len(points), np.float32), np.zeros((len(points), 3), np.uint8))
        feature = np.ones(4, np.float32) / 2
        instances.append(LocalInstance(label, track, feature, support, 1.0, structure=label in (WALL, FLOOR)))
    return LocalLibrary(tuple(instances), np.zeros((0, 2), np.int32), "test@1/4")
