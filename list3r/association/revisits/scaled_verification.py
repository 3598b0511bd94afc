"""Verify a revisit of two chunks whose scales are unknown, by the features and depth of one keyframe of each.

Pairs of features with depth on both sides give scale, rotation and translation. With the scale known both keyframes are
converted to common units in which the scene is at room distance, and verified as metric ones are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.keyframe_covariance import with_scale
from list3r.association.revisits.verification import VerificationSettings, rejected, verify
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3, take, umeyama
from list3r.memory.core.records import Edge, Keyframe
from list3r.reconstruction.features.local import match, rigid_fits

Array = NDArray[np.float64]

_MIDDLE_DEPTH_M = 2.0
"""Median depth of an indoor camera, to which keyframes are scaled so that gates in metres are meaningful."""
_TRIALS = 600


def verify_scaled(
    keyframe_u: Keyframe,
    keyframe_v: Keyframe,
    u_id: int,
    v_id: int,
    settings: VerificationSettings | None = None,
    later: bool = False,
) -> Edge:
    """Return the loop edge between two chunks of unknown scale, accepted or rejected with the reason."""
    chosen = settings or VerificationSettings()
    pairs = match(keyframe_u.keypoint_descriptors, keyframe_v.keypoint_descriptors, chosen.features.ratio)
    a = keyframe_u.points_cam[pairs[:, 0]].astype(np.float64)
    b = keyframe_v.points_cam[pairs[:, 1]].astype(np.float64)
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    a, b = a[known], b[known]
    unit = _MIDDLE_DEPTH_M / max(float(np.median(a[:, 2])) if len(a) else 1.0, 1e-9)
    found = _common_scale(a * unit, b, chosen)
    if found is None:
        return rejected(keyframe_u, keyframe_v, u_id, v_id, f"no scale makes {len(a)} matched features agree")
    coarse = replace(chosen, registration=chosen.scaled_registration)
    edge = verify(_scaled(keyframe_u, unit), _scaled(keyframe_v, found), u_id, v_id, coarse, later)
    spread = float(np.linalg.norm(np.ptp(np.quantile(b, [0.05, 0.95], axis=0), axis=0)))
    S = edge.S_v_u
    covariance = edge.covariance
    if covariance is not None:
        T = keyframe_u.T_chunk_cam
        middle = T[:3, :3] @ np.median(a, axis=0) + T[:3, 3]
        covariance = with_scale(covariance, middle, chosen.errors.common, unit)
    return replace(
        edge,
        S_v_u=Sim3(np.asarray(unit / found), S.rotation, S.translation / found),
        residual_m=edge.residual_m / found,
        scores=edge.scores | {"spread": max(spread, 1e-9)},
        covariance=covariance,
    )


def _scaled(keyframe: Keyframe, factor: float) -> Keyframe:
    T = keyframe.T_chunk_cam.copy()
    T[:3, 3] *= factor
    return replace(
        keyframe,
        T_chunk_cam=T,
        points_cam=(keyframe.points_cam * factor).astype(np.float32),
        depth_small=(keyframe.depth_small * factor).astype(np.float32),
    )


def _common_scale(a: Array, b: Array, settings: VerificationSettings) -> float | None:
    """Return the factor on b's units at which most pairs agree on one similarity, by seeded RANSAC; None when too few
    do."""
    least = settings.features.least_pairs
    if len(a) < least:
        return None
    noise = settings.noise.sigma(a[:, 2].astype(np.float32)).astype(np.float64)
    gate = np.maximum(settings.features.gate_least_m, settings.features.gate_sigmas * noise) * settings.scale_gate
    triples = np.random.default_rng(len(a)).integers(0, len(a), (_TRIALS, 3))
    trials = _similarities(b[triples], a[triples])
    off = np.linalg.norm(trials.apply(b[None]) - a, axis=2)
    score = np.maximum(1.0 - off / gate, 0.0).sum(axis=1)
    inside = off[int(np.argmax(score))] < gate if len(score) else np.zeros(len(a), bool)
    for _ in range(4):
        S = _fit(b[inside], a[inside]) if inside.sum() >= least else None
        if S is None:
            return None
        inside = np.linalg.norm(S.apply(b) - a, axis=1) < gate
    return float(S.scale) if S is not None and inside.sum() >= least else None


def _similarities(source: Array, target: Array) -> Sim3:
    """Return the result of `umeyama` for T triples of points (T, 3, 3), where it is determined and not collapsed."""
    mean_x, mean_y = source.mean(axis=1, keepdims=True), target.mean(axis=1, keepdims=True)
    dx, dy = source - mean_x, target - mean_y
    spread, (R, _) = np.linalg.svd(dx, compute_uv=False), rigid_fits(source, target)
    scale = np.einsum("tni,tij,tnj->t", dy, R, dx) / np.maximum((spread**2).sum(axis=1), 1e-300)
    found = Sim3(scale, R, mean_y[:, 0] - scale[:, None] * (R @ mean_x[:, 0, :, None])[..., 0])
    return take(found, np.flatnonzero((spread[:, 1] >= 1e-9 + 1e-4 * spread[:, 0]) & (scale > 0)))


def _fit(source: Array, target: Array) -> Sim3 | None:
    try:
        S = umeyama(source, target, with_scale=True)
    except DegenerateError:
        return None
    return S if np.isfinite(S.scale) and S.scale > 0 else None
