"""Transforms and boxes.

The rule of names, for the whole project: ``T_a_b`` is rigid and ``S_a_b`` a similarity that takes coordinates of
frame b to frame a, ``p_a = S_a_b @ p_b``; in a product neighbouring letters cancel. Frames are ``world``, ``chunk``,
``cam`` (OpenCV axes: x right, y down, z forward) and ``object``. Quaternions are ``wxyz``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import DegenerateError

Array = NDArray[np.float64]

_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(16)
_NODES, _NODE_WEIGHTS = (_NODES + 1.0) / 2.0, _NODE_WEIGHTS / 2.0


def skew(v: Array) -> Array:
    """Return cross-product matrices of vectors. Shape (..., 3) -> (..., 3, 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def rotation_exp(rotvec: Array) -> Array:
    """Return rotation matrices of rotation vectors in radians. Shape (..., 3) -> (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_rotvec(np.reshape(rotvec, (-1, 3))).as_matrix()
    return np.asarray(flat.reshape(*rotvec.shape[:-1], 3, 3))


def rotation_log(rotation: Array) -> Array:
    """Return rotation vectors in radians of rotation matrices. Shape (..., 3, 3) -> (..., 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(np.reshape(rotation, (-1, 3, 3))).as_rotvec()
    return np.asarray(flat.reshape(*rotation.shape[:-2], 3))


def quat_wxyz_from_rotation(rotation: Array) -> Array:
    """Return unit quaternions, w >= 0. Shape (..., 3, 3) -> (..., 4)."""
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(np.reshape(rotation, (-1, 3, 3))).as_quat(canonical=True)
    return np.asarray(np.roll(xyzw, 1, axis=-1).reshape(*rotation.shape[:-2], 4))


def rotation_from_quat_wxyz(quat_wxyz: Array) -> Array:
    """Return rotation matrices of quaternions (normalised here). Shape (..., 4) -> (..., 3, 3)."""
    norm = np.linalg.norm(quat_wxyz, axis=-1, keepdims=True)
    if not (norm > 0).all():
        raise ValueError("a quaternion of zero norm is not a rotation")
    w, x, y, z = np.moveaxis(np.asarray(quat_wxyz / norm, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _left_integral(omega: Array, sigma: Array) -> Array:
    """W of Sim(3): the integral of exp(u sigma) R(u omega) over u in [0, 1], by Gauss-Legendre quadrature.

    The integrand is entire, so sixteen nodes give machine precision for every rotation up to a half turn, without
    the four special cases of the closed form (Strasdat, "Local accuracy and global consistency", 2012, appendix).
    """
    theta = np.linalg.norm(omega, axis=-1)[..., None]
    grow = _NODE_WEIGHTS * np.exp(_NODES * sigma[..., None])
    first = np.sum(grow * _NODES * np.sinc(_NODES * theta / np.pi), axis=-1)
    second = np.sum(grow * 0.5 * (_NODES * np.sinc(_NODES * theta / (2 * np.pi))) ** 2, axis=-1)
    cross = skew(omega)
    return np.asarray(
        np.sum(grow, axis=-1)[..., None, None] * np.eye(3)
        + first[..., None, None] * cross
        + second[..., None, None] * (cross @ cross)
    )


@dataclass(frozen=True)
class Sim3:
    """A similarity p_a = scale * rotation @ p_b + translation, batched over leading axes; rigid where scale is 1."""

    scale: Array
    """Scale factor, > 0. Shape (...)."""
    rotation: Array
    """Rotation matrix. Shape (..., 3, 3)."""
    translation: Array
    """Translation, units of frame a. Shape (..., 3)."""

    @staticmethod
    def identity() -> Sim3:
        """Return the similarity that changes nothing."""
        return Sim3(np.ones(()), np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Sim3:
        """From homogeneous matrices whose upper block is scale * rotation. Shape (..., 4, 4)."""
        m = np.asarray(matrix, dtype=np.float64)
        scale = np.cbrt(np.linalg.det(m[..., :3, :3]))
        return Sim3(scale, m[..., :3, :3] / scale[..., None, None], m[..., :3, 3].copy())

    @staticmethod
    def exp(tangent: ArrayLike) -> Sim3:
        """From tangents (rho, omega, sigma): translation part, rotation vector, log scale. Shape (..., 7)."""
        v = np.asarray(tangent, dtype=np.float64)
        rho, omega, sigma = v[..., :3], v[..., 3:6], v[..., 6]
        translation = (_left_integral(omega, sigma) @ rho[..., None])[..., 0]
        return Sim3(np.exp(sigma), rotation_exp(omega), translation)

    def log(self) -> Array:
        """Return tangents (rho, omega, sigma), the inverse of `exp` for rotations under a half turn. Shape (..., 7)."""
        omega, sigma = rotation_log(self.rotation), np.log(self.scale)
        rho = np.linalg.solve(_left_integral(omega, sigma), self.translation[..., None])[..., 0]
        return np.concatenate([rho, omega, np.asarray(sigma)[..., None]], axis=-1)

    def as_matrix(self) -> Array:
        """Return homogeneous matrices. Shape (..., 4, 4)."""
        m = np.zeros((*self.rotation.shape[:-2], 4, 4))
        m[..., :3, :3] = np.asarray(self.scale)[..., None, None] * self.rotation
        m[..., :3, 3], m[..., 3, 3] = self.translation, 1.0
        return m

    def __matmul__(self, other: Sim3) -> Sim3:
        moved = (self.rotation @ other.translation[..., None])[..., 0]
        return Sim3(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            np.asarray(self.scale)[..., None] * moved + self.translation,
        )

    def inverse(self) -> Sim3:
        """Return the similarity back from a to b."""
        rotation, scale = np.swapaxes(self.rotation, -1, -2), 1.0 / self.scale
        translation = -np.asarray(scale)[..., None] * (rotation @ self.translation[..., None])[..., 0]
        return Sim3(scale, rotation, translation)

    def apply(self, points: ArrayLike) -> Array:
        """Return points of frame b in frame a. Shape (..., N, 3) -> (..., N, 3)."""
        p = np.asarray(points, dtype=np.float64)
        turned = p @ np.swapaxes(self.rotation, -1, -2)
        return np.asarray(np.asarray(self.scale)[..., None, None] * turned + self.translation[..., None, :])


def stack(poses: Sequence[Sim3]) -> Sim3:
    """Return one batched similarity of many. Shape (K,)."""
    return Sim3(
        np.array([float(p.scale) for p in poses]),
        np.array([p.rotation for p in poses]).reshape(-1, 3, 3),
        np.array([p.translation for p in poses]).reshape(-1, 3),
    )


def take(poses: Sim3, rows: int | NDArray[np.int64]) -> Sim3:
    """Return one or some of a batch."""
    return Sim3(poses.scale[rows], poses.rotation[rows], poses.translation[rows])


def umeyama(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None, *, with_scale: bool) -> Sim3:
    """Return the similarity (rigid when `with_scale` is false) that minimises sum w |S source - target|^2.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991, with weights.
    `source` and `target` have shape (N, 3), `weights` (N,). Raises `DegenerateError` for fewer than three points and
    for points on a line, which leave the rotation open.
    """
    x, y = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    w = np.ones(len(x)) if weights is None else np.asarray(weights, dtype=np.float64)
    if len(x) < 3 or not w.sum() > 0:
        raise DegenerateError(f"{len(x)} correspondences do not determine a transform; at least 3 are needed")
    w = w / w.sum()
    mean_x, mean_y = w @ x, w @ y
    dx, dy = x - mean_x, y - mean_y
    spread = np.linalg.svd(np.sqrt(w)[:, None] * dx, compute_uv=False)
    if spread[1] < 1e-9 + 1e-4 * spread[0]:
        raise DegenerateError("the correspondences lie on one line, so the rotation about it is undetermined")
    u, d, vt = np.linalg.svd((w[:, None] * dy).T @ dx)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / (spread**2).sum()) if with_scale else 1.0
    return Sim3(np.asarray(scale), rotation, mean_y - scale * rotation @ mean_x)


@dataclass(frozen=True)
class OrientedBox:
    """A box with its own axes."""

    center: Array
    """Centre, world units. Shape (3,)."""
    size: Array
    """Full edge lengths along the box's axes, world units. Shape (3,)."""
    rotation: Array
    """R_world_object: columns are the box's axes in the world. Shape (3, 3)."""

    def corners(self) -> Array:
        """Return the eight corners in the world. Shape (8, 3)."""
        signs = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
        return np.asarray(self.center + (signs * self.size) @ self.rotation.T)


def upright_box(points: ArrayLike, trim: float = 0.0) -> OrientedBox:
    """Return the box of least footprint that stands upright (its third axis is world z), the first axis the longer one.

    `points` has shape (N, 3), N >= 1. `trim` is the fraction of points left outside at either end of each axis, a
    guard against stray points.
    """
    p = np.asarray(points, dtype=np.float64)
    angle = _least_footprint_angle(p[:, :2])
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    local = p @ rotation
    low, high = (np.quantile(local, [trim, 1.0 - trim], axis=0)) if trim else (local.min(axis=0), local.max(axis=0))
    if high[1] - low[1] > high[0] - low[0]:
        rotation = np.stack([rotation[:, 1], -rotation[:, 0], rotation[:, 2]], axis=1)
        low, high = np.array([low[1], -high[0], low[2]]), np.array([high[1], -low[0], high[2]])
    return OrientedBox(rotation @ ((low + high) / 2.0), high - low, rotation)


def _least_footprint_angle(xy: Array) -> float:
    """Return the direction of one side of the least-area rectangle round points in the plane, radians in [0, pi/2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = xy[ConvexHull(xy).vertices]
    except (QhullError, ValueError):
        centred = xy - xy.mean(axis=0)
        axis = np.linalg.svd(centred, full_matrices=False)[2][0] if len(xy) > 1 else np.array([1.0, 0.0])
        return float(np.arctan2(axis[1], axis[0]) % (np.pi / 2))
    edges = np.roll(hull, -1, axis=0) - hull
    angles = np.unique(np.round(np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2), 9))
    along = hull @ np.stack([np.cos(angles), np.sin(angles)])
    across = hull @ np.stack([-np.sin(angles), np.cos(angles)])
    return float(angles[np.argmin(np.ptp(along, axis=0) * np.ptp(across, axis=0))])
