"""Align two sets of corresponding points: a robust similarity and its covariance (paper 3.2, A.3, A.4).

Both sides are noisy, so the fit is symmetric: the scale at which neither side is shrunk, with rotation and translation
after Umeyama. Outliers are removed in two steps: a start that tolerates up to about half of the frames being misplaced
together, then Tukey's biweight. The covariance is measured, not assumed: errors within a frame are correlated, so whole
frames are left out in turn; a reconstruction deforms slowly along a chunk, so whole thirds are too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.association.overlap.alignment_covariance import FittedPairs, measure_uncertainty
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AlignmentSettings:
    """How point sets are aligned."""

    least_pairs: int = 60
    """Fewest pairs of points."""
    least_groups: int = 1
    """Fewest groups (shared frames)."""
    start_pairs: int = 3000
    """Pairs for the robust start; the fit itself uses all."""
    start_iterations: int = 40
    """Most rounds of re-weighting of the robust start."""
    huber_quantile: float = 0.2
    """Share of the residuals inside the quadratic part of the start's kernel: close to least absolute deviations, it
    tolerates a third of the frames being misplaced together, where their median is an outlier itself."""
    iterations: int = 20
    """Most rounds of re-weighting of the fit."""
    kernel: float = 4.0
    """Residual beyond which a pair has no weight (Tukey's biweight), in medians of the residuals: 6.2 standard
    deviations of one coordinate for Gaussian noise, which costs 4 % of the efficiency of least squares."""
    residual_scale: float = 0.02
    """Residual at which a pair counts 1/e in the confidence m_uv, as a share of the points' spread (sigma_r)."""
    most_angle_sigma_rad: float = 0.35
    """Standard deviation of an angle beyond which the rotation counts as undetermined."""
    most_scale_sigma: float = 0.35
    """Standard deviation of the log scale beyond which the scale counts as undetermined."""
    least_width: float = 1e-4
    """Second extent of the points as a share of the first, below which they are on one line."""
    line_noise: float = 0.25
    """Points are on one line up to noise where their second extent (squared) is below this share of the noise and"""
    line_share: float = 0.01
    """below this share of the first extent (squared)."""
    bending_gain: float = 10.0
    """Variance added for deformation, in units of the random walk that the shared frames show. In simulation 10
    suffices where the deformation is correlated over a tenth to a third of the shared frames; slower deformation
    cannot be seen in them and needs more."""


@dataclass(frozen=True)
class Alignment:
    """A measured similarity between two sets of N corresponding points."""

    S_v_u: Sim3
    """Takes u's coordinates to v's; its scale is 1 for a rigid one."""
    covariance: Array
    """Of the tangent error x in S_true = S_v_u exp(x), x = (rho, omega, sigma) in u's units; row and column of sigma
    are 0 for a rigid one. A Gaussian 95 % region of it holds the truth in about 95 % of cases. Shape (7, 7)."""
    confidence: float
    """m_uv of the paper (A.4), in [0, 1]."""
    residual: Array
    """Distance of each pair after alignment, v's units, infinite for unused pairs. Shape (N,)."""
    inside: NDArray[np.bool_]
    """Inlier pairs of the fit. Shape (N,)."""
    rms: float
    """Root mean square residual of the inliers, v's units."""
    spread: float
    """Diagonal of the bounding box of the points of v, 5 % trimmed at either end, v's units."""
    close: float
    """Share of the weight within three residual scales (sigma_r), in [0, 1]."""
    groups: int
    """Groups with a weight."""
    bending: float
    """Disagreement of the thirds of the groups over that explained by the groups' scatter; 1 without deformation."""

    @property
    def inliers(self) -> int:
        """Number of inlier pairs."""
        return int(self.inside.sum())


def align(
    p_u: ArrayLike,
    p_v: ArrayLike,
    weight: ArrayLike,
    group: ArrayLike,
    metric: bool,
    settings: AlignmentSettings | None = None,
) -> Alignment:
    """Estimate the similarity (rigid when `metric`) that takes `p_u` to `p_v`, with its covariance.

    `p_u` and `p_v` have shape (N, 3); `weight` (N,) is >= 0, a pair of weight 0 or with a coordinate that is not finite
    is left out; `group` (N,) int numbers the frame of each pair, in order of time. Raises `DegenerateError` for support
    that does not determine the transform, with the reason. Formulas: Umeyama 1991; Beaton and Tukey 1974;
    Bell and McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage samples", 2002.
    """
    chosen = settings or AlignmentSettings()
    every = _Pairs.build(p_u, p_v, weight, group)
    pairs, used = _usable(every, chosen)
    spread = _spread(pairs.v)
    start = _robust_start(pairs.thinned(chosen.start_pairs), metric, spread, chosen)
    S_v_u, trust, limit = _refine(pairs, start, metric, spread, chosen)
    scale, back = float(S_v_u.scale), S_v_u.inverse().apply(pairs.v)
    fitted = FittedPairs(pairs.u, back, pairs.weight, trust, limit / scale, pairs.group)
    known = measure_uncertainty(fitted, metric, chosen.bending_gain)
    _check_extent(pairs.u, back, pairs.weight * trust, chosen)
    _check_determined(known.covariance, metric, chosen)
    residual = np.full(len(every.u), np.inf)
    residual[used] = pairs.residual(S_v_u)
    sigma = chosen.residual_scale * spread
    inside = residual < limit
    return Alignment(
        S_v_u=S_v_u,
        covariance=known.covariance,
        confidence=float((pairs.weight * np.exp(-residual[used] / sigma)).sum() / pairs.weight.sum()),
        residual=residual,
        inside=inside,
        rms=float(np.sqrt(np.mean(residual[inside] ** 2))),
        spread=spread,
        close=float((pairs.weight * (residual[used] < 3 * sigma)).sum() / pairs.weight.sum()),
        groups=known.groups,
        bending=known.bending,
    )


def robust_start(
    p_u: ArrayLike,
    p_v: ArrayLike,
    weight: ArrayLike,
    group: ArrayLike,
    metric: bool,
    settings: AlignmentSettings | None = None,
) -> Sim3:
    """Return the transform that `align` starts from: from few of the pairs, not exact, but robust to scattered outliers
    and to up to about half of the frames being misplaced together. Raises `DegenerateError`."""
    chosen = settings or AlignmentSettings()
    pairs, _ = _usable(_Pairs.build(p_u, p_v, weight, group), chosen)
    return _robust_start(pairs.thinned(chosen.start_pairs), metric, _spread(pairs.v), chosen)


@dataclass(frozen=True)
class _Pairs:
    """Corresponding points, N of them."""

    u: Array
    v: Array
    weight: Array
    group: NDArray[np.int64]

    @staticmethod
    def build(p_u: ArrayLike, p_v: ArrayLike, weight: ArrayLike, group: ArrayLike) -> _Pairs:
        u, v = np.asarray(p_u, np.float64), np.asarray(p_v, np.float64)
        assert u.shape == v.shape == (len(u), 3)
        w, g = np.asarray(weight, np.float64), np.asarray(group, np.int64)
        assert w.shape == g.shape == (len(u),)
        return _Pairs(u, v, w, g)

    def __getitem__(self, rows: NDArray[np.generic]) -> _Pairs:
        return _Pairs(self.u[rows], self.v[rows], self.weight[rows], self.group[rows])

    def thinned(self, most: int) -> _Pairs:
        """Return at most `most` pairs, evenly over the groups."""
        if len(self.u) <= most:
            return self
        order = np.argsort(self.group, kind="stable")
        return self[order[np.linspace(0, len(order) - 1, most).astype(np.int64)]]

    def residual(self, S_v_u: Sim3) -> Array:
        """Return distances after alignment, v's units. Shape (N,)."""
        off = S_v_u.apply(self.u) - self.v
        return np.asarray(np.sqrt(np.einsum("ni,ni->n", off, off)))


def _usable(every: _Pairs, settings: AlignmentSettings) -> tuple[_Pairs, NDArray[np.bool_]]:
    """Return the usable pairs, and their mask. Raises `DegenerateError` when they are too few."""
    finite = np.isfinite(every.u).all(axis=1) & np.isfinite(every.v).all(axis=1) & np.isfinite(every.weight)
    used = finite & (every.weight > 0)
    count, least = int(used.sum()), settings.least_pairs
    if count < least:
        of = f"of {len(every.u)} pairs of points only {count} can be used; at least {least} are needed"
        if not finite.all() and int(finite.sum()) < least:
            raise DegenerateError(f"{of} ({int((~finite).sum())} are not finite)")
        if len(every.u) >= least:
            raise DegenerateError(f"{of} (the weights of {int((finite & ~used).sum())} are zero)")
        raise DegenerateError(f"{len(every.u)} pairs of points do not determine a transform; {least} are needed")
    groups = len(np.unique(every.group[used]))
    if groups < settings.least_groups:
        raise DegenerateError(f"the pairs are in {groups} frames; at least {settings.least_groups} are needed")
    pairs = every[used]
    for side in (pairs.u, pairs.v):
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(side.T, aweights=pairs.weight)), 0.0))
        if not spread[2] > 1e-9 * np.abs(side).max():
            raise DegenerateError("the points have no extent: rotation and scale are undetermined")
        if spread[1] < settings.least_width * spread[2]:
            raise DegenerateError("the points are on one line, so the rotation about it is undetermined")
    return pairs, used


def _spread(points: Array) -> float:
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    return max(float(np.linalg.norm(high - low)), 1e-300)


# ---------------------------------------------------------------------------------------------- the fit


def _fit(pairs: _Pairs, weight: Array, metric: bool, symmetric: bool) -> Sim3:
    """Fit by weighted Umeyama. The symmetric scale is the geometric mean of the least squares scales of both
    directions, the maximum likelihood where both sides are equally noisy relative to their size (Deming regression);
    least squares itself shrinks towards zero with the noise of u."""
    w = weight / weight.sum()
    mean_u, mean_v = w @ pairs.u, w @ pairs.v
    du, dv = pairs.u - mean_u, pairs.v - mean_v
    weighted = w[:, None] * dv
    left, size, right = np.linalg.svd(weighted.T @ du)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * sign) @ right
    scale = 1.0
    if not metric:
        u2 = float(w @ np.einsum("ni,ni->n", du, du))
        v2 = float(np.einsum("ni,ni->", weighted, dv))
        scale = float(np.sqrt(v2 / u2)) if symmetric else max(float((size * sign).sum()) / u2, 1e-12)
    return Sim3(np.asarray(scale), rotation, mean_v - scale * rotation @ mean_u)


def _robust_start(pairs: _Pairs, metric: bool, spread: float, settings: AlignmentSettings) -> Sim3:
    """Return the better of two starts: least absolute deviations over all pairs, and the best fit of one group."""
    starts = [_least_absolute(pairs, metric, spread, settings), *_fits_of_groups(pairs, metric)]
    residuals = [pairs.residual(S) for S in starts]
    scale = max(min(float(np.median(r)) for r in residuals), 1e-12 * spread)
    costs = [float((pairs.weight * r / (r + scale)).sum()) for r in residuals]
    return starts[int(np.argmin(costs))]


def _least_absolute(pairs: _Pairs, metric: bool, spread: float, settings: AlignmentSettings) -> Sim3:
    S_v_u, corners = _fit(pairs, pairs.weight, metric, symmetric=False), _corners(pairs.u)
    for _ in range(settings.start_iterations):
        residual = pairs.residual(S_v_u)
        limit = max(float(np.quantile(residual, settings.huber_quantile)), 1e-9 * spread)
        trust = np.minimum(1.0, limit / np.maximum(residual, limit))
        S_new = _fit(pairs, pairs.weight * trust, metric, symmetric=False)
        moved = _moved(S_new, S_v_u, corners)
        S_v_u = S_new
        if moved < 1e-4 * spread:
            break
    return S_v_u


def _fits_of_groups(pairs: _Pairs, metric: bool, most: int = 24) -> list[Sim3]:
    """Return fits of single groups with enough pairs, spread over all groups."""
    values, counts = np.unique(pairs.group, return_counts=True)
    values = values[counts >= 8]
    if len(values) > most:
        values = values[np.linspace(0, len(values) - 1, most).astype(np.int64)]
    rows = (pairs[pairs.group == value] for value in values)
    return [_fit(part, part.weight, metric, symmetric=True) for part in rows]


def _corners(points: Array) -> Array:
    """Return the corners of the points' box: two transforms differ inside by no more than there. Shape (8, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    return np.asarray(np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high))


def _moved(S_a: Sim3, S_b: Sim3, corners: Array) -> float:
    """Return the largest distance of the points under two transforms."""
    return float(np.abs(S_a.apply(corners) - S_b.apply(corners)).max())


def _refine(
    pairs: _Pairs, start: Sim3, metric: bool, spread: float, settings: AlignmentSettings
) -> tuple[Sim3, Array, float]:
    """Return the fit under Tukey's biweight: transform, weight of each pair (N,), and residual of zero weight."""
    S_v_u, corners = start, _corners(pairs.u)
    for k in range(settings.iterations):
        residual = pairs.residual(S_v_u)
        if k < settings.iterations // 2:
            limit = max(settings.kernel * float(np.median(residual)), 1e-9 * spread)
        trust = np.maximum(0.0, 1.0 - (residual / limit) ** 2) ** 2
        S_new = _fit(pairs, pairs.weight * trust, metric, symmetric=True)
        moved = _moved(S_new, S_v_u, corners)
        S_v_u = S_new
        if moved < 1e-7 * spread:
            break
    return S_v_u, trust, limit


def _check_extent(p: Array, q: Array, weight: Array, settings: AlignmentSettings) -> None:
    """Raise `DegenerateError` for a line that only noise makes thick: the two sides disagree across it."""
    w = weight / weight.sum()
    dp, dq = p - w @ p, q - w @ q
    together = (w[:, None] * dp).T @ dq
    _, across, along = np.linalg.eigvalsh((together + together.T) / 2.0)
    noise = float(w @ ((dp - dq) ** 2).sum(axis=1)) / 3.0
    if across < min(settings.line_noise * noise, settings.line_share * along):
        raise DegenerateError("within their noise the points are on one line, so the rotation about it is undetermined")


def _check_determined(covariance: Array, metric: bool, settings: AlignmentSettings) -> None:
    angle = float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:6, 3:6])[2], 0.0)))
    if not angle < settings.most_angle_sigma_rad:
        raise DegenerateError(
            f"the rotation is undetermined (to {angle:.2g} rad): within their noise the points are on a line or a spot"
        )
    scale = float(np.sqrt(max(covariance[6, 6], 0.0)))
    if not metric and not scale < settings.most_scale_sigma:
        raise DegenerateError(
            f"the scale is undetermined (to {scale:.0%}): the points have no extent beyond their noise"
        )
