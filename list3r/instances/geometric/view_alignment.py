"""Registration of anchor views: remaining pose drift inside a chunk would double every far surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.fusion import View
from list3r.memory.core.geometry import rotation_exp, rotation_log

Pose = NDArray[np.float64]

GRID = 4
"""Every how many pixels a point is taken."""
ROUNDS = 4
PRIOR_ANGLE_RAD = 0.004
"""How far the pose of a view is trusted to be off in rotation from one anchor to the next."""
PRIOR_SHIFT = 0.01
"""The same in translation, metres."""


def align_views(views: Sequence[View], unit: float) -> list[View]:
    """Move the views by small rigid corrections until their surfaces coincide; the mean correction is none.

    Each view is laid on up to three earlier ones: projective point-to-plane distances (Chen and Medioni 1992) with
    robust weights, held near the given poses by a Gaussian prior.
    """
    corrections: list[Pose] = []
    placed: list[View] = []
    for number, view in enumerate(views):
        start = corrections[-1] if corrections else np.eye(4)
        references = [placed[number - step] for step in (4, 2, 1) if step <= number]
        correction = _align(view, references, start, unit) if references else start
        corrections.append(correction)
        placed.append(moved_view(view, correction))
    centre = _mean_correction(corrections)
    return [moved_view(view, np.linalg.inv(centre) @ c) for view, c in zip(views, corrections, strict=True)]


def moved_view(view: View, correction: Pose) -> View:
    """The view as seen from a corrected pose."""
    R, t = correction[:3, :3].astype(np.float32), correction[:3, 3].astype(np.float32)
    return replace(
        view, T_chunk_cam=correction @ view.T_chunk_cam, points=view.points @ R.T + t, normals=view.normals @ R.T
    )


def _align(view: View, references: Sequence[View], start: Pose, unit: float) -> Pose:
    mask = view.confirmed[::GRID, ::GRID]
    points = view.points[::GRID, ::GRID][mask].astype(np.float64)
    sigma = view.reading[::GRID, ::GRID][mask].astype(np.float64)
    correction, start_center = start.copy(), (start @ view.T_chunk_cam)[:3, 3]
    prior = np.repeat([1.0 / PRIOR_SHIFT**2, 1.0 / PRIOR_ANGLE_RAD**2], 3) / unit ** np.repeat([2.0, 0.0], 3)
    for _ in range(ROUNDS):
        offset = correction @ np.linalg.inv(start)
        center = (correction @ view.T_chunk_cam)[:3, 3]
        deviation = np.concatenate([center - start_center, rotation_log(offset[:3, :3])])
        H, g = np.diag(prior), prior * deviation
        for reference in references:
            dH, dg = _normal_equations(points, sigma, correction, center, reference)
            H, g = H + dH, g + dg
        step = -np.linalg.solve(H, g)
        turn = np.eye(4)
        turn[:3, :3] = rotation_exp(step[3:])
        turn[:3, 3] = center + step[:3] - turn[:3, :3] @ center
        correction = turn @ correction
    return correction


def _normal_equations(
    points: NDArray[np.float64], sigma: NDArray[np.float64], correction: Pose, center: NDArray[np.float64], ref: View
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """H and g of point-to-plane residuals for (shift, rotation about the camera centre). At most 400 points' worth."""
    p = points @ correction[:3, :3].T + correction[:3, 3]
    T = np.linalg.inv(ref.T_chunk_cam)
    q = p @ T[:3, :3].T + T[:3, 3]
    camera, z = ref.camera, np.maximum(q[:, 2], 1e-6)
    u = np.rint(q[:, 0] / z * camera.fx + camera.cx)
    v = np.rint(q[:, 1] / z * camera.fy + camera.cy)
    inside = (q[:, 2] > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    rows = np.flatnonzero(inside)
    at = v[rows].astype(np.int64), u[rows].astype(np.int64)
    normal, target = ref.normals[at].astype(np.float64), ref.points[at].astype(np.float64)
    residual = np.sum((p[rows] - target) * normal, axis=1)
    ok = ref.confirmed[at] & (np.abs(normal).sum(axis=1) > 0.5) & (np.abs(residual) < 8.0 * sigma[rows] + 0.01)
    rows, normal, residual = rows[ok], normal[ok], residual[ok]
    if len(rows) < 50:
        return np.zeros((6, 6)), np.zeros(6)
    scale = sigma[rows]
    weight = 1.0 / np.square(scale) / (1.0 + np.square(residual / (2.0 * scale)))
    weight *= min(1.0, 400.0 / len(rows))
    J = np.concatenate([normal, np.cross(p[rows] - center, normal)], axis=1)
    return (J * weight[:, None]).T @ J, J.T @ (weight * residual)


def _mean_correction(corrections: Sequence[Pose]) -> Pose:
    out = np.eye(4)
    out[:3, :3] = rotation_exp(np.mean([rotation_log(c[:3, :3]) for c in corrections], axis=0))
    out[:3, 3] = np.mean([c[:3, 3] for c in corrections], axis=0)
    return out
