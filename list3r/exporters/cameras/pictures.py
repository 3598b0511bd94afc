"""Posed pictures, their cameras and coloured points, the input of reconstruction programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.components import Component, thinned_support
from list3r.memory.core.records import ChunkRow
from list3r.memory.store.store import Store

_JPEG_SIZES = range(0xC0, 0xD0)
_NO_SIZE = (0xC4, 0xC8, 0xCC)
"""Markers among them that are no start of a frame."""


@dataclass(frozen=True)
class PosedPicture:
    """A frame with its camera."""

    name: str
    """Of the file in `images/`."""
    image_size: tuple[int, int]
    """(height, width), px."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy, px; pixel centres at whole numbers."""
    T_world_cam: NDArray[np.float64]
    """OpenCV axes. Shape (4, 4)."""


def write_pictures(store: Store, component: Component, folder: Path) -> list[PosedPicture]:
    """Write the stored pictures of posed keyframes to a folder; return them with their cameras.

    Where none is stored, all posed frames are returned and the user supplies pictures under their names.
    """
    poses = {(f.session_id, f.frame_index): S for f, S in component.poses}
    found = {}
    for chunk in component.chunks:
        for keyframe in store.keyframes.of(chunk.chunk_id):
            key = chunk.session_id, keyframe.frame_index
            if keyframe.jpeg and key in poses and key not in found:
                found[key] = _posed(key, chunk, poses[key].rotation, poses[key].translation, jpeg_size(keyframe.jpeg))
                (folder / found[key].name).write_bytes(keyframe.jpeg)
    if not found:
        chunks = {c.chunk_id: c for c in component.chunks}
        for f, S in component.poses:
            key = f.session_id, f.frame_index
            found[key] = _posed(key, chunks[f.chunk_id], S.rotation, S.translation, None)
    return [found[key] for key in sorted(found)]


def _posed(
    key: tuple[int, int],
    chunk: ChunkRow,
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    size: tuple[int, int] | None,
) -> PosedPicture:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    height, width = size or chunk.image_size
    sy, sx = height / chunk.image_size[0], width / chunk.image_size[1]
    fx, fy, cx, cy = chunk.intrinsics
    intrinsics = fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5
    return PosedPicture(f"session{key[0]}_frame{key[1]:06d}.jpg", (int(height), int(width)), intrinsics, T)


def jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Return (height, width) from the header of a JPEG, None for another file."""
    at = 2
    while content[:2] == b"\xff\xd8" and at + 9 < len(content):
        if content[at] != 0xFF:
            return None
        marker, length = content[at + 1], int.from_bytes(content[at + 2 : at + 4], "big")
        if marker in _JPEG_SIZES and marker not in _NO_SIZE:
            return int.from_bytes(content[at + 5 : at + 7], "big"), int.from_bytes(content[at + 7 : at + 9], "big")
        at += 2 + length
    return None


def colored_points(
    store: Store, component: Component, per_instance: int = 2000
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return surface points of all instances, at most this many of each, and their colours. Shapes (N, 3), (N, 3)."""
    supports = [thinned_support(store, i, per_instance) for i in component.instances]
    points = np.concatenate([*(s.points for s in supports), np.zeros((0, 3))])
    return points, np.concatenate([*(s.rgb for s in supports), np.zeros((0, 3), np.uint8)]).astype(np.uint8)
