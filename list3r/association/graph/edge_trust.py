"""Decide which edges of the graph are inliers: false loops are switched off instead of deforming the map.

A Geman-McClure kernel tightened from convex (graduated non-convexity: Yang et al., "Graduated non-convexity for robust
spatial perception", 2020), on Mahalanobis distances. False loops that agree with each other, as between twin rooms, can
win against a chain that must deform for them; so there is a second start from the loops within the possible drift of
the chain of adjacent edges, and the solution of least cost is taken. The chain's drift is measured on the loops
themselves, by the median.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.marginals import Marginals, marginals, variance_factors
from list3r.association.graph.solver import GraphProblem, adjoint
from list3r.association.quantiles import chi2_quantile
from list3r.memory.core.geometry import Sim3

Array = NDArray[np.float64]


NO_TRUST = 1e-9
"""Weight of rejected edges, so that components that only they join stay in place."""


_FACTORS_CONVERGED = 0.05
"""Change of the log of a variance factor below which the factors have converged."""

_ROUGHLY, _CLOSELY = 1e-3, 1e-9
"""Relative gain of a step at which a stage of the annealing, and at which the solution, has converged."""


@dataclass(frozen=True)
class TrustSettings:
    """When an edge is an inlier."""

    loop_quantile: float = 0.999
    """Share of true loops whose error is inside the limit if all errors are as stated."""
    adjacent_limit: float = 4.0
    """The limit of adjacent edges, in limits of loops: this many agreeing loops outvote one."""
    least_loops: float = 0.5
    """Least share of inliers among loops and"""
    least_adjacent: float = 0.9
    """among adjacent edges for errors to be taken as stated."""
    prior_loops: int = 4
    """Pseudo-count of loops at the stated drift when the chain's true drift is measured."""
    most_drift: float = 30.0
    """Largest factor by which the chain may have drifted more than stated (deviations, not squares)."""
    prior_freedom: float = 10.0
    """Degrees of freedom of the prior at the stated errors of edges."""
    anneal_step: float = 1.6
    """Factor by which the kernel tightens from stage to stage of the annealing; larger ones lose true edges, see
    research/association 0042."""
    rounds: int = 8
    """Most times that errors are rescaled and edges judged again."""
    iterations: int = 20
    """Most steps of a solution; each stage of the annealing takes a quarter."""


@dataclass(frozen=True)
class TrustedGraph:
    """A solved graph with judged edges."""

    poses: Sim3
    trust: Array
    """1 for inlier edges, 0 for outliers. Shape (E,)."""
    squares: Array
    """Squared Mahalanobis distances of the edges, errors scaled. Shape (E,)."""
    limit: Array
    """Largest squared distance of an inlier. Shape (E,)."""
    factors: Array
    """Variance factors of adjacent and of loop edges. Shape (2,)."""
    freedom: Array
    """Degrees of freedom of the factors. Shape (2,)."""
    marginals: Marginals


@dataclass(frozen=True)
class Tree:
    """The spanning tree along which the start was chained."""

    parent: NDArray[np.int64]
    """Row of each chunk's parent, its own row for roots. Shape (K,)."""
    edge: NDArray[np.int64]
    """Edge to the parent, -1 for roots. Shape (K,)."""
    order: NDArray[np.int64]
    """Rows, parents first. Shape (K,)."""


def solve_with_trust(
    problem: GraphProblem, start: Sim3, tree: Tree, loop: NDArray[np.bool_], robust: bool, settings: TrustSettings
) -> TrustedGraph:
    """Solve the graph and find the inlier edges. `loop` (E,) marks those that may be false."""
    kinds = loop.astype(np.int64)
    limit = _limits(problem, loop, settings)
    poses, trust, factors = _as_stated_or_drifted(problem, start, tree, loop, robust, settings)
    freedom = np.full(2, settings.prior_freedom)
    for judged_anew in range(settings.rounds if loop.any() else 0):
        scaled = problem.scaled(factors[kinds])
        if judged_anew:
            poses, trust = _harden(scaled, poses, limit, robust, settings)
        known, squares = marginals(scaled, poses, np.maximum(trust, NO_TRUST)), scaled.squares(poses)
        before = factors
        factors, freedom = variance_factors(squares, known.redundancy, trust, kinds, before, settings.prior_freedom)
        if np.abs(np.log(factors / before)).max() < _FACTORS_CONVERGED:
            break
    scaled = problem.scaled(factors[kinds])
    known = marginals(scaled, poses, np.maximum(trust, NO_TRUST))
    return TrustedGraph(poses, trust, scaled.squares(poses), limit, factors, freedom, known)


def _limits(problem: GraphProblem, loop: NDArray[np.bool_], settings: TrustSettings) -> Array:
    """Return the largest squared Mahalanobis distance of an inlier, by edge. Shape (E,)."""
    limit = chi2_quantile(settings.loop_quantile, problem.size) * np.where(loop, 1.0, settings.adjacent_limit)
    return np.asarray(limit)


def _as_stated_or_drifted(
    problem: GraphProblem, start: Sim3, tree: Tree, loop: NDArray[np.bool_], robust: bool, settings: TrustSettings
) -> tuple[Sim3, Array, Array]:
    """Return poses, trust and variance factors with errors as stated; where too few edges are inliers that way, with
    the chain's drift as measured on the loops."""
    ones, limit = np.ones(len(loop)), _limits(problem, loop, settings)
    if not loop.any() or not robust:
        return problem.solve(start, ones, settings.iterations), ones, np.ones(2)
    poses, trust = _first(problem, start, tree, loop, limit, settings)
    chain = trust[~loop]
    enough = trust[loop].mean() >= settings.least_loops and (not len(chain) or chain.mean() >= settings.least_adjacent)
    drift = 1.0 if enough else drift_factor(problem, start, tree, loop, settings)
    if drift > 1.0:
        poses, trust = _first(problem.scaled(np.where(loop, 1.0, drift)), start, tree, loop, limit, settings)
    return poses, trust, np.array([drift, 1.0])


def _first(
    problem: GraphProblem,
    start: Sim3,
    tree: Tree,
    loop: NDArray[np.bool_],
    limit: Array,
    settings: TrustSettings,
) -> tuple[Sim3, Array]:
    """Anneal from all edges, from all with adjacent ones kept, and from the loops within the chain's possible drift;
    return the solution of least cost."""
    ones = np.ones(len(loop))
    within = ~loop
    within[loop] = chain_squares(problem, start, tree, loop) <= limit[loop]
    found = []
    kept = np.where(loop, limit, np.inf)
    for first, kernel in ((ones, limit), (ones, kept), (within.astype(np.float64), limit)):
        poses = start if first.all() else problem.solve(start, np.maximum(first, NO_TRUST), settings.iterations)
        poses, _ = _anneal(problem, poses, kernel, settings, gated=not first.all())
        poses, trust = _harden(problem, poses, limit, True, settings)
        cost = float(np.minimum(problem.squares(poses), limit).sum())
        found.append((cost, poses, trust))
        if trust.all():
            break
    return min(found, key=lambda f: f[0])[1:]


def _anneal(
    problem: GraphProblem, poses: Sim3, limit: Array, settings: TrustSettings, gated: bool
) -> tuple[Sim3, Array]:
    """Tighten the kernel in stages; from a gated start only the last stages."""
    worst = float((problem.squares(poses) / limit).max())
    mu = 2.0 if gated else max(2.0 * worst, 1.0)
    steps = settings.iterations // 4
    trust = (mu / (problem.squares(poses) / limit + mu)) ** 2 if gated else np.ones(len(limit))
    while True:
        poses = problem.solve(poses, np.maximum(trust, NO_TRUST), steps, _ROUGHLY)
        share = problem.squares(poses) / limit
        trust = (mu / (share + mu)) ** 2
        if mu == 1.0:
            return poses, trust
        mu = max(1.0, min(mu / settings.anneal_step, 2.0 * float(share.max())))


def _harden(
    problem: GraphProblem, poses: Sim3, limit: Array, robust: bool, settings: TrustSettings
) -> tuple[Sim3, Array]:
    """Solve with the edges inside their limits alone, until that set no longer changes."""
    inside = problem.squares(poses) <= limit if robust else np.ones(len(limit), bool)
    seen: set[bytes] = set()
    while True:
        poses = problem.solve(poses, np.where(inside, 1.0, NO_TRUST), settings.iterations, _CLOSELY)
        seen.add(inside.tobytes())
        after = problem.squares(poses) <= limit if robust else inside
        if after.tobytes() in seen or len(seen) == 6:
            return poses, inside.astype(np.float64)
        inside = after


# -------------------------------------------------------------------------------------------------- the chain


def drift_factor(
    problem: GraphProblem, start: Sim3, tree: Tree, loop: NDArray[np.bool_], settings: TrustSettings
) -> float:
    """Estimate the chain's drift over its stated one (squared, at least 1): the median over loops.

    Up to half of the loops may be false.
    """
    ratio = chain_squares(problem, start, tree, loop) / chi2_quantile(0.5, problem.size)
    pooled = np.concatenate([ratio, np.ones(settings.prior_loops)])
    return float(np.clip(np.median(pooled), 1.0, settings.most_drift**2))


def chain_squares(problem: GraphProblem, start: Sim3, tree: Tree, loop: NDArray[np.bool_]) -> Array:
    """Return squared Mahalanobis distances of loops from the chain, by its uncertainty and their own. Shape (L,)."""
    d = problem.size
    world = adjoint(start)[:, :d, :d]
    # Covariances of edges in the world frame, summed from the root.
    own = np.linalg.inv(problem.information)
    total = np.zeros((len(tree.parent), d, d))
    for row in tree.order:
        k = tree.edge[row]
        if k >= 0:
            here = world[problem.u[k]]
            total[row] = total[tree.parent[row]] + here @ own[k] @ here.T
    u, v = problem.u[loop], problem.v[loop]
    meet = _common_ancestor(tree, u, v)
    back = np.linalg.inv(world[u])
    chain = back @ (total[u] + total[v] - 2 * total[meet]) @ np.swapaxes(back, 1, 2)
    e = problem.residuals(start)[loop]
    return np.asarray(np.einsum("ei,ei->e", e, np.linalg.solve(chain + own[loop], e[..., None])[..., 0]))


def _common_ancestor(tree: Tree, u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return row of the last common ancestor of pairs (binary lifting); a root where they are in different trees."""
    depth = np.zeros(len(tree.parent), np.int64)
    for row in tree.order:
        if tree.edge[row] >= 0:
            depth[row] = depth[tree.parent[row]] + 1
    jumps = [tree.parent]
    while len(jumps) <= int(depth.max(initial=0)).bit_length():
        jumps.append(jumps[-1][jumps[-1]])
    deep, other = np.where(depth[u] >= depth[v], u, v), np.where(depth[u] >= depth[v], v, u)
    for k in reversed(range(len(jumps))):
        far = depth[deep] - depth[other] >= 2**k
        deep = np.where(far, jumps[k][deep], deep)
    for k in reversed(range(len(jumps))):
        apart = jumps[k][deep] != jumps[k][other]
        deep, other = np.where(apart, jumps[k][deep], deep), np.where(apart, jumps[k][other], other)
    return np.where(deep == other, deep, tree.parent[deep])
