"""The instances of one chunk as a constellation: appearance and shape of each, and its position with up known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.cross_check import Side
from list3r.memory.core.geometry import upright_box
from list3r.memory.core.records import FrameSamples
from list3r.memory.store.tables.local_instances import LocalNode

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ConstellationSettings:
    """Which instances of a chunk form its constellation."""

    most_instances: int = 60
    """Most instances, those seen in most frames."""
    trim: float = 0.04
    """Share of the support points left outside at either end of each axis of a box."""
    least_points: int = 8
    """Fewer support points give no box."""
    most_size: float = 1.1
    """Instances longer than this share of the chunk's typical depth are no landmarks."""
    level_deg: float = 20.0
    """A structure plane within this of level or of upright, as the cameras are held, determines the vertical."""


@dataclass(frozen=True)
class Constellation:
    """N instances of one chunk in its upright frame: z up, origin and units of the chunk."""

    local_id: Ints
    """Shape (N,)."""
    feature: Array
    """Unit length. Shape (N, D)."""
    center: Array
    """Centre of the upright box. Shape (N, 3)."""
    size: Array
    """Longer and shorter side of the footprint, and height. Shape (N, 3)."""
    color: Array
    """Share of red and of green in the mean colour, nearly independent of brightness. Shape (N, 2)."""
    R_up_chunk: Array
    """Shape (3, 3)."""
    unit: float
    """Typical depth of the chunk's points."""
    space: str
    """Embedding space of the features."""


def make_constellation(
    nodes: Sequence[LocalNode], side: Side, space: str, settings: ConstellationSettings | None = None
) -> Constellation:
    """Return the constellation of a chunk from its local instances and its samples."""
    s = settings or ConstellationSettings()
    unit = typical_depth(side.samples)
    R = upright(nodes, side.samples.T_chunk_cam, s)
    usable = [n for n in nodes if not n.structure and not n.dynamic and len(n.support.points) >= s.least_points]
    usable = [n for n in usable if np.isfinite(n.support.points).all() and np.isfinite(n.feature).all()]
    kept, boxes = [], []
    for node in sorted(usable, key=lambda n: (-len(n.frames), n.local_id))[: s.most_instances]:
        box = upright_box(node.support.points.astype(np.float64) @ R.T, s.trim)
        if 0 < box.size.max() <= s.most_size * unit:
            kept.append(node)
            boxes.append(box)
    length = len(kept[0].feature) if kept else 0
    feature = np.array([n.feature for n in kept], np.float64).reshape(len(kept), length)
    rgb = np.array([n.support.rgb.astype(np.float64).mean(axis=0) for n in kept]).reshape(-1, 3) + 1.0
    return Constellation(
        local_id=np.array([n.local_id for n in kept], np.int64),
        feature=feature / np.maximum(np.linalg.norm(feature, axis=1, keepdims=True), 1e-12),
        center=np.array([b.center for b in boxes]).reshape(-1, 3),
        size=np.maximum(np.array([b.size for b in boxes]).reshape(-1, 3), 1e-3 * unit),
        color=(rgb / rgb.sum(axis=1, keepdims=True))[:, :2],
        R_up_chunk=R,
        unit=unit,
        space=space,
    )


def upright(nodes: Sequence[LocalNode], T_chunk_cam: Array, settings: ConstellationSettings) -> Array:
    """Return R_up_chunk: the rotation that makes a chunk upright, from its cameras' x axes and its structure planes.

    People hold a camera level, so its x axis is level; floors are level and walls upright.
    """
    if not len(T_chunk_cam):
        return np.eye(3)
    up = -T_chunk_cam[:, :3, 1].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    across = T_chunk_cam[:, :3, 0]
    normals = np.array([n.plane[:3] for n in nodes if n.structure and n.plane is not None]).reshape(-1, 3)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    limit = np.sin(np.radians(settings.level_deg))
    for width in (limit, limit, limit / 2):
        along = np.abs(normals @ up)
        level, wall = normals[along > np.sqrt(1 - width**2)], normals[along < width]
        scatter = level.T @ level - wall.T @ wall - 3.0 * across.T @ across / len(across)
        found = np.linalg.eigh(scatter)[1][:, -1]
        up = found if found @ up > 0 else -found
    x = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def typical_depth(s: FrameSamples) -> float:
    """Return the median distance of samples from the cameras that saw them, 1 where there are none."""
    good = np.flatnonzero((s.confidence > 0) & np.isfinite(s.points).all(axis=1))[::7]
    if not len(good):
        return 1.0
    row = np.clip(np.searchsorted(s.camera_frames, s.frame[good]), 0, len(s.camera_frames) - 1)
    return float(np.median(np.linalg.norm(s.points[good] - s.T_chunk_cam[row, :3, 3], axis=1)))
