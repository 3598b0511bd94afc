"""Measure the relation of two chunks from the camera poses of their shared frames.

Structure from motion determines cameras far better than surfaces (research/association 0048). The path must be long
enough to determine the scale; otherwise the edge by points stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3, skew
from list3r.memory.core.records import Edge, FrameSamples

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraEdgeSettings:
    """When the camera poses are used."""

    least_frames: int = 6
    """Fewest shared frames."""
    correlated: float = 10.0
    """Number of neighbouring frames that count as one: their errors are correlated."""
    most_scale_sigma: float = 0.25
    """Largest standard deviation of the logarithm of the scale."""
    least_turn_rad: float = 1e-3
    """Least error of a camera's direction."""
    least_shift: float = 0.005
    """Least error of a camera's position, as a share of the length of the shared path."""
    rounds: int = 10


def camera_edge(
    u: FrameSamples, v: FrameSamples, u_id: int, v_id: int, settings: CameraEdgeSettings | None = None
) -> Edge | None:
    """Return adjacent edge from the poses of the frames that two chunks share; None where their path is too short."""
    s = settings or CameraEdgeSettings()
    frames, at_u, at_v = np.intersect1d(u.camera_frames, v.camera_frames, return_indices=True)
    if len(frames) < s.least_frames:
        return None
    T_u, T_v = u.T_chunk_cam[at_u], v.T_chunk_cam[at_v]
    a, b = T_u[:, :3, 3], T_v[:, :3, 3]
    R = _mean_rotation(T_v[:, :3, :3] @ T_u[:, :3, :3].transpose(0, 2, 1))
    S = _with_rotation(R, a, b, np.ones(len(a)))
    off = np.zeros(len(a))
    for _ in range(s.rounds):
        if S is None:
            return None
        off = np.linalg.norm(S.apply(a) - b, axis=1)
        S = _with_rotation(R, a, b, 1.0 / np.maximum(off, 1e-9 + np.median(off)))
    if S is None:
        return None
    turn = _angles(T_v[:, :3, :3].transpose(0, 2, 1) @ R @ T_u[:, :3, :3])
    length = float(np.linalg.norm(np.ptp(a, axis=0)))
    shift = float(np.sqrt(np.median(off**2) / 0.6)) / float(S.scale) + s.least_shift * length
    covariance = _covariance(a, shift, float(np.sqrt((turn**2).mean())) + s.least_turn_rad, s)
    if covariance is None or covariance[6, 6] > s.most_scale_sigma**2:
        return None
    residual = float(np.sqrt((off**2).mean()))
    return Edge(
        u=u_id,
        v=v_id,
        kind="adjacent",
        S_v_u=S,
        confidence=1.0,
        weight=1.0,
        inliers=len(frames),
        residual_m=residual,
        accepted=True,
        reason=f"the cameras of {len(frames)} shared frames agree to {residual:.4f}",
        scores={"pairs": float(len(frames)), "shared_frames": float(len(frames)), "spread": length * float(S.scale)},
        covariance=covariance,
    )


ONE_FRAME = {"one_frame": 1.0}
"""Scores of an edge between chunks that have one frame of reference and scale from the start."""


def one_frame_edge(u: FrameSamples, v: FrameSamples, u_id: int, v_id: int) -> Edge | None:
    """Return the edge of two chunks whose shared frames have the same poses in both, as in a video that was mapped as a
    whole; else None."""
    frames, at_u, at_v = np.intersect1d(u.camera_frames, v.camera_frames, return_indices=True)
    if not len(frames) or not np.allclose(u.T_chunk_cam[at_u], v.T_chunk_cam[at_v], rtol=0.0, atol=1e-9):
        return None
    reason = f"the cameras of {len(frames)} shared frames are the same in both"
    return Edge(u_id, v_id, "adjacent", Sim3.identity(), 1.0, 1.0, len(frames), 0.0, True, reason, dict(ONE_FRAME))


def in_one_frame(edge: Edge) -> bool:
    """Return whether the chunks of an edge have one frame of reference and scale from the start."""
    return "one_frame" in edge.scores


def better_edge(by_points: Edge | None, by_cameras: Edge | None) -> Edge | None:
    """Return the edge by cameras if there is one, with the scores of the points; else the edge by points."""
    if by_cameras is None or by_points is None:
        return by_cameras or by_points
    scores = {**by_points.scores, **by_cameras.scores, "spread": by_points.scores["spread"]}
    return replace(by_cameras, scores=scores, confidence=max(by_points.confidence, 0.5))


def _mean_rotation(rotations: Array) -> Array:
    """Return the rotation nearest to all, by the sum of their matrices."""
    U, _, Vt = np.linalg.svd(rotations.sum(axis=0))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _with_rotation(R: Array, a: Array, b: Array, weight: Array) -> Sim3 | None:
    """Return the scale and place for a known rotation, symmetric in both sides."""
    w = weight / weight.sum()
    middle_a, middle_b = w @ a, w @ b
    x, y = (a - middle_a) @ R.T, b - middle_b
    xx, yy, xy = float(w @ (x * x).sum(axis=1)), float(w @ (y * y).sum(axis=1)), float(w @ (x * y).sum(axis=1))
    if not (xx > 0 and yy > 0 and xy > 0):
        return None
    scale = np.sqrt(yy / xx)
    return Sim3(np.asarray(scale), R, middle_b - scale * R @ middle_a)


def _angles(rotations: Array) -> Array:
    return np.asarray(np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)))


def _covariance(places: Array, shift: float, turn: float, settings: CameraEdgeSettings) -> Array | None:
    """Return covariance of x = (rho, omega, sigma) in u's units, from errors of camera positions and directions."""
    information = np.zeros((7, 7))
    for place in places:
        J = np.concatenate([np.eye(3), -skew(place), place[:, None]], axis=1)
        information += J.T @ J / shift**2
        information[3:6, 3:6] += np.eye(3) / turn**2
    try:
        covariance = np.linalg.inv(information / settings.correlated)
    except np.linalg.LinAlgError:
        return None
    return np.asarray((covariance + covariance.T) / 2.0)
