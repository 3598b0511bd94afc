"""Pinholes and poses that fit the points of networks that predict a point for every pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.feedforward.output import WindowOutput

if TYPE_CHECKING:
    import torch

Array = NDArray[np.float64]
Points = NDArray[np.float32]

_PNP_POINTS = 4000
"""Most points from which a pose is computed."""
_PNP_OFF_PX = 5.0
"""A point agrees with a pose when it is seen within this of its pixel (Fast3R's own tolerance)."""


def views(pictures: torch.Tensor) -> list[dict[str, Any]]:
    """Return pictures (n, 3, h, w) in [0, 1] as networks after DUSt3R take them: one dictionary each, in [-1, 1]."""
    import torch

    shape = torch.tensor([pictures.shape[-2:]], dtype=torch.int32)
    return [{"img": p[None] * 2 - 1, "true_shape": shape, "idx": k, "instance": str(k)} for k, p in enumerate(pictures)]


def pinhole(points_cam: Points, weights: NDArray[np.float32]) -> Array:
    """Return the pinhole (fx, fy, cx, cy), px, that best projects points in camera coordinates to their pixels.

    A point (x, y, z) at column u obeys u = fx x / z + cx, a line in x / z fitted by least squares; rows obey the same
    of y. Points (h, w, 3), weights (h, w); NaN where nothing determines it.
    """
    height, width = points_cam.shape[:2]
    z = points_cam[..., 2].astype(np.float64)
    good = np.isfinite(points_cam).all(axis=-1) & (z > 0)
    w = np.where(good, weights, 0.0).astype(np.float64)
    if not w.any():
        return np.full(4, np.nan)
    w /= w.sum()
    found = []
    for axis, pixel in enumerate((np.arange(width)[None, :], np.arange(height)[:, None])):
        slope = np.divide(points_cam[..., axis], z, out=np.zeros_like(z), where=good)
        mean_slope, mean_pixel = float((w * slope).sum()), float((w * pixel).sum())
        spread = float((w * (slope - mean_slope) ** 2).sum())
        focal = float((w * (slope - mean_slope) * (pixel - mean_pixel)).sum()) / spread if spread > 0 else np.nan
        found.append((focal, mean_pixel - focal * mean_slope))
    return np.array([found[0][0], found[1][0], found[0][1], found[1][1]])


def from_points(T_window_cam: Array, points_cam: Points, confidence: NDArray[np.float32]) -> WindowOutput:
    """Return the output of a network that gives each pixel a point in its own camera (n, h, w, 3).

    Every picture gets the pinhole that fits its points best, and the depth of the points on its rays nearest to the
    network's points, whose rays need not be those of a pinhole.
    """
    K = np.stack([pinhole(p, c) for p, c in zip(points_cam, confidence, strict=True)])
    depth = np.stack([_depth_on_rays(p, k) for p, k in zip(points_cam, K, strict=True)])
    return WindowOutput(T_window_cam, depth, confidence.astype(np.float32), K[:, :2], K[:, 2:])


def _depth_on_rays(points_cam: Points, K: Array) -> NDArray[np.float32]:
    height, width = points_cam.shape[:2]
    fx, fy, cx, cy = K
    a, b = ((np.arange(width) - cx) / fx)[None, :], ((np.arange(height) - cy) / fy)[:, None]
    along = points_cam[..., 0] * a + points_cam[..., 1] * b + points_cam[..., 2]
    return np.asarray(along / (1.0 + a**2 + b**2), np.float32)


def camera_of(points: Points, weights: NDArray[np.float32], K: Array) -> Array:
    """Return T_points_cam (4, 4) of the camera that sees every point (h, w, 3) at its pixel; NaN where none does.

    The most confident points decide, by RANSAC and then by least squares over the inliers.
    """
    T = np.full((4, 4), np.nan)
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1) & (weights > 0))
    if len(rows) < 6 or not np.isfinite(K).all():
        return T
    best = np.argsort(-weights[rows, columns], kind="stable")[: len(rows) // 2 + 6]
    chosen = best[np.linspace(0, len(best) - 1, min(len(best), _PNP_POINTS)).astype(np.int64)]
    at = points[rows[chosen], columns[chosen]].astype(np.float64)
    px = np.stack([columns[chosen], rows[chosen]], axis=1).astype(np.float64)
    matrix = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    try:
        found, turn, shift, agree = cv2.solvePnPRansac(
            at, px, matrix, None, reprojectionError=_PNP_OFF_PX, flags=cv2.SOLVEPNP_SQPNP
        )
        if not found or agree is None or len(agree) < 6:
            return T
        turn, shift = cv2.solvePnPRefineLM(at[agree[:, 0]], px[agree[:, 0]], matrix, None, turn, shift)
    except cv2.error:  # points that are on one line, or at one place
        return T
    R = cv2.Rodrigues(turn)[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.T, -R.T @ shift[:, 0]
    return T


def in_camera(T_points_cam: Array, points: Points) -> Points:
    """Return points (h, w, 3) of a common frame in a camera's own."""
    R, t = T_points_cam[:3, :3], T_points_cam[:3, 3]
    return np.asarray((points - t) @ R, np.float32)
