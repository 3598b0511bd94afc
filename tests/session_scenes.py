"""A room of boxes, cast into depth pictures, as the chunks of several sessions: what changes is known exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.masks import encode_mask
from list3r.memory.core.records import (
    ChunkResult,
    FrameSamples,
    Keyframe,
    LocalInstance,
    LocalLibrary,
    MaskTrack,
    Support,
)
from list3r.memory.store.store import Store
from tests.ray_boxes import through_box

SIZE = (120, 160)
FOCAL = 140.0
FRAMES = 14


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the world, metres."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    rgb: tuple[int, int, int]


ROOM: Mapping[str, Box] = {
    "table": Box((0.0, 0.0, 0.72), (1.6, 0.9, 0.04), (150, 110, 70)),
    "floor": Box((0.0, 0.0, -0.05), (8.0, 8.0, 0.1), (120, 120, 120)),
    "red": Box((-0.5, 0.15, 0.81), (0.14, 0.12, 0.14), (200, 30, 30)),
    "blue": Box((0.5, 0.2, 0.80), (0.12, 0.12, 0.12), (30, 40, 200)),
    "green": Box((0.05, -0.15, 0.82), (0.12, 0.16, 0.16), (30, 170, 40)),
    "stool": Box((0.0, 2.6, 0.2), (0.35, 0.35, 0.4), (230, 220, 60)),
}


def metric_store(path: Path) -> Store:
    """A new memory in metres, with gravity known."""
    store = Store.create(path)
    with store.transaction():
        store.facts.scale_kind = "metric"
        store.facts.gravity = "known"
    return store


def cameras(target: tuple[float, float, float], start: float, turn: float = 1.6) -> Array:
    """Poses on an arc around a point of the room, looking down at it. Shape (FRAMES, 4, 4)."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for pose, angle in zip(poses, start + np.linspace(0.0, turn, FRAMES), strict=True):
        eye = np.array(target) + np.array([1.3 * np.cos(angle), 1.3 * np.sin(angle), 1.0])
        forward = (np.array(target) - eye) / np.linalg.norm(np.array(target) - eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = eye
    return poses


def cast(room: Mapping[str, Box], T_world_cam: Array) -> tuple[Array, np.ndarray]:
    """Depth along z and the number of the box (-1 none) in each pixel. Shapes (h, w)."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.stack([(u - 79.5) / FOCAL, (v - 59.5) / FOCAL, np.ones(SIZE)], axis=-1).reshape(-1, 3)
    world = np.ascontiguousarray((rays @ T_world_cam[:3, :3].T).T)
    depth, owner = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for number, box in enumerate(room.values()):
        half = np.array(box.size) / 2
        near, far = through_box(T_world_cam[:3, 3], world, np.array(box.center) - half, np.array(box.center) + half)
        hit = (near > 0) & (near <= far) & (near < depth)
        depth[hit], owner[hit] = near[hit], number
    depth[~np.isfinite(depth)] = 0.0
    return depth.reshape(SIZE), owner.reshape(SIZE)


def add_session(store: Store, room: Mapping[str, Box], poses: Array) -> int:
    """One session of one chunk whose chunk frame is the world; its chunk's id. Call inside a transaction."""
    session = store.sessions.add("simulated", f"{len(store.sessions.all())}", {}, len(poses))
    return store.chunks.add(session, simulated_chunk(room, poses))


def simulated_chunk(room: Mapping[str, Box], poses: Array, index: int = 0) -> ChunkResult:
    """A chunk of a session that has its own frames; its frame of reference is the world."""
    pictures = [cast(room, T) for T in poses]
    start = index * len(poses)
    frames = np.arange(start, start + len(poses), dtype=np.int64)
    instances = []
    for number, (name, box) in enumerate(room.items()):
        if name != "floor":
            found = _instance(len(instances), number, box, pictures, poses, start)
            if found is not None:
                instances.append(found)
    keyframes = [
        Keyframe(
            start + int(k),
            poses[k],
            np.ones(4, np.float32) / 2,
            np.zeros((0, 2), np.float32),
            np.zeros((0, 32), np.uint8),
            np.zeros((0, 3), np.float32),
            pictures[k][0].astype(np.float32),
            (FOCAL, FOCAL, 79.5, 59.5),
        )
        for k in range(0, len(poses), 3)
    ]
    return ChunkResult(
        index=index,
        frame_indices=frames,
        times_s=frames / 10.0,
        posed=np.ones(len(poses), bool),
        T_chunk_cam=poses,
        T_source_cam=None,
        intrinsics=(FOCAL, FOCAL, 79.5, 59.5),
        image_size=SIZE,
        scale_kind="metric",
        keyframes=tuple(keyframes),
        samples=FrameSamples.empty(),
        library=LocalLibrary(tuple(instances), np.zeros((0, 2), np.int32), "test@1/4"),
    )


def _instance(
    local_id: int, number: int, box: Box, pictures: list[tuple[Array, np.ndarray]], poses: Array, start: int
) -> LocalInstance | None:
    masks = [(k, owner == number) for k, (_, owner) in enumerate(pictures) if (owner == number).sum() >= 30]
    if not masks:
        return None
    points = []
    boxes = []
    for k, mask in masks:
        v, u = np.nonzero(mask)
        z = pictures[k][0][mask]
        cam = np.stack([(u - 79.5) / FOCAL * z, (v - 59.5) / FOCAL * z, z], axis=1)
        points.append(cam @ poses[k][:3, :3].T + poses[k][:3, 3])
        boxes.append([u.min(), v.min(), u.max() + 1, v.max() + 1])
    support = np.concatenate(points)[::7].astype(np.float32)
    color = np.array([*box.rgb, 60.0])
    track = MaskTrack(
        np.array([start + k for k, _ in masks], np.int64),
        np.array(boxes, np.float32),
        np.array(boxes, np.float32)[:, :2],
        np.array([m.sum() for _, m in masks], np.int32),
        np.ones(len(masks), np.float32),
        tuple(encode_mask(m) for _, m in masks),
        SIZE,
    )
    return LocalInstance(
        local_id,
        track,
        (color / np.linalg.norm(color)).astype(np.float32),
        Support(support, np.ones(len(support), np.float32), np.tile(np.array(box.rgb, np.uint8), (len(support), 1))),
        1.0,
    )


def place_together(store: Store) -> None:
    """All chunks where they are, in one component, z up."""
    ids = [c.chunk_id for c in store.chunks.all()]
    store.chunks.place({k: Sim3.identity() for k in ids}, dict.fromkeys(ids, ids[0]))
    store.facts.gravity = "known"
