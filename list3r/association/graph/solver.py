"""Levenberg-Marquardt on a graph of similarities, with sparse normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.graph.block_cholesky import BlockFactor, BlockPattern, NotPositiveError
from list3r.memory.core.geometry import Sim3, skew, take

Array = NDArray[np.float64]

_CONVERGED = 1e-12
"""Relative gain of a step at which the cost has converged."""
_TOGETHER = 256
"""Edges whose derivatives are in memory at once."""


@dataclass(frozen=True)
class GraphProblem:
    """K chunks and E edges, as arrays: minimise the sum of e^T W e, e = log(S_u_v S_world_v^-1 S_world_u)."""

    u: NDArray[np.int64]
    """Row of each edge's chunk u. Shape (E,)."""
    v: NDArray[np.int64]
    """Row of each edge's chunk v. Shape (E,)."""
    S_u_v: Sim3
    """Inverses of the measured S_v_u. Shape (E,)."""
    information: Array
    """W, of the tangent error in u's units. Shape (E, D, D), D = 6 for rigid graphs, else 7."""
    fixed: NDArray[np.bool_]
    """True for the first chunk of each component. Shape (K,)."""
    turned: Array
    """Adjoints of S_u_v. Shape (E, D, D)."""
    free: NDArray[np.int64]
    """Number of each chunk among those that are not fixed, -1 for fixed ones. Shape (K,)."""
    inner: NDArray[np.bool_]
    """True for edges between two chunks that are not fixed. Shape (E,)."""
    pattern: BlockPattern

    @staticmethod
    def build(
        u: NDArray[np.int64], v: NDArray[np.int64], S_v_u: Sim3, information: Array, fixed: NDArray[np.bool_]
    ) -> GraphProblem:
        """Lay out a graph."""
        S_u_v, size = S_v_u.inverse(), information.shape[1]
        free = np.where(fixed, -1, np.cumsum(~fixed) - 1)
        inner = (free[u] >= 0) & (free[v] >= 0)
        pattern = BlockPattern.analyse(int((~fixed).sum()), free[u][inner], free[v][inner], size)
        return GraphProblem(u, v, S_u_v, information, fixed, adjoint(S_u_v)[:, :size, :size], free, inner, pattern)

    @property
    def size(self) -> int:
        """Degrees of freedom of a chunk, D."""
        return int(self.information.shape[1])

    def scaled(self, factors: Array) -> GraphProblem:
        """Return the same graph with variances larger by factors. Shape (E,)."""
        return replace(self, information=self.information / factors[:, None, None])

    def residuals(self, poses: Sim3) -> Array:
        """Return the tangent error of each edge. Shape (E, D)."""
        apart = self.S_u_v @ take(poses, self.v).inverse() @ take(poses, self.u)
        return np.asarray(apart.log()[:, : self.size])

    def squares(self, poses: Sim3) -> Array:
        """Return e^T W e of each edge. Shape (E,)."""
        e = self.residuals(poses)
        return np.asarray(np.einsum("ei,eij,ej->e", e, self.information, e, optimize=True))

    def solve(self, poses: Sim3, trust: Array, iterations: int, tolerance: float = _CONVERGED) -> Sim3:
        """Return the poses that minimise the sum of trust e^T W e, by damped Gauss-Newton from `poses`, until a step
        gains less than a share `tolerance` of the cost. Shape of trust (E,)."""
        if len(self.u) == 0 or not (~self.fixed).any():
            return poses
        damping = 0.0
        e = self.residuals(poses)
        cost = self._cost(e, trust)
        system = None
        for _ in range(iterations):
            system = system or self._normal_equations(e, trust)
            tried = self._step(poses, system, damping)
            new = None if tried is None else self.residuals(tried)
            new_cost = np.inf if new is None else self._cost(new, trust)
            if tried is None or new is None or not new_cost <= cost * (1 + _CONVERGED):
                damping = max(damping * 10.0, 1e-6)
                if damping > 1e6:
                    break
                continue
            gain, poses, cost, e, system = cost - new_cost, tried, new_cost, new, None
            damping = 0.0 if damping <= 1e-6 else damping / 10.0
            if gain <= tolerance * cost + 1e-18:
                break
        return poses

    def factor(self, poses: Sim3, trust: Array) -> BlockFactor:
        """Return the factor of the information matrix of all chunks that are not fixed. Raises `NotPositiveError`."""
        diagonal, off, _ = self._normal_equations(self.residuals(poses), trust)
        return BlockFactor.of(self.pattern, diagonal, off)

    def _cost(self, e: Array, trust: Array) -> float:
        return float(trust @ np.einsum("ei,eij,ej->e", e, self.information, e, optimize=True))

    def _step(self, poses: Sim3, system: tuple[Array, Array, Array], damping: float) -> Sim3 | None:
        diagonal, off, gradient = system
        if damping > 0.0:
            diagonal = diagonal + damping * diagonal * np.eye(self.size)
        try:
            step = BlockFactor.of(self.pattern, diagonal, off).solve(-gradient)
        except NotPositiveError:
            return None
        full = np.zeros((len(self.fixed), 7))
        full[~self.fixed, : self.size] = step
        return poses @ Sim3.exp(full)

    def _normal_equations(self, e: Array, trust: Array) -> tuple[Array, Array, Array]:
        """Return diagonal blocks, off-diagonal blocks of the inner edges, and the gradient, for right-hand steps."""
        d, count = self.size, self.pattern.count
        diagonal, gradient = np.zeros((count, d, d)), np.zeros((count, d))
        off = np.empty((len(e), d, d))
        for start in range(0, len(e), _TOGETHER):
            some = slice(start, start + _TOGETHER)
            to_u, to_v = self.jacobians(e, some)
            information = self.information[some] * trust[some, None, None]
            for chunk, to in ((self.u[some], to_u), (self.v[some], to_v)):
                here = self.free[chunk]
                moving = here >= 0
                weighted = information @ to
                diagonal += _gathered(here[moving], (np.swapaxes(to, 1, 2) @ weighted)[moving], count)
                gradient += _gathered(here[moving], np.einsum("eji,ej->ei", weighted, e[some])[moving], count)
            off[some] = np.swapaxes(to_u, 1, 2) @ weighted
        return diagonal, off[self.inner], gradient

    def jacobians(self, e: Array, some: slice = slice(None)) -> tuple[Array, Array]:
        """Return derivatives of the errors of some edges by right-hand steps of u and of v. Shapes (S, D, D).

        The inverse Jacobian of log is the Bernoulli series I + ad/2 + ad^2/12 - ad^4/720 + ad^6/30240, good to 1e-7
        for turns up to one radian.
        """
        ad = _ad(e[some])
        square = ad @ ad
        even = np.eye(self.size) + square / 12.0
        if len(e) and np.abs(e[:, 3:]).max() > 0.1:
            fourth = square @ square
            even += square @ fourth / 30240.0 - fourth / 720.0
        return even + 0.5 * ad, -(even - 0.5 * ad) @ self.turned[some]


def unstack(poses: Sim3, names: Sequence[int]) -> dict[int, Sim3]:
    """Return one similarity for each name."""
    return {n: Sim3(poses.scale[k], poses.rotation[k], poses.translation[k]) for k, n in enumerate(names)}


def adjoint(S: Sim3) -> Array:
    """Return matrices with S exp(x) S^-1 = exp(Ad x), tangents (rho, omega, sigma). Shape (E, 7, 7)."""
    out = np.zeros((*S.scale.shape, 7, 7))
    out[..., :3, :3] = S.scale[..., None, None] * S.rotation
    out[..., :3, 3:6] = skew(S.translation) @ S.rotation
    out[..., :3, 6] = -S.translation
    out[..., 3:6, 3:6] = S.rotation
    out[..., 6, 6] = 1.0
    return out


def _ad(e: Array) -> Array:
    """Return the adjoint's derivative: ad(e) x = [e, x]. Shape (E, D) -> (E, D, D), D = 6 or 7."""
    size = e.shape[1]
    out = np.zeros((len(e), size, size))
    out[:, :3, :3] = skew(e[:, 3:6])
    out[:, :3, 3:6] = skew(e[:, :3])
    out[:, 3:6, 3:6] = skew(e[:, 3:6])
    if size == 7:
        out[:, :3, :3] += e[:, 6, None, None] * np.eye(3)
        out[:, :3, 6] = -e[:, :3]
    return out


def _gathered(where: NDArray[np.int64], values: Array, count: int) -> Array:
    """Return sums of rows by number. Shape (N, ...) -> (count, ...)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    order = np.argsort(where, kind="stable")
    out = np.zeros((count, flat.shape[1]))
    if len(order):
        starts = np.flatnonzero(np.diff(where[order], prepend=-1))
        out[where[order][starts]] = np.add.reduceat(flat[order], starts, axis=0)
    return out.reshape(count, *values.shape[1:])
