"""Poses that are given but imperfect: their jumps, and the transform from a chunk to their world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import rotation_exp, rotation_log
from list3r.reconstruction.poses import angle_deg, is_rigid

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class PriorSettings:
    """Uncertainty of given poses from one frame to the next."""

    shift_m: float = 0.002
    """Standard deviation of a step, metres; the jitter of visual-inertial odometry."""
    shift_share: float = 0.02
    """Standard deviation of a step by its length: twice the drift that ARKit is known for."""
    turn_deg: float = 0.1
    """Standard deviation of the rotation of a step."""
    correlated: float = 30.0
    """Number of a picture's pairs that count as one: errors of neighbours are correlated."""
    jump_m: float = 0.04
    """Difference between a pose's step and the step that depth shows beyond which it is a jump,"""
    jump_deg: float = 1.5
    """or the same of the rotation."""
    jump_inliers: float = 0.9
    """A frame that contradicts its step by that much is accepted with this share of the usual inliers,"""
    jump_correlation: float = 0.8
    """and this correlation of brightness: true jumps have 0.98, blurred pictures of a bare floor 0.5 to 0.7."""


def given_step(before: Poses | None, after: Poses | None) -> Poses | None:
    """Return the motion T_before_after between two given poses (4, 4); None where one is missing or no rigid motion."""
    if before is None or after is None or not (is_rigid(before) and is_rigid(after)):
        return None
    return np.asarray(np.linalg.inv(before) @ after)


def steady_runs(T_chunk_cam: Poses, T_source_cam: Poses, settings: PriorSettings) -> list[NDArray[np.int64]]:
    """Return runs of frames within which the given poses do not jump against those of the chunk.

    Both have shape (F, 4, 4); frames where one is NaN belong to no run.
    """
    known = np.flatnonzero(np.isfinite(T_chunk_cam).all(axis=(1, 2)) & np.isfinite(T_source_cam).all(axis=(1, 2)))
    if not len(known):
        return []
    T_source_chunk = T_source_cam[known] @ np.linalg.inv(T_chunk_cam[known])
    breaks = []
    for k in range(1, len(known)):
        here = T_source_chunk[k] @ T_chunk_cam[known[k]]
        held = T_source_chunk[k - 1] @ T_chunk_cam[known[k]]
        apart = np.linalg.norm(here[:3, 3] - held[:3, 3])
        if apart > settings.jump_m or angle_deg(np.linalg.inv(held) @ here) > settings.jump_deg:
            breaks.append(k)
    return [np.asarray(run, np.int64) for run in np.split(known, breaks)]


def mean_alignment(T_chunk_cam: Poses, T_source_cam: Poses) -> Poses:
    """Return T_source_chunk (4, 4) that aligns cameras to their given poses, on average. Both have shape (F, 4, 4)."""
    U, _, Vt = np.linalg.svd((T_source_cam[:, :3, :3] @ T_chunk_cam[:, :3, :3].transpose(0, 2, 1)).sum(axis=0))
    out = np.eye(4)
    out[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    out[:3, 3] = T_source_cam[:, :3, 3].mean(axis=0) - out[:3, :3] @ T_chunk_cam[:, :3, 3].mean(axis=0)
    return out


def stacked(poses: Sequence[Poses | None]) -> Poses:
    """Return poses as one array, NaN where one is missing or no rigid motion. Shape (F, 4, 4)."""
    missing = np.full((4, 4), np.nan)
    return np.stack([missing if T is None or not is_rigid(T) else T for T in poses])


def source_from_chunk(
    T_chunk_cam: Poses, posed: NDArray[np.bool_], T_source_cam: Poses, settings: PriorSettings
) -> Poses | None:
    """Return T_source_chunk (4, 4) by the frames after the last jump; None where no frame has both poses."""
    runs = steady_runs(np.where(posed[:, None, None], T_chunk_cam, np.nan), T_source_cam, settings)
    return mean_alignment(T_chunk_cam[runs[-1]], T_source_cam[runs[-1]]) if runs else None


def bridged(
    T_chunk_cam: Poses, posed: NDArray[np.bool_], T_source_cam: Poses, settings: PriorSettings
) -> tuple[Poses, NDArray[np.bool_]]:
    """Return the poses with those of lost frames, by the given steps, and which frames have one.

    Between two tracked frames the given steps' error at the later one is spread over them; where that is a jump they
    are left out, because its time is unknown. Shapes (F, 4, 4), (F,), (F, 4, 4).
    """
    T, known = T_chunk_cam.copy(), posed.copy()
    followed = np.flatnonzero(posed & np.isfinite(T_source_cam).all(axis=(1, 2)))
    for k in np.flatnonzero(~posed & np.isfinite(T_source_cam).all(axis=(1, 2))).tolist():
        at = int(np.searchsorted(followed, k))
        before, after = followed[at - 1 : at].tolist() if at else [], followed[at : at + 1].tolist()
        if not before and not after:
            break
        near = (before or after)[0]
        T_near_source = T_chunk_cam[near] @ np.linalg.inv(T_source_cam[near])
        missed = np.eye(4)
        if before and after:
            end = after[0]
            missed = np.linalg.inv(T_near_source @ T_source_cam[end]) @ T_chunk_cam[end]
            if np.linalg.norm(missed[:3, 3]) > settings.jump_m or angle_deg(missed) > settings.jump_deg:
                continue
            missed = _share(missed, (k - near) / (end - near))
        T[k], known[k] = T_near_source @ T_source_cam[k] @ missed, True
    return T, known


def _share(motion: Poses, share: float) -> Poses:
    """Return a share of a small motion. Shape (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = rotation_exp(share * rotation_log(motion[:3, :3]))
    out[:3, 3] = share * motion[:3, 3]
    return out
