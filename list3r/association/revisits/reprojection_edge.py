"""Refine a loop between chunks of rough depth by reprojection errors of features rather than by distances.

Computed depth is off by several percent and tilts an alignment of points by degrees; the picture gives directions to a
fraction of a pixel. So the points of either keyframe are projected into the other one, and depth is used only for the
ratio of the two scales.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from list3r.association.graph.solver import adjoint
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge, Keyframe
from list3r.reconstruction.features.local import match

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReprojectionSettings:
    """Weights of the errors of features and of depth."""

    ratio: float = 0.85
    """Lowe's ratio."""
    sigma_px: float = 1.5
    """Error of a feature whose point was projected, in px of a picture 640 wide."""
    depth_sigma: float = 0.06
    """Error of a depth, share of it."""
    gates: tuple[float, ...] = (40.0, 12.0, 6.0)
    """Pairs farther off, in deviations, have no weight in the rounds of refinement."""
    least_pairs: int = 12
    correlated: float = 4.0
    """Number of pairs that count as one: their depth errors are correlated."""
    least_turn_rad: float = 0.004
    """Least error of the direction."""
    least_shift: float = 0.01
    """Least error of the position, as a share of the distance of the points."""
    least_scale: float = 0.03
    """Least error of the log scale."""


def refine_loop(
    edge: Edge,
    u: Keyframe,
    v: Keyframe,
    camera_u: Camera,
    camera_v: Camera,
    settings: ReprojectionSettings | None = None,
) -> Edge:
    """Return the accepted edge of two keyframes' chunks, refined; unchanged where too few features have depth."""
    s = settings or ReprojectionSettings()
    rows = match(u.keypoint_descriptors, v.keypoint_descriptors, s.ratio)
    a, b = (k.points_cam[rows[:, n]].astype(np.float64) for n, k in enumerate((u, v)))
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if known.sum() < s.least_pairs:
        return edge
    rows, a, b = rows[known], a[known], b[known]
    T_u, T_v = Sim3.from_matrix(u.T_chunk_cam), Sim3.from_matrix(v.T_chunk_cam)
    start = T_v.inverse() @ edge.S_v_u @ T_u
    pairs = _Pairs(
        a, b, u.keypoints_xy[rows[:, 0]].astype(float), v.keypoints_xy[rows[:, 1]].astype(float), camera_u, camera_v
    )
    far = float(np.median(a[:, 2]))
    unit = np.array([far] * 3 + [1.0] * 4)
    S, jacobian = start, np.zeros((0, 7))
    for gate in s.gates:
        kept = pairs.where(np.abs(pairs.off(S, s)).max(axis=1) < gate)
        if len(kept.a) < s.least_pairs:
            return edge
        S, jacobian = _refined(S, kept, unit, s)
    inside = np.abs(pairs.off(S, s)).max(axis=1) < s.gates[-1]
    if inside.sum() < s.least_pairs:
        return edge
    covariance = _covariance(jacobian, unit, s)
    return _refined_edge(edge, T_v @ S @ T_u.inverse(), covariance, T_u, int(inside.sum()))


def _refined(start: Sim3, pairs: _Pairs, unit: Array, s: ReprojectionSettings) -> tuple[Sim3, Array]:
    """Return the camera of v from that of u, and the Jacobian of its weighted residuals."""

    def residual(x: Array) -> Array:
        return pairs.off(start @ Sim3.exp(x * unit), s).ravel()

    found = least_squares(residual, np.zeros(7), loss="soft_l1", max_nfev=40)
    return start @ Sim3.exp(found.x * unit), np.asarray(found.jac)


def _covariance(jacobian: Array, unit: Array, s: ReprojectionSettings) -> Array:
    """Return the covariance of the tangent in u's camera, u's units."""
    floor = np.array([s.least_shift] * 3 + [s.least_turn_rad] * 3 + [s.least_scale]) ** 2
    information = jacobian.T @ jacobian / s.correlated + 1e-9 * np.eye(7)
    return np.asarray((np.linalg.inv(information) + np.diag(floor)) * unit[:, None] * unit)


def _refined_edge(edge: Edge, S_v_u: Sim3, covariance: Array, T_u: Sim3, inliers: int) -> Edge:
    moved = adjoint(T_u)
    covariance = moved @ covariance @ moved.T
    return replace(
        edge,
        S_v_u=S_v_u,
        covariance=(covariance + covariance.T) / 2.0,
        inliers=inliers,
        reason=f"{edge.reason}; {inliers} features are seen where its points project",
    )


@dataclass(frozen=True)
class _Pairs:
    """N features seen in two keyframes."""

    a: Array
    """Points in the camera of u, u's units. Shape (N, 3)."""
    b: Array
    """Points in the camera of v, v's units. Shape (N, 3)."""
    xy_a: Array
    xy_b: Array
    """Their pixels in v. Shape (N, 2)."""
    camera_a: Camera
    camera_b: Camera

    def where(self, kept: NDArray[np.bool_]) -> _Pairs:
        return _Pairs(self.a[kept], self.b[kept], self.xy_a[kept], self.xy_b[kept], self.camera_a, self.camera_b)

    def off(self, S_b_a: Sim3, s: ReprojectionSettings) -> Array:
        """Return residuals in deviations: reprojection into v and into u, and the ratio of depths. Shape (N, 5)."""
        forth, back = S_b_a.apply(self.a), S_b_a.inverse().apply(self.b)
        ratio = np.log(np.maximum(forth[:, 2], 1e-6) / np.maximum(self.b[:, 2], 1e-6))
        return np.concatenate(
            [
                _missed(forth, self.xy_b, self.camera_b, s),
                _missed(back, self.xy_a, self.camera_a, s),
                ratio[:, None] / (s.depth_sigma * np.sqrt(2.0)),
            ],
            axis=1,
        )


def _missed(points: Array, xy: Array, camera: Camera, s: ReprojectionSettings) -> Array:
    z = np.maximum(points[:, 2:], 1e-3 * max(float(np.median(points[:, 2])), 1e-6))
    at = points[:, :2] / z * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return np.asarray((at - xy) / (s.sigma_px * max(camera.width, camera.height) / 640.0))
