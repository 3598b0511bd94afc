"""Align neighbouring chunks on the frames they share (paper 3.2 and A.3).

The same pixel of the same frame is the same surface point in both chunks. Where depth comes from a sensor that point
is even the same in camera coordinates, so what is compared is the poses of the shared frames, each weighed by what it
saw. Instance-aware support (regions that move are left out, equal quotas for instances) is to come in `support`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import DegenerateError
from list3r.memory.geometry import Sim3, umeyama
from list3r.memory.records import Edge, FrameSamples


@dataclass(frozen=True)
class AlignmentSettings:
    """How chunks are aligned."""

    least_pairs: int = 60
    """Fewest shared points."""
    iterations: int = 40
    """Most rounds of re-weighting."""
    huber_quantile: float = 0.2
    """Share of the residuals inside the quadratic part of the kernel."""
    residual_scale: float = 0.02
    """Residual at which a pair counts 1/e in the edge's confidence, as a share of the points' spread (sigma_r)."""
    cells: int = 10
    """Cells across the spread of the points, for even coverage."""
    least_inliers: float = 0.3
    """Least share of pairs within three robust deviations or the residual scale, whichever is wider."""


def align_overlap(
    u: FrameSamples,
    v: FrameSamples,
    u_id: int,
    v_id: int,
    metric: bool,
    settings: AlignmentSettings | None = None,
) -> Edge:
    """The edge between two chunks that share frames; a rigid one when `metric`.

    Raises `DegenerateError` when the shared points do not determine it.
    """
    chosen = settings or AlignmentSettings()
    pick_u, pick_v = _shared(u, v)
    if len(pick_u) < chosen.least_pairs:
        raise DegenerateError(
            f"chunks {u_id} and {v_id} share {len(pick_u)} points; at least {chosen.least_pairs} are needed"
        )
    p_u, p_v = u.points[pick_u].astype(np.float64), v.points[pick_v].astype(np.float64)
    spread = _spread(p_v)
    weight = u.confidence[pick_u].astype(np.float64) * v.confidence[pick_v]
    weight *= _coverage(p_v, spread / chosen.cells)
    S_v_u, residual = _robust_umeyama(p_u, p_v, weight, metric, chosen)
    return _edge(u_id, v_id, S_v_u, residual, weight, spread, chosen, len(np.unique(u.frame[pick_u])))


def _shared(u: FrameSamples, v: FrameSamples) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions in u and v of the samples at the same pixel of the same frame."""
    key_u = (u.frame << np.int64(32)) + u.pixel
    key_v = (v.frame << np.int64(32)) + v.pixel
    _, pick_u, pick_v = np.intersect1d(key_u, key_v, assume_unique=True, return_indices=True)
    return pick_u, pick_v


def _spread(points: NDArray[np.float64]) -> float:
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    return max(float(np.linalg.norm(high - low)), 1e-9)


def _coverage(points: NDArray[np.float64], cell: float) -> NDArray[np.float64]:
    """Weights that fall with the square root of the number of points in a cell. Shape (N,)."""
    cells = np.floor(points / cell).astype(np.int64)
    _, which, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return 1.0 / np.sqrt(count[which.ravel()])


def _robust_umeyama(
    p_u: NDArray[np.float64],
    p_v: NDArray[np.float64],
    weight: NDArray[np.float64],
    metric: bool,
    settings: AlignmentSettings,
) -> tuple[Sim3, NDArray[np.float64]]:
    """Umeyama under a Huber kernel by iterative re-weighting. Residual lengths in v's units, shape (N,).

    The kernel's limit is a low quantile of the residuals rather than a multiple of their median: near to least absolute
    deviations, it lets go of a third of the frames being misplaced together, where the median itself is spoilt.
    """
    S_v_u = umeyama(p_u, p_v, weight, with_scale=not metric)
    residual = np.linalg.norm(S_v_u.apply(p_u) - p_v, axis=1)
    for _ in range(settings.iterations):
        limit = max(float(np.quantile(residual, settings.huber_quantile)), 1e-9)
        S_new = umeyama(p_u, p_v, weight * np.minimum(1.0, limit / np.maximum(residual, 1e-12)), with_scale=not metric)
        change = np.abs((S_new.inverse() @ S_v_u).log()).max()
        S_v_u, residual = S_new, np.linalg.norm(S_new.apply(p_u) - p_v, axis=1)
        if change < 1e-7:
            break
    return S_v_u, residual


def _edge(
    u_id: int,
    v_id: int,
    S_v_u: Sim3,
    residual: NDArray[np.float64],
    weight: NDArray[np.float64],
    spread: float,
    settings: AlignmentSettings,
    frames: int,
) -> Edge:
    sigma = settings.residual_scale * spread
    inside = residual < max(sigma, 3 * 1.4826 * float(np.median(residual)))
    close = float((weight * (residual < 3 * sigma)).sum() / weight.sum())
    confidence = float((weight * np.exp(-residual / sigma)).sum() / weight.sum())
    accepted = close >= settings.least_inliers
    rms = float(np.sqrt(np.mean(residual[inside] ** 2))) if inside.any() else float("inf")
    fit = f"{int(inside.sum())} of {len(residual)} shared points of {frames} frames agree to {rms:.4f}"
    return Edge(
        u=u_id,
        v=v_id,
        kind="adjacent",
        S_v_u=S_v_u,
        confidence=confidence,
        weight=confidence,
        inliers=int(inside.sum()),
        residual_m=rms,
        accepted=accepted,
        reason=fit if accepted else f"{fit}; only {close:.0%} of the weight lies within {3 * sigma:.3f}",
        scores={"pairs": float(len(residual)), "spread": spread, "close": close, "shared_frames": float(frames)},
    )
