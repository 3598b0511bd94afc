"""Poses of a chunk: given ones of the source, and the choice of keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.memory.core.errors import TrackingError
from list3r.reconstruction.base import KeyframeSpacing

Poses = NDArray[np.float64]


def is_rigid(T: Poses) -> bool:
    """Return whether a 4x4 matrix is a finite rigid transform, to the precision of text files."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < 1e-2 and np.linalg.det(R) > 0)


def given_poses(frames: Sequence[Frame]) -> tuple[Poses, NDArray[np.bool_]]:
    """Return T_source_cam (F, 4, 4) and which frames have a valid one (F,). Raises `TrackingError` when none has."""
    T, posed = np.tile(np.eye(4), (len(frames), 1, 1)), np.zeros(len(frames), bool)
    for position, frame in enumerate(frames):
        if frame.T_source_cam is not None and is_rigid(frame.T_source_cam):
            T[position], posed[position] = frame.T_source_cam, True
    if not posed.any():
        raise TrackingError(
            f"none of the frames {frames[0].index} to {frames[-1].index} has a valid pose; use --poses estimate"
        )
    return T, posed


def small_motion(step: NDArray[np.float64]) -> Poses:
    """Return a rigid motion of a translation and a rotation vector, radians. Shape (6,) -> (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(step[3:])[0]
    T[:3, 3] = step[:3]
    return T


def angle_deg(T: Poses) -> float:
    """Return the rotation angle of a rigid transform, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))))


def shows_more(T_last_new: Poses, depth: float, spacing: KeyframeSpacing) -> bool:
    """Return whether a camera has moved enough since the last keyframe, at a typical depth."""
    return angle_deg(T_last_new) > spacing.turn_deg or bool(np.linalg.norm(T_last_new[:3, 3]) / depth > spacing.shift)


def select_keyframes(
    T_chunk_cam: Poses,
    posed: NDArray[np.bool_],
    depths: Sequence[NDArray[np.float32] | None],
    spacing: KeyframeSpacing,
) -> list[int]:
    """Return positions of frames that have moved enough since the last keyframe."""
    keyframes: list[int] = []
    for position in map(int, np.flatnonzero(posed)):
        depth = depths[position]
        known = depth[::8, ::8][depth[::8, ::8] > 0] if depth is not None else np.zeros(0)
        if not len(known):
            continue
        if keyframes:
            step = np.linalg.inv(T_chunk_cam[keyframes[-1]]) @ T_chunk_cam[position]
            if not shows_more(step, float(np.median(known)), spacing):
                continue
        keyframes.append(position)
    return keyframes or [int(np.flatnonzero(posed)[0])]
