"""Local features with depth, which relocalise a frame without an initial pose."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.sift import SIFT_WIDTH, nearest_pairs, root_sift, sift
from list3r.reconstruction.base import SensorNoise
from list3r.reconstruction.features.settings import FeatureSettings
from list3r.reconstruction.rgbd.view import Floats

LEARNED_RATIO = 0.95
"""Ratio of best to second best distance for learned descriptors: on redkitchen ALIKED then has SIFT's precision at 0.85
for frames one second apart and 1.5 times its right pairs."""


@dataclass(frozen=True)
class Features:
    """Local features of one frame, N of them, strongest first."""

    xy: Floats
    """px. Shape (N, 2)."""
    descriptors: NDArray[np.uint8]
    """SIFT, shape (N, 128), or learned ones as bytes, of another width."""
    points_cam: Floats
    """Camera coordinates, metres, NaN where depth is unknown. Shape (N, 3)."""


@dataclass(frozen=True)
class FeaturePose:
    """A relative pose that the features of two frames agree on."""

    T_a_b: NDArray[np.float64]
    """Shape (4, 4)."""
    matches: int
    """Mutual matches with depth on both sides."""
    inliers: int


def detect(color: NDArray[np.uint8], depth: Floats, camera: Camera, settings: FeatureSettings) -> Features:
    """SIFT features of an RGB image, with the depth found at each."""
    gray = np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)
    xy, descriptors = sift(gray, settings.count, settings.width or None)
    return Features(xy, descriptors, points_at(xy, depth, camera))


def points_at(xy: Floats, depth: Floats, camera: Camera) -> Floats:
    """Camera coordinates of pixels by the median of the known depths in 3x3 around each; NaN without. Shape (N, 3)."""
    column = np.clip(np.rint(xy[:, 0]).astype(int), 0, camera.width - 1)
    row = np.clip(np.rint(xy[:, 1]).astype(int), 0, camera.height - 1)
    steps = np.arange(-1, 2)
    rows = np.clip(row[:, None, None] + steps[:, None], 0, camera.height - 1)
    columns = np.clip(column[:, None, None] + steps[None, :], 0, camera.width - 1)
    around = np.sort(np.where(depth[rows, columns] > 0, depth[rows, columns], np.inf).reshape(len(xy), 9), axis=1)
    known = np.isfinite(around).sum(axis=1)
    z = around[np.arange(len(xy)), np.maximum(known - 1, 0) // 2]
    z = np.where(known > 0, z, np.nan)
    rays = [(xy[:, 0] - camera.cx) / camera.fx, (xy[:, 1] - camera.cy) / camera.fy, np.ones(len(xy))]
    return (np.stack(rays, axis=1) * z[:, None]).astype(np.float32)


def match(a: NDArray[np.uint8], b: NDArray[np.uint8], ratio: float) -> NDArray[np.int64]:
    """Mutual nearest neighbours that pass the ratio test, by RootSIFT distance. Shape (M, 2).

    Descriptors of another width than SIFT's are learned ones (`learned.as_bytes`), whose distances vary less; different
    widths never match.
    """
    if len(a) < 2 or len(b) < 2 or a.shape[1] != b.shape[1]:
        return np.zeros((0, 2), np.int64)
    if a.shape[1] != SIFT_WIDTH:
        ratio = max(ratio, LEARNED_RATIO)
    return nearest_pairs(root_sift(a), root_sift(b), ratio)


def relative_pose(
    points_a: Floats,
    points_b: Floats,
    settings: FeatureSettings,
    noise: SensorNoise,
) -> FeaturePose | None:
    """Return the rigid transform that most pairs of 3D points agree on, by seeded RANSAC; None for too few inliers.

    `points_a` and `points_b` have shape (M, 3), camera coordinates, metres; pairs with an unknown point are left out.
    """
    known = np.isfinite(points_a).all(axis=1) & np.isfinite(points_b).all(axis=1)
    a, b = points_a[known].astype(np.float64), points_b[known].astype(np.float64)
    if len(a) < settings.least_pairs:
        return None
    gate = gates(a, b, settings, noise)
    triples = np.random.default_rng(len(a)).integers(0, len(a), (settings.trials, 3))
    R, t = rigid_fits(b[triples], a[triples])
    errors = np.linalg.norm(np.einsum("tij,nj->tni", R, b) + t[:, None] - a, axis=-1)
    best = int((np.minimum(errors / gate, 1.0)).sum(axis=1).argmin())
    inside = errors[best] < gate
    for _ in range(4):
        if inside.sum() < settings.least_pairs:
            return None
        weight = inside / gate**2
        R1, t1 = rigid_fits(b[None], a[None], weight[None])
        inside = np.linalg.norm(b @ R1[0].T + t1[0] - a, axis=-1) < gate
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R1[0], t1[0]
    return FeaturePose(T, len(a), int(inside.sum())) if inside.sum() >= settings.least_pairs else None


def gates(
    a: NDArray[np.float64], b: NDArray[np.float64], settings: FeatureSettings, noise: SensorNoise
) -> NDArray[np.float64]:
    """Largest distances that noise explains between points in two cameras, metres. Shapes (N, 3), (N, 3) -> (N,)."""
    farther = np.maximum(a[:, 2], b[:, 2]).astype(np.float32)
    return np.asarray(np.maximum(settings.gate_least_m, settings.gate_sigmas * noise.sigma(farther)), np.float64)


def rigid_fits(
    source: NDArray[np.float64], target: NDArray[np.float64], weight: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rigid transforms of B point sets of n points each. Shapes (B, n, 3) -> (B, 3, 3), (B, 3)."""
    w = np.full(source.shape[:2], 1.0 / source.shape[1]) if weight is None else weight / weight.sum(-1, keepdims=True)
    mean_s, mean_t = np.einsum("bn,bni->bi", w, source), np.einsum("bn,bni->bi", w, target)
    moment = np.einsum("bn,bni,bnj->bij", w, target - mean_t[:, None], source - mean_s[:, None])
    u, _, vt = np.linalg.svd(moment)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    u[..., 2] *= sign[:, None]
    R = u @ vt
    return R, mean_t - np.einsum("bij,bj->bi", R, mean_s)
