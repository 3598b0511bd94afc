"""The relation of two neighbouring chunks from given but imperfect poses, with their drift as its weight.

A chunk reconstructed with such poses is in the source's own world by its frames after the last jump. The next chunk
refers to that world by the frames between the same two jumps.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.edge_information import about
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChunkResult, ChunkRow, Edge, FrameRow
from list3r.reconstruction.pose_prior import PriorSettings, mean_alignment, steady_runs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PriorEdgeSettings:
    """How fast given poses drift."""

    shift_m: float = 0.01
    """Standard deviation of a chunk's position in the source's world, metres, and"""
    shift_share: float = 0.02
    """its growth along the path, by its length: twice the drift that ARKit is known for."""
    yaw_deg: float = 0.3
    """The same of the heading,"""
    yaw_deg_per_m: float = 0.2
    """with its growth,"""
    tilt_deg: float = 0.3
    """and of pitch and roll, which gravity determines."""
    least_frames: int = 6
    """Frames of the next chunk, between two jumps, that place it."""
    steps: PriorSettings = field(default_factory=PriorSettings)


def prior_edge(
    u: ChunkRow, frames_u: list[FrameRow], result: ChunkResult, v_id: int, settings: PriorEdgeSettings
) -> Edge | None:
    """Return the edge from a chunk to the next by given poses; None where too few frames of the next one have any."""
    if result.T_source_cam is None:
        return None
    T_chunk_cam = np.where(result.posed[:, None, None], result.T_chunk_cam, np.nan)
    runs = steady_runs(T_chunk_cam, result.T_source_cam, settings.steps)
    there = [f for f in frames_u if f.state == "posed"]
    shared = [run for run in runs if result.frame_indices[run[0]] <= u.last_frame]
    head = (shared[-1:] or runs[:1] or [np.zeros(0, np.int64)])[0]
    if len(head) < settings.least_frames or not there:
        return None
    T_source_v = mean_alignment(result.T_chunk_cam[head], result.T_source_cam[head])
    center = np.mean([f.T_chunk_cam[:3, 3] for f in there], axis=0)
    steps = np.linalg.norm(np.diff(result.T_source_cam[head][:, :3, 3], axis=0), axis=1)
    middle = int(result.frame_indices[head[len(head) // 2]])
    return Edge(
        u=u.chunk_id,
        v=v_id,
        kind="prior",
        S_v_u=Sim3.from_matrix(np.linalg.inv(T_source_v)),
        confidence=0.5,
        weight=1.0,
        inliers=len(head),
        residual_m=0.0,
        accepted=True,
        reason=f"the source's poses of {len(head)} frames",
        frames=(there[len(there) // 2].frame_index, middle),
        covariance=_covariance(center, float(steps.sum()), settings),
    )


def _covariance(center: Array, length_m: float, s: PriorEdgeSettings) -> Array:
    """Return the covariance of x = (rho, omega, sigma) after a path, rotations about `center` (3,). Shape (7, 7)."""
    shift = np.hypot(s.shift_m, s.shift_share * length_m)
    yaw = np.radians(np.hypot(s.yaw_deg, s.yaw_deg_per_m * length_m))
    tilt = np.radians(s.tilt_deg)
    deviation = np.array([shift, shift, shift, tilt, tilt, yaw, s.shift_share])
    B = about(center[None])[0]
    return np.asarray(B @ np.diag(deviation**2) @ B.T)
