"""Find movers in residuals: surfaces that disagree with the motion that the rest of the picture determines.

Two explanations, with and without a whole surface, are compared by a vote of pixels. A robust kernel over single pixels
cannot tell a large near mover from the background: both agree half (research/depth-odometry 0063).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.motion.settings import ResidualMoverSettings
from list3r.reconstruction.rgbd.frame_registration import FrameRegistration, PosePrior, Samples, register, steps_without
from list3r.reconstruction.rgbd.kernels import centred
from list3r.reconstruction.rgbd.settings import OdometrySettings
from list3r.reconstruction.rgbd.view import Floats, WorkingFrame

Mask = NDArray[np.bool_]
Pose = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """How well a pose explains model points inside and outside a mask."""

    inside: float
    """Mean truncated cost, 0 to 2 * truncate^2; NaN without pixels."""
    outside: float
    count_inside: int
    count_outside: int

    @property
    def mean(self) -> float:
        """Over all points, NaN where a side has none."""
        total = self.inside * self.count_inside + self.outside * self.count_outside
        return total / max(1, self.count_inside + self.count_outside)


def fit(
    model: Samples,
    view: WorkingFrame,
    mask: Mask,
    T_model_cam: Pose,
    settings: ResidualMoverSettings,
    noise: SensorNoise,
) -> Fit:
    """Mean cost inside and outside a mask."""
    cost, pixel = pixel_costs(model, view, T_model_cam, settings, noise)
    return _split(cost, mask.ravel()[pixel])


def _split(cost: Floats, moving: Mask) -> Fit:
    return Fit(_mean(cost[moving]), _mean(cost[~moving]), int(moving.sum()), int((~moving).sum()))


def pixel_costs(
    model: Samples, view: WorkingFrame, T_model_cam: Pose, settings: ResidualMoverSettings, noise: SensorNoise
) -> tuple[Floats, NDArray[np.int64]]:
    """Truncated squares of depth and brightness residuals over noise, summed, and their pixels."""
    camera = view.camera
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    law = noise.constant_m, noise.quadratic_per_m, noise.nearest_m
    seen = view.points, view.gray, view.valid
    residual, error, pixel = _residuals(model.laid_out(), np.ascontiguousarray(T_model_cam), intrinsics, seen, law)
    limit = np.float32(settings.truncate**2)
    cost = np.minimum(residual * residual, limit)
    if model.gray is not None and len(pixel):
        error = centred(error) / np.float32(settings.gray_sigma)
        cost += np.minimum(error * error, limit)
    return cost, pixel


@compiled
def _residuals(
    model: tuple[Floats, Floats, Floats],
    T_model_cam: Pose,
    intrinsics: tuple[float, float, float, float],
    view: tuple[Floats, Floats, Mask],
    law: tuple[float, float, float],
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Distances of a view's surface from model points over noise, brightness differences, and pixels, (M,) each."""
    points, normals, gray = model
    there, tone, valid = view
    R, t = T_model_cam[:3, :3], T_model_cam[:3, 3]
    height, width = valid.shape
    size, count = len(points), 0
    residual, error, pixel = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.int64)
    for k in range(size):
        p = (points[k, 0] - t[0], points[k, 1] - t[1], points[k, 2] - t[2])
        z = p[0] * R[0, 2] + p[1] * R[1, 2] + p[2] * R[2, 2]
        if not z > 0.05:
            continue
        u = (p[0] * R[0, 0] + p[1] * R[1, 0] + p[2] * R[2, 0]) / z * intrinsics[0] + intrinsics[2]
        v = (p[0] * R[0, 1] + p[1] * R[1, 1] + p[2] * R[2, 1]) / z * intrinsics[1] + intrinsics[3]
        if not (u > 0 and v > 0 and u < width - 1 and v < height - 1):
            continue
        row, column = int(v + 0.5), int(u + 0.5)
        if not valid[row, column]:
            continue
        q, distance = there[row, column], 0.0
        for c in range(3):
            moved = R[c, 0] * q[0] + R[c, 1] * q[1] + R[c, 2] * q[2] + t[c]
            distance += (moved - points[k, c]) * normals[k, c]
        away = q[2] - law[2]
        residual[count] = distance / (law[0] + law[1] * away * away)
        x, y, left, top = u - int(u), v - int(v), int(u), int(v)
        above = tone[top, left] * (1 - x) + tone[top, left + 1] * x
        below = tone[top + 1, left] * (1 - x) + tone[top + 1, left + 1] * x
        error[count] = above * (1 - y) + below * y - gray[k]
        pixel[count] = row * width + column
        count += 1
    return residual[:count], error[:count], pixel[:count]


def surfaces(view: WorkingFrame, settings: ResidualMoverSettings, noise: SensorNoise) -> list[Mask]:
    """Masks of the surfaces bounded by steps of depth, largest first."""
    depth, area = view.depth, view.depth.size
    step = np.float32(settings.depth_step) * depth + 3 * noise.sigma(depth)
    whole = depth > 0
    across = np.abs(np.diff(depth, axis=1)) > step[:, 1:]
    down = np.abs(np.diff(depth, axis=0)) > step[1:]
    whole[:, 1:] &= ~across
    whole[:, :-1] &= ~across
    whole[1:] &= ~down
    whole[:-1] &= ~down
    core = cv2.erode(whole.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA]
    fit_in = (sizes >= settings.least_share * area) & (sizes <= settings.most_share * area)
    chosen = [int(k) for k in np.argsort(-sizes, kind="stable") if k > 0 and fit_in[k]]
    return [_grown(labels == k, 7) for k in chosen]


def without(view: WorkingFrame, mask: Mask) -> WorkingFrame:
    """Return the view with a part unknown."""
    return replace(view, valid=view.valid & ~mask)


def mover_in_residuals(
    model: Samples,
    view: WorkingFrame,
    T_guess: Pose,
    found: FrameRegistration,
    odometry: OdometrySettings,
    prior: PosePrior | None = None,
) -> tuple[Mask, FrameRegistration] | None:
    """Return the surface that most plainly moves, and the view registered without it; None without one.

    A `prior` of the view's pose also applies to the rest of it: a bare wall alone would let the camera slide.
    """
    registration, settings, noise = odometry.registration, odometry.movers, odometry.noise
    best: tuple[float, Mask] | None = None
    few = _every(model, settings.check_stride)
    for mask in suspects(model, view, found, odometry):
        rest = register(few, without(view, mask), T_guess, registration, noise, prior)
        if rest is None:
            continue
        before = fit(few, view, mask, found.T_model_cam, settings, noise)
        after = fit(few, view, mask, rest.T_model_cam, settings, noise)
        if after.count_inside < settings.least_seen * (mask & view.valid).sum() * len(few.points) / view.valid.sum():
            continue
        if after.inside < settings.contrast * after.outside:
            continue
        gain = 1 - after.mean / max(before.mean, 1e-6)
        rest_gain = 1 - after.outside / max(before.outside, 1e-6)
        strange = before.inside > settings.truncate**2 and after.inside > settings.truncate**2
        if gain < settings.gain and rest_gain < settings.rest_gain and not strange:
            continue
        if best is None or gain > best[0]:
            best = (gain, mask)
    if best is None:
        return None
    rest = register(model, without(view, best[1]), T_guess, registration, noise, prior)
    return None if rest is None else (best[1], rest)


def suspects(model: Samples, view: WorkingFrame, found: FrameRegistration, odometry: OdometrySettings) -> list[Mask]:
    """Return the surfaces that one more step without them would shift by more than noise."""
    registration, settings, noise = odometry.registration, odometry.movers, odometry.noise
    few = _every(model, settings.suspect_stride)
    cost, pixel = pixel_costs(few, view, found.T_model_cam, settings, noise)
    masks = [m for m in surfaces(view, settings, noise) if (m & view.valid).mean() >= 0.5 * settings.least_share]
    out = []
    for mask, shift in zip(masks, steps_without(few, view, found.T_model_cam, masks, registration, noise), strict=True):
        if shift is None:
            continue
        now = _split(cost, mask.ravel()[pixel])
        place = np.median(view.points[mask & view.valid][::7], axis=0) @ found.T_model_cam[:3, :3].T
        place += found.T_model_cam[:3, 3]
        moved = float(np.linalg.norm(shift[:3, :3] @ place + shift[:3, 3] - place))
        strange = now.inside > max(settings.truncate**2, settings.contrast * now.outside)
        far = np.median(view.depth[mask & view.valid][::7], keepdims=True)
        least = max(settings.suspect_m, float(noise.sigma(far)[0]))
        if moved > least or (strange and now.count_inside > settings.least_pairs):
            out.append(mask)
    return out


class MoverMemory:
    """Movers of the last frame, propagated to the next until they have been static."""

    def __init__(self, settings: ResidualMoverSettings, noise: SensorNoise) -> None:
        self._settings, self._noise = settings, noise
        self.mask: Mask | None = None
        """Movers of the last tracked frame."""
        self._continued = False
        """Whether whole surfaces of the next view continue them."""
        self._trial: Samples | None = None
        self._trial_age = 0
        self._home = -1

    def expect(self, view: WorkingFrame) -> Mask | None:
        """Return the part of the next view that still belongs to the mover."""
        if self.mask is None or not self.mask.any():
            return None
        out = np.zeros_like(self.mask)
        for mask in surfaces(view, replace(self._settings, least_share=0.5 * self._settings.least_share), self._noise):
            if (mask & self.mask).sum() >= 0.5 * mask.sum():
                out |= mask
        self._continued = bool(out.sum() >= 0.5 * self.mask.sum())
        return out if self._continued else out | self.mask

    def keep(self, view: WorkingFrame, mask: Mask, T_model_cam: Pose, usual: float, home: int) -> Mask:
        """Remember the movers of a tracked view (the whole one); returns them, or nothing once they stayed in place.

        `usual` is the mean cost of the static part, `home` the number of the segment of the coordinates.
        """
        if home != self._home:
            self._trial, self._home = None, home
        self._trial_age += 1
        if self._trial is not None and self._trial_age >= self._settings.trial_frames:
            if self._stayed(view, T_model_cam, usual):
                mask = np.zeros_like(mask)
            self._trial = None
        if self._trial is None and mask.any():
            self._trial, self._trial_age = _samples(view, mask, T_model_cam), 0
        self.mask = mask if mask.any() else None
        if self.mask is None:
            self._trial = None
        return mask

    def _stayed(self, view: WorkingFrame, T_model_cam: Pose, usual: float) -> bool:
        """Return whether the movers are where they were, wherever the camera looks by now.

        So they are taken to be where their place is out of sight and no surface continues them: the mask then shows
        whatever the camera has turned to.
        """
        assert self._trial is not None
        cost, _ = pixel_costs(self._trial, view, T_model_cam, self._settings, self._noise)
        if len(cost) < self._settings.least_seen * len(self._trial.points):
            return not self._continued
        return _mean(cost) < self._settings.contrast * usual


def _samples(view: WorkingFrame, mask: Mask, T_model_cam: Pose) -> Samples:
    seen = mask & view.valid
    R, t = T_model_cam[:3, :3].astype(np.float32), T_model_cam[:3, 3].astype(np.float32)
    return Samples(view.points[seen] @ R.T + t, view.normals[seen] @ R.T, view.gray[seen])


def _every(model: Samples, stride: int) -> Samples:
    return Samples(
        model.points[::stride], model.normals[::stride], None if model.gray is None else model.gray[::stride]
    )


def _grown(mask: Mask, width: int) -> Mask:
    return cv2.dilate(mask.astype(np.uint8), np.ones((width, width), np.uint8)) > 0


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")
