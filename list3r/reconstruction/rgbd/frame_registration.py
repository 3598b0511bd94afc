"""Register a view against surface points of a model: point-to-plane and brightness residuals together.

Each model point is projected into the view; the surface point there gives a point-to-plane residual along the model's
normal, and the brightness there a photometric one. Both are divided by their own robust scale, so that one weight
balances them, and both are under a Huber kernel. Gauss-Newton on SE(3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.memory.core.geometry import skew
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.poses import small_motion
from list3r.reconstruction.rgbd.kernels import (
    Paired,
    bilinear,
    brightness_slopes,
    centred,
    huber_equations,
    joint_equations,
    pair_up,
    plane_slopes,
    spread,
)
from list3r.reconstruction.rgbd.settings import RegistrationSettings
from list3r.reconstruction.rgbd.view import Floats, WorkingFrame

NormalEquations = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Information, shape (6, 6), and gradient, shape (6,), of the left-hand tangent (translation, rotation)."""


_CELL_PX, _COARSE_CELL_PX, _COARSE_PX, _CELL_POINTS = 16, 8, 128, 10
"""Part of the image in which normals are alike but for noise, that of one of less width, in which structure is in every
larger part, and how many normals tell it."""


@dataclass(frozen=True)
class Samples:
    """Surface points of a model."""

    points: Floats
    """Model coordinates, metres. Shape (N, 3)."""
    normals: Floats
    """Unit. Shape (N, 3)."""
    gray: Floats | None = None
    """Brightness, as that of a view. Shape (N,)."""

    def laid_out(self) -> tuple[Floats, Floats, Floats]:
        """Points, normals and brightness in the layout of the compiled loops."""
        gray = np.zeros(len(self.points), np.float32) if self.gray is None else np.ascontiguousarray(self.gray)
        return np.ascontiguousarray(self.points), np.ascontiguousarray(self.normals), gray


@dataclass(frozen=True)
class KnownFeatures:
    """Local features of the view with known model points: they constrain directions that bare surfaces leave open."""

    points: Floats
    """Model coordinates, metres. Shape (N, 3)."""
    rays_xy: Floats
    """Their positions in the view, x / z and y / z. Shape (N, 2)."""

    def normal_equations(self, T_model_cam: NDArray[np.float64], focal_px: float) -> NormalEquations:
        """Return the normal equations of the reprojection errors, in pixels of the view."""
        R = T_model_cam[:3, :3]
        p = ((self.points - T_model_cam[:3, 3]) @ R).astype(np.float32)
        inverse_z = 1.0 / np.maximum(p[:, 2:], np.float32(0.05))
        error: Floats = np.asarray((p[:, :2] * inverse_z - self.rays_xy) * focal_px, np.float32)
        scale = 1.4826 * float(np.median(np.abs(error))) + 0.05
        slope_cam = np.zeros((len(p), 2, 3), np.float32)
        slope_cam[:, 0, 0] = slope_cam[:, 1, 1] = inverse_z[:, 0]
        slope_cam[:, :, 2] = -p[:, :2] * inverse_z * inverse_z
        slope_model = (np.float32(focal_px) * slope_cam @ R.T.astype(np.float32)).reshape(-1, 3)
        slope = -np.concatenate([slope_model, _cross(np.repeat(self.points, 2, axis=0), slope_model)], axis=1)
        return _normal_equations(slope, error.ravel(), scale)

    def information(self, T_model_cam: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
        """Return their information on the pose found. Shape (6, 6)."""
        return self.normal_equations(T_model_cam, focal_px)[0]


@dataclass(frozen=True)
class PosePrior:
    """The expected pose of the view and its uncertainty."""

    T_model_cam: NDArray[np.float64]
    """Shape (4, 4)."""
    shift_m: float
    """Standard deviation of the camera's position, metres."""
    turn_rad: float
    """Standard deviation of its direction."""
    pairs: float
    """Number of pairs that count as one."""

    def normal_equations(self, T_model_cam: NDArray[np.float64], focal_px: float) -> NormalEquations:
        """Return the normal equations of the tangent from the expected pose, weighted as that many pairs."""
        information = self.pairs * self.information(T_model_cam, focal_px)
        step = T_model_cam @ np.linalg.inv(self.T_model_cam)
        off = np.concatenate([step[:3, 3], cv2.Rodrigues(step[:3, :3])[0].ravel()])
        return information, information @ off

    def information(self, T_model_cam: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
        """Return the information of the left-hand tangent (translation, rotation), model coordinates. Shape (6, 6)."""
        about = np.eye(6)
        about[:3, 3:] = -skew(self.T_model_cam[:3, 3])
        weights = np.array([1.0 / self.shift_m**2] * 3 + [1.0 / self.turn_rad**2] * 3)
        return np.asarray(about.T @ (weights[:, None] * about))


@dataclass(frozen=True)
class FrameRegistration:
    """A view registered to a model."""

    T_model_cam: NDArray[np.float64]
    """Shape (4, 4)."""
    overlap: float
    """Share of the model points that fall on known depth of the view."""
    inliers: float
    """Share of them within the last gate."""
    residual: float
    """Robust standard deviation of the point-to-plane residuals, in units of the sensor's noise."""
    correlation: float
    """Correlation of model and view brightness over the inliers; NaN without texture or brightness."""
    pairs: int
    information: NDArray[np.float64]
    """Information on the left-hand tangent (translation, rotation) in model coordinates, without the share caused by
    noise in normals and gradients. Shape (6, 6)."""
    information_of_surfaces: NDArray[np.float64]
    """The share of that by depth alone."""
    movers: NDArray[np.bool_] | None = None
    """Part of the view that was left out, because it moves by itself. Shape (h, w)."""

    def looseness_m(self, lever_m: float, surfaces_only: bool = False) -> float:
        """Standard deviation of the least determined motion, metres at `lever_m` from the camera."""
        information = self.information_of_surfaces if surfaces_only else self.information
        T = self.T_model_cam
        shift = np.eye(6)
        shift[:3, 3:] = skew(T[:3, 3])  # rotate about the camera instead of the model's origin
        scale = np.diag([1.0, 1.0, 1.0, *[1.0 / lever_m] * 3])
        about_camera = scale @ shift.T @ information @ shift @ scale
        weakest = float(np.linalg.eigvalsh(about_camera)[0])
        return 1.0 / float(np.sqrt(weakest)) if weakest > 0 else float("inf")


def register(
    model: Samples,
    view: WorkingFrame,
    T_model_cam: NDArray[np.float64],
    settings: RegistrationSettings,
    noise: SensorNoise,
    constraint: KnownFeatures | PosePrior | None = None,
) -> FrameRegistration | None:
    """Refine `T_model_cam` by surfaces, brightness and a `constraint`; None when too few points meet."""
    frame = _Frame(view, noise)
    photometric = model.gray is not None and settings.photometric_weight > 0
    T = np.array(T_model_cam, dtype=np.float64)
    laid_out, seen = model.laid_out(), (frame.surface, frame.brightness)
    kernel = settings.huber, settings.photometric_weight if photometric else 0.0
    found: tuple[Paired, float] | None = None
    for iteration in range(settings.iterations):
        halved = min(iteration // settings.gate_hold, settings.gate_halvings)
        gate = settings.gate_m * 0.5**halved, settings.normal_agreement, settings.least_pairs
        paired, scale, information, gradient = joint_equations(laid_out, T, frame.intrinsics, seen, gate, kernel)
        found = paired, scale
        if len(paired[1]) < settings.least_pairs:
            return None
        if constraint is not None:
            more, slope = constraint.normal_equations(T, view.camera.fx)
            information += more
            gradient += slope
        damped = information + 1e-9 * np.trace(information) * np.eye(6)
        step = -np.linalg.solve(damped, gradient)
        T = small_motion(step) @ T
        if halved == settings.gate_halvings and iteration > 2 and np.abs(step).max() < settings.converged:
            break
    assert found is not None
    pairs = _SurfelPairs.of(model, *found)
    of_surfaces = _solid_information(pairs, frame.camera.width, settings)
    information = of_surfaces
    if photometric:
        information = information + (
            settings.photometric_weight * _photometric(pairs, frame, T, settings.gradient_noise)[0]
        )
    if constraint is not None:
        information = information + constraint.information(T, view.camera.fx)
    return FrameRegistration(
        T, pairs.overlap, pairs.share, pairs.scale, _correlation(pairs, frame), pairs.count, information, of_surfaces
    )


def image_motion_px(
    model: Samples, camera: Camera, T_model_a: NDArray[np.float64], T_model_b: NDArray[np.float64]
) -> float:
    """Return how far the model moves in the image between two poses (4, 4), px, median; inf where nothing is seen."""
    uv, ahead = [], np.ones(len(model.points), bool)
    for T in (T_model_a, T_model_b):
        x, y, z = ((model.points - T[:3, 3].astype(np.float32)) @ T[:3, :3].astype(np.float32)).T
        ahead &= z > 0.05
        z = np.maximum(z, np.float32(0.05))
        uv.append(np.stack([camera.fx * x / z, camera.fy * y / z], axis=1))
    return float(np.median(np.linalg.norm(uv[0] - uv[1], axis=1)[ahead])) if ahead.any() else float("inf")


def steps_without(
    model: Samples,
    view: WorkingFrame,
    T_model_cam: NDArray[np.float64],
    masks: Sequence[NDArray[np.bool_]],
    settings: RegistrationSettings,
    noise: SensorNoise,
) -> list[NDArray[np.float64] | None]:
    """Return the step (4, 4) from a registered pose that the rest of the view would take if a part were left out.

    `masks` are the parts, (h, w) each; None where the rest is too little. One Gauss-Newton step, on shared residuals.
    """
    frame, last_gate = _Frame(view, noise), settings.gate_m * 0.5**settings.gate_halvings
    pairs = _pair(model, frame, T_model_cam, last_gate, settings.normal_agreement)
    rows, errors = [_geometric_slope(pairs)], [pairs.residual]
    if pairs.gray is not None and settings.photometric_weight > 0:
        slope, error = _photometric_slope(pairs, frame, T_model_cam)
        rows.append(slope)
        errors.append(error)
    x, y = np.rint(pairs.uv).astype(np.int64).T
    out: list[NDArray[np.float64] | None] = []
    for mask in masks:
        rest = np.flatnonzero(~mask[y, x])
        if len(rest) < 50:
            out.append(None)
            continue
        information, gradient = _normal_equations(rows[0][rest], errors[0][rest], spread(errors[0][rest], 1e-3))
        if len(rows) > 1:
            error = centred(errors[1][rest])
            more, slope64 = _normal_equations(rows[1][rest], error, spread(error, 1.0))
            information += settings.photometric_weight * more
            gradient += settings.photometric_weight * slope64
        out.append(small_motion(-np.linalg.solve(information + 1e-9 * np.trace(information) * np.eye(6), gradient)))
    return out


class _Frame:
    """The images of a view as the loops read them."""

    def __init__(self, view: WorkingFrame, noise: SensorNoise) -> None:
        self.camera = view.camera
        self.intrinsics = view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy
        self.surface = view.points, view.normals, view.valid, 1.0 / noise.sigma(view.depth)
        dx = cv2.Sobel(view.gray, cv2.CV_32F, 1, 0, scale=0.125)
        dy = cv2.Sobel(view.gray, cv2.CV_32F, 0, 1, scale=0.125)
        self.brightness = np.stack([view.gray, dx, dy], axis=-1, dtype=np.float32)


@dataclass(frozen=True)
class _SurfelPairs:
    """Pairs of model and view points for one iteration, M of them."""

    moved: Floats
    """View points in model coordinates. Shape (M, 3)."""
    points: Floats
    normals: Floats
    gray: Floats | None
    uv: Floats
    """Projections of the model points, px. Shape (M, 2)."""
    points_cam: Floats
    """Model points in camera coordinates. Shape (M, 3)."""
    residual: Floats
    """Point-to-plane distances over the sensor's noise. Shape (M,)."""
    inverse_sigma: Floats
    scale: float
    overlap: float
    share: float

    @classmethod
    def of(cls, model: Samples, paired: Paired, scale: float) -> _SurfelPairs:
        """Return the result of `pair_up` for a model's points."""
        known, moved, points, normals, gray, uv, points_cam, residual, inverse_sigma = paired
        shares = known / max(1, len(model.points)), len(residual) / max(1, known)
        tone = None if model.gray is None else gray
        return cls(moved, points, normals, tone, uv, points_cam, residual, inverse_sigma, scale, *shares)

    @property
    def count(self) -> int:
        return len(self.residual)


def _pair(model: Samples, frame: _Frame, T: NDArray[np.float64], gate_m: float, agreement: float) -> _SurfelPairs:
    paired = pair_up(model.laid_out(), np.ascontiguousarray(T), frame.intrinsics, frame.surface, gate_m, agreement)
    return _SurfelPairs.of(model, paired, spread(paired[7], 1e-3))


def _geometric_slope(pairs: _SurfelPairs) -> Floats:
    return plane_slopes(pairs.moved, pairs.normals, pairs.inverse_sigma)


def _solid_information(pairs: _SurfelPairs, width: int, settings: RegistrationSettings) -> NDArray[np.float64]:
    """Information of depth in an image of some width without the share that comes from noise alone.

    A point-to-plane slope is A n with A = (I, [q]x). Noise of variance s in n adds s A A' on average, by which a bare
    wall would seem to constrain the camera; it is subtracted. A model of one view has much more of it than another.
    """
    weight = (pairs.inverse_sigma / np.float32(pairs.scale)) ** 2
    weighted = weight[:, None] * pairs.moved
    first, second = skew(weighted.sum(axis=0).astype(np.float64)), (weighted.T @ pairs.moved).astype(np.float64)
    feigned = np.block([[float(weight.sum()) * np.eye(3), first.T], [first, np.trace(second) * np.eye(3) - second]])
    information = _normal_equations(_geometric_slope(pairs), pairs.residual, pairs.scale, settings.huber)[0]
    information -= max(settings.normal_noise**2, _normal_variance(pairs, width)) * feigned
    return information


def _normal_variance(pairs: _SurfelPairs, width: int) -> float:
    """Variance of the model's normals about those around them in the image, along one axis, rad^2: the median cell."""
    column, row = np.floor(pairs.uv / (_CELL_PX if width > _COARSE_PX else _COARSE_CELL_PX)).astype(np.int64).T
    cell = row * (column.max() + 1) + column
    count = np.bincount(cell)
    full = count >= _CELL_POINTS
    if not full.any():
        return 0.0
    total = np.stack([np.bincount(cell, axis)[full] for axis in pairs.normals.T], axis=1)
    n = count[full]
    return float(np.median((n - (total**2).sum(axis=1) / n) / (2 * (n - 1))))


def _photometric(
    pairs: _SurfelPairs, frame: _Frame, T: NDArray[np.float64], least_gradient: float = 0.0
) -> NormalEquations:
    """Normal equations of the brightness residuals; their median removes a common change of exposure."""
    slope, error = _photometric_slope(pairs, frame, T, least_gradient)
    error = centred(error)
    return _normal_equations(slope, error, spread(error, 1.0))


def _photometric_slope(
    pairs: _SurfelPairs, frame: _Frame, T: NDArray[np.float64], least_gradient: float = 0.0
) -> tuple[Floats, Floats]:
    assert pairs.gray is not None
    sampled, camera = bilinear(frame.brightness, pairs.uv), frame.camera
    R, focal = np.ascontiguousarray(T[:3, :3]), (camera.fx, camera.fy)
    slope = brightness_slopes(pairs.points, pairs.points_cam, sampled, R, focal, least_gradient)
    return slope, sampled[:, 0] - pairs.gray


def _normal_equations(slope: Floats, error: Floats, scale: float, huber: float = 1.345) -> NormalEquations:
    """Huber-weighted, with the residuals in units of their robust scale."""
    information, gradient = huber_equations(slope, error, scale, huber)
    return information, gradient


def _correlation(pairs: _SurfelPairs, frame: _Frame) -> float:
    if pairs.gray is None or pairs.count < 2:
        return float("nan")
    value = bilinear(frame.brightness, pairs.uv)[:, 0]
    a, b = value - value.mean(), pairs.gray - pairs.gray.mean()
    spread = float(a.std() * b.std())
    return float((a * b).mean()) / spread if min(a.std(), b.std()) > 2.0 else float("nan")


def _cross(a: Floats, b: Floats) -> Floats:
    ax, ay, az, bx, by, bz = a[:, 0], a[:, 1], a[:, 2], b[:, 0], b[:, 1], b[:, 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)
