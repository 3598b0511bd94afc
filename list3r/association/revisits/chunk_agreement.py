"""Test a relation on all keyframes of two chunks, not only on the two that it is from.

A relation of two keyframes can be based on an object that was moved or that is similar to another. Then the static
surfaces of one chunk are in the free space of the other. The surfaces that the two keyframes saw are left out, so that
the rest is independent evidence. A room shifted along two walls and the floor still agrees with them, so the agreement
of the surface direction that agrees least counts (research/sessions 0134).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from list3r.association.revisits.verification import working_view
from list3r.memory.core.records import Keyframe
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.rgbd.view import WorkingFrame

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ChunkAgreementSettings:
    """When all keyframes of two chunks support a relation."""

    points: int = 400
    """Most points of a keyframe that are compared with the other chunk."""
    met_m: float = 0.02
    """A point is on a surface within this and"""
    met_sigmas: float = 2.0
    """this many deviations of the sensor's noise, where both"""
    least_cosine: float = 0.8
    """have at least this cosine of the normals."""
    through_m: float = 0.05
    """A point is seen through where depth is farther behind it than this and"""
    through_sigmas: float = 3.0
    """this many deviations."""
    near_m: float = 0.1
    """Nearer points are ignored."""
    prior: float = 0.02
    """Pseudo-count, as a share of all seen points, of points of every direction and of average agreement: a few points
    are no evidence."""
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class ChunkAgreement:
    """Agreement of two chunks under a relation."""

    seen: float
    """Share of a chunk's points that the other chunk saw, the smaller of the two, in [0, 1]."""
    agreement: float
    """Share of these points on a surface, for the normal direction of the least share; the smaller of the two, in
    [0, 1]."""


class ChunkKeyframes:
    """The keyframes of a chunk with depth, as views and as points of the chunk."""

    def __init__(self, keyframes: Sequence[Keyframe], settings: ChunkAgreementSettings) -> None:
        self._settings = settings
        self.prior = settings.prior
        self._views = {k.frame_index: (working_view(k), k.T_chunk_cam) for k in keyframes}
        found = [_surface(view, T, settings.points) for view, T in self._views.values()]
        self.points: Array = np.concatenate([p for p, _ in found]) if found else np.zeros((0, 3))
        """Chunk coordinates, metres. Shape (N, 3)."""
        self.normals: Array = np.concatenate([n for _, n in found]) if found else np.zeros((0, 3))
        """Unit length. Shape (N, 3)."""

    def seen_by(self, frame: int) -> Mask:
        """Return which points are on a surface that one keyframe (Frame.index) saw. Shape (N,)."""
        return self._fares(self.points, self.normals, *self._views[frame])[0]

    def fare(self, points: Array, normals: Array) -> tuple[Mask, Mask]:
        """Return which points (N, 3) were seen here, and which of them are on a surface, chunk coordinates.

        The majority of the keyframes that see a point decides. Shapes (N,).
        """
        met, seen = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
        for view, T in self._views.values():
            on, judged = self._fares(points, normals, view, T)
            met, seen = met + on, seen + judged
        return seen > 0, (met > 0) & (2 * met >= seen)

    def _fares(self, points: Array, normals: Array, view: WorkingFrame, T_chunk_cam: Array) -> tuple[Mask, Mask]:
        """Return which points are on a surface of a view, and which are there or in front of it. Shapes (N,)."""
        s, camera = self._settings, view.camera
        p = (points - T_chunk_cam[:3, 3]) @ T_chunk_cam[:3, :3]
        z = np.maximum(p[:, 2], 1e-3)
        column, row = np.rint(p[:, 0] / z * camera.fx + camera.cx), np.rint(p[:, 1] / z * camera.fy + camera.cy)
        inside = (p[:, 2] > s.near_m) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        at = np.flatnonzero(inside)
        pixel = (row[at] * camera.width + column[at]).astype(np.int64)
        known = view.valid.ravel()[pixel]
        at, pixel = at[known], pixel[known]
        there, normal = view.points.reshape(-1, 3)[pixel], view.normals.reshape(-1, 3)[pixel]
        sigma = s.noise.sigma(there[:, 2])
        off = np.abs(np.einsum("ni,ni->n", p[at] - there, normal))
        along = np.abs(np.einsum("ni,ni->n", normals[at] @ T_chunk_cam[:3, :3], normal))
        limit = s.through_m + s.through_sigmas * sigma
        on, judged = np.zeros(len(points), bool), np.zeros(len(points), bool)
        on[at] = (off < s.met_m + s.met_sigmas * sigma) & (along > s.least_cosine)
        judged[at] = on[at] | (off < limit) | (p[at, 2] < there[:, 2] - limit)
        return on, judged


def chunk_agreement(T_v_u: Array, u: ChunkKeyframes, v: ChunkKeyframes, frames: tuple[int, int]) -> ChunkAgreement:
    """Return the agreement of two chunks under a relation (4, 4) of two keyframes (Frame.index of u and v), metres."""
    T_u_v = np.linalg.inv(T_v_u)
    shares = []
    for source, target, T, frame in ((u, v, T_v_u, frames[0]), (v, u, T_u_v, frames[1])):
        rest = ~source.seen_by(frame)
        points, normals = source.points[rest], source.normals[rest]
        seen, met = target.fare(points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T)
        shares.append((float(seen.sum()) / max(len(source.points), 1), _least_share(normals, seen, met, u.prior)))
    return ChunkAgreement(seen=min(s for s, _ in shares), agreement=min(a for _, a in shares))


def _least_share(normals: Array, seen: Mask, met: Mask, prior: float) -> float:
    """Return the least share of met among seen points over all normal directions: over d the least ratio of the sums of
    (n d)^2 over normals n (N, 3), met over seen."""
    if not met.any():
        return 0.0
    all_seen, all_met = (normals[which].T @ normals[which] for which in (seen, met))
    besides = prior * float(np.trace(all_seen)) * np.eye(3)
    return float(eigh(all_met + float(met.sum()) / float(seen.sum()) * besides, all_seen + besides)[0][0])


def _surface(view: WorkingFrame, T_chunk_cam: Array, most: int) -> tuple[Array, Array]:
    """Return points of a view spread over its picture, and their normals, chunk coordinates. Shapes (N, 3)."""
    rows = np.flatnonzero(view.valid)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]
    R, t = T_chunk_cam[:3, :3], T_chunk_cam[:3, 3]
    return view.points.reshape(-1, 3)[rows] @ R.T + t, view.normals.reshape(-1, 3)[rows] @ R.T
