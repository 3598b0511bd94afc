"""The alignment of VGGT-Long, which the paper builds on: a fixed kernel, scale by ratio of spreads.

After the description of its settings: Huber kernel of 0.1, five rounds of re-weighting, scale the ratio of the weighted
RMS radii, rotation by SVD with the determinant fixed (Umeyama 1991).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.alignment import Alignment
from list3r.association.overlap.alignment_covariance import FittedPairs, measure_uncertainty
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3

Array = NDArray[np.float64]

HUBER = 0.1
"""Limit of the quadratic part of the kernel, units of v."""
ROUNDS = 5
SIGMA_R = 0.02
"""Residual at which a pair counts 1/e in m_uv, as a share of the spread of the points; the paper gives none."""


def plain_align(p_u: Array, p_v: Array, weight: Array, group: NDArray[np.int64], metric: bool) -> Alignment:
    """The alignment of pairs (N, 3) with weights (N,) of frames (N,).

    Its covariance is that of a robust fit to the pairs within three robust deviations. Raises `DegenerateError` when
    the pairs have no weight or no extent.
    """
    S_v_u = ratio_of_radii(p_u, p_v, weight, metric)
    for _ in range(ROUNDS):
        residual = np.linalg.norm(S_v_u.apply(p_u) - p_v, axis=1)
        S_v_u = ratio_of_radii(p_u, p_v, weight * np.minimum(1.0, HUBER / np.maximum(residual, 1e-12)), metric)
    residual = np.linalg.norm(S_v_u.apply(p_u) - p_v, axis=1)
    low, high = np.quantile(p_v, [0.05, 0.95], axis=0)
    spread = float(np.linalg.norm(high - low))
    sigma, share = SIGMA_R * spread, weight / weight.sum()
    inside = residual < 3 * sigma
    return Alignment(
        S_v_u=S_v_u,
        covariance=_covariance(p_u, S_v_u.inverse().apply(p_v), weight, residual / float(S_v_u.scale), group, metric),
        confidence=float(share @ np.exp(-residual / sigma)),
        residual=residual,
        inside=inside,
        rms=float(np.sqrt(np.mean(residual[inside] ** 2))) if inside.any() else float("inf"),
        spread=spread,
        close=float(share @ inside),
        groups=len(np.unique(group)),
        bending=1.0,
    )


def _covariance(
    p_u: Array, q_u: Array, weight: Array, residual: Array, group: NDArray[np.int64], metric: bool
) -> Array:
    limit = max(3 * 1.4826 * float(np.median(residual)), 1e-9)
    trust = np.maximum(0.0, 1.0 - (residual / limit) ** 2) ** 2
    return measure_uncertainty(FittedPairs(p_u, q_u, weight, trust, limit, group), metric).covariance


def ratio_of_radii(p_u: Array, p_v: Array, weight: Array, metric: bool) -> Sim3:
    """Return the weighted similarity of pairs (N, 3), with the ratio of their RMS radii as scale.

    Raises `DegenerateError` when the pairs have no weight or no extent.
    """
    total = float(weight.sum())
    if not (np.isfinite(total) and total > 0):
        raise DegenerateError("no pair has a weight")
    w = weight / total
    mean_u, mean_v = w @ p_u, w @ p_v
    du, dv = p_u - mean_u, p_v - mean_v
    radius_u, radius_v = (float(np.sqrt(w @ (d**2).sum(axis=1))) for d in (du, dv))
    if not (radius_u > 0 and radius_v > 0):
        raise DegenerateError("the pairs have no extent")
    scale = 1.0 if metric else radius_v / radius_u
    left, _, right = np.linalg.svd((dv * w[:, None]).T @ du)
    rotation = (left * [1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return Sim3(np.asarray(scale), rotation, mean_v - scale * rotation @ mean_u)
