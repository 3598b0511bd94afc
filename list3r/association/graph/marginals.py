"""The uncertainty of each chunk's pose: marginal covariances, scaled by the observed residuals of the edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.solver import GraphProblem
from list3r.association.quantiles import chi2_quantile, f_quantile
from list3r.memory.core.geometry import Sim3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Marginals:
    """Uncertainty of a solved graph."""

    covariance: Array
    """Of each chunk's tangent error relative to the first of its component. Shape (K, D, D), 0 for that first one."""
    redundancy: Array
    """Degrees of freedom of each edge beyond those that it determines, in [0, D]. Shape (E,)."""


def marginals(problem: GraphProblem, poses: Sim3, trust: Array) -> Marginals:
    """Compute the marginal covariances of all chunks and the redundancy of each edge."""
    d = problem.size
    out = np.zeros((len(problem.fixed), d, d))
    if problem.pattern.count == 0:
        return Marginals(out, np.full(len(problem.u), float(d)))
    diagonal, off = problem.factor(poses, trust).inverse_blocks()
    out[~problem.fixed] = diagonal
    between = np.zeros((len(problem.u), d, d))
    between[problem.inner] = off
    to_u, to_v = problem.jacobians(problem.residuals(poses))
    mixed = to_u @ between @ np.swapaxes(to_v, 1, 2)
    spread = to_u @ out[problem.u] @ np.swapaxes(to_u, 1, 2) + to_v @ out[problem.v] @ np.swapaxes(to_v, 1, 2)
    spread += mixed + np.swapaxes(mixed, 1, 2)
    used = trust * np.einsum("eij,eji->e", problem.information, spread)
    return Marginals(out, np.clip(d - used, 0.0, d))


def variance_factors(
    squares: Array, redundancy: Array, trust: Array, kinds: NDArray[np.int64], before: Array, prior: float
) -> tuple[Array, Array]:
    """Estimate the variance of each kind of edge over that which `before` states, and its degrees of freedom.

    Helmert's estimation of variance components with `prior` degrees of freedom at 1. `squares`, `redundancy` and
    `trust` have shape (E,), `kinds` numbers the kind of each edge, `before` has a factor for each kind. Outlier edges
    do not count.
    """
    factors, freedom = np.ones_like(before), np.full_like(before, prior)
    for kind in range(len(before)):
        mine = (kinds == kind) & (trust > 0.5)
        freedom[kind] = prior + float(redundancy[mine].sum())
        factors[kind] = (prior + float(squares[mine].sum()) * before[kind]) / freedom[kind]
    return factors, freedom


def widening(freedom: float) -> float:
    """Return the factor on a covariance whose scale was estimated with this many degrees of freedom: F against chi^2 at
    95 %."""
    return 3.0 * f_quantile(0.95, 3, freedom) / chi2_quantile(0.95, 3)
