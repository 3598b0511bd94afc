"""The covariance of an alignment, measured on the pairs themselves.

Errors within a frame are correlated, so whole frames are left out in turn (the delete-a-group jackknife: Bell and
McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage samples", 2002). A reconstruction
deforms slowly along its frames, so whole thirds of them are too; the thirds' disagreement beyond that of single frames
is added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.quantiles import chi2_quantile, f_quantile
from list3r.memory.core.geometry import skew

Array = NDArray[np.float64]

_ROUNDING = 1e-7
"""Relative error of points stored as float32."""
_BANDS = 8
"""Parts of a single frame that are left out in turn where there is no other frame."""

_BENDING_SEEN = 2.0
"""Ratio of disagreements beyond which thirds differ significantly: without deformation it is chi^2 / 14 with 14
degrees of freedom, beyond 2 in 1.4 % of cases."""
_SINGLE_FRAME = 4.0
"""Factor on the variance where there is only one frame: an error that the whole frame shares is not visible in it."""


@dataclass(frozen=True)
class Uncertainty:
    """The error of an alignment."""

    covariance: Array
    """Of the tangent error x in S_true = S_v_u exp(x), x = (rho, omega, sigma) in u's units. Shape (7, 7)."""
    groups: int
    """Groups with a weight."""
    bending: float
    """Disagreement of the thirds of the groups over that explained by the groups' scatter; 1 without deformation."""


@dataclass(frozen=True)
class FittedPairs:
    """N pairs of points after a fit under Tukey's biweight."""

    p_u: Array
    """Points of u, in u. Shape (N, 3)."""
    q_u: Array
    """Points of v, moved to u by the fit. Shape (N, 3)."""
    weight: Array
    """As given to the fit. Shape (N,)."""
    trust: Array
    """Factor of the biweight on the weight, 0 from `limit_u` on. Shape (N,)."""
    limit_u: float
    """Residual beyond which a pair has no weight, u's units."""
    group: NDArray[np.int64]
    """Number of the frame of each pair, in order of time. Shape (N,)."""

    def normalised(self, center: Array, lever: float) -> FittedPairs:
        """Return the pairs about `center` (3,), lengths in units of `lever`."""
        p, q = (self.p_u - center) / lever, (self.q_u - center) / lever
        return FittedPairs(p, q, self.weight, self.trust, self.limit_u / lever, self.group)


def measure_uncertainty(pairs: FittedPairs, metric: bool, bending_gain: float = 1.0) -> Uncertainty:
    """Estimate the uncertainty of the symmetric fit under Tukey's biweight, rigid when `metric`."""
    weight = pairs.weight * pairs.trust
    w = weight / weight.sum()
    center = w @ pairs.p_u
    lever = float(np.sqrt(w @ ((pairs.p_u - center) ** 2).sum(axis=1)))
    size = 6 if metric else 7
    terms = _Terms.build(pairs.normalised(center, lever), size)
    count = len(terms.score)
    scatter = _steadied(_left_out(terms.information, terms.score), terms.information.sum(axis=0), count)
    scatter, bending = _with_bending(scatter + _ROUNDING**2 * np.eye(size), terms, bending_gain)
    scatter *= _small_sample(size, count)
    if terms.frames == 1:
        scatter *= _SINGLE_FRAME
    shift = np.eye(7)
    shift[:3, 3:6], shift[:3, 6] = skew(center), -center
    unit = np.array([lever] * 3 + [1.0] * 4)
    covariance = np.zeros((7, 7))
    covariance[:size, :size] = scatter
    covariance = shift @ (covariance * unit[:, None] * unit) @ shift.T
    return Uncertainty((covariance + covariance.T) / 2.0, terms.frames, bending)


@dataclass(frozen=True)
class _Terms:
    """Information and score of the pairs, summed by group, about the centre of the points and in levers."""

    information: Array
    """Shape (G, D, D)."""
    score: Array
    """Shape (G, D)."""
    frames: int
    """Groups; the pairs of a single one are cut, in order, into bands that replace groups."""

    @staticmethod
    def build(pairs: FittedPairs, size: int) -> _Terms:
        """Sum the estimating equations of the symmetric fit: those of least squares with the Jacobian at the midpoint
        of the two noisy points. The information is the exact second derivative of the biweight."""
        p, q, weight, trust, group = pairs.p_u, pairs.q_u, pairs.weight, pairs.trust, pairs.group
        order = np.argsort(group, kind="stable")
        order = order[trust[order] > 0]
        off, middle = p[order] - q[order], (p[order] + q[order]) / 2.0
        jacobian = np.zeros((len(order), 3, 7))
        jacobian[:, :, :3], jacobian[:, :, 3:6], jacobian[:, :, 6] = np.eye(3), -skew(middle), middle
        jacobian = jacobian[:, :, :size]
        w, t = weight[order], trust[order]
        along = np.einsum("nij,ni->nj", jacobian, off)
        curl = -4.0 * w * np.sqrt(t) / pairs.limit_u**2
        starts = np.flatnonzero(np.diff(group[order], prepend=np.iinfo(np.int64).min))
        frames = len(starts)
        if frames == 1:
            starts = np.linspace(0, len(order), _BANDS, endpoint=False).astype(np.int64)
        parts = [slice(a, b) for a, b in zip(starts, [*starts[1:], len(order)], strict=True)]
        information = []
        for part in parts:
            rows = (jacobian[part] * np.sqrt(w * t)[part, None, None]).reshape(-1, size)
            information.append(rows.T @ rows + (along[part] * curl[part, None]).T @ along[part])
        return _Terms(np.stack(information), np.add.reduceat(along * (w * t)[:, None], starts, axis=0), frames)


def _left_out(information: Array, score: Array) -> Array:
    """Return the covariance by leaving out each of G groups in turn, one Newton step each (the delete-a-group
    jackknife, CR3)."""
    count, size = score.shape
    rest = information.sum(axis=0) - information + 1e-12 * np.trace(information.sum(axis=0)) * np.eye(size)
    change = np.linalg.solve(rest, score[..., None])[..., 0]
    return np.asarray((count - 1) / count * change.T @ change)


def _steadied(scatter: Array, information: Array, count: int) -> Array:
    """Return the scatter of G groups, shrunk towards the inverse information; more for fewer groups."""
    root, inverse_root = _roots(information)
    white = root @ scatter @ root
    size = len(scatter)
    share = size / (size + count - 1)
    white = (1 - share) * white + share * np.trace(white) / size * np.eye(size)
    return np.asarray(inverse_root @ white @ inverse_root)


def _with_bending(scatter: Array, terms: _Terms, gain: float) -> tuple[Array, float]:
    """Return the scatter, widened where thirds of the groups, in order, differ by more than the scatter of single
    groups explains."""
    count, size = terms.score.shape
    if terms.frames < 6:
        return scatter, 1.0
    bounds = [0, round(count / 3), round(2 * count / 3)]
    summed = np.add.reduceat(terms.information, bounds, axis=0), np.add.reduceat(terms.score, bounds, axis=0)
    thirds = _left_out(*summed)
    root, inverse_root = _roots(terms.information.sum(axis=0))
    walk = root @ thirds @ root
    level = float(np.trace(walk)) / size
    ratio = level / (float(np.trace(root @ scatter @ root)) / size)
    if ratio <= _BENDING_SEEN:
        return scatter, ratio
    excess = gain * (1.0 - _BENDING_SEEN / ratio) * (walk + level * np.eye(size)) / 2.0
    return np.asarray(scatter + inverse_root @ excess @ inverse_root), ratio


def _roots(matrix: Array) -> tuple[Array, Array]:
    """Return the symmetric square root and its inverse of a symmetric positive matrix."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
    root = np.sqrt(np.maximum(values, 1e-14 * max(float(values[-1]), 1e-300)))
    return (vectors * root) @ vectors.T, (vectors / root) @ vectors.T


def _small_sample(size: int, count: int) -> float:
    """Return how much wider a 95 % region must be because the scatter of `count` groups is itself uncertain.

    Hotelling's T^2 against chi^2; the degrees of freedom after drawing towards the information's shape, and a tenth for
    the kernel's own uncertainty, are from simulation (4 to 100 groups, Gaussian noise, outliers, errors by frame).
    """
    freedom = max(size * (count - 1) / 4, 3.0)
    return 1.1 * size * f_quantile(0.95, size, freedom) / chi2_quantile(0.95, size)
