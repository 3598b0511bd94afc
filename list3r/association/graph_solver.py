"""Levenberg-Marquardt on a graph of similarities, with sparse normal equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import splu

from list3r.memory.geometry import Sim3, skew
from list3r.memory.records import Edge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GraphProblem:
    """K chunks and E edges, as arrays."""

    u: NDArray[np.int64]
    """Row of each edge's chunk u. Shape (E,)."""
    v: NDArray[np.int64]
    """Row of each edge's chunk v. Shape (E,)."""
    S_u_v: Sim3
    """Inverses of the measured S_v_u. Shape (E,)."""
    weight: Array
    """Shape (E,)."""
    fixed: NDArray[np.bool_]
    """True for the first chunk of each component. Shape (K,)."""
    ids: tuple[int, ...]
    unit: Array
    """Divisor of each tangent component: the lever for translations, 1 for angles and log scale. Shape (D,)."""

    @staticmethod
    def build(
        ids: Sequence[int],
        edges: Sequence[Edge],
        component: Mapping[int, int],
        weight: Array,
        metric: bool,
        lever: float,
    ) -> GraphProblem:
        """Lay out a graph; rigid (D = 6) when `metric`, else D = 7."""
        row = {chunk: k for k, chunk in enumerate(ids)}
        return GraphProblem(
            u=np.array([row[e.u] for e in edges], np.int64),
            v=np.array([row[e.v] for e in edges], np.int64),
            S_u_v=_stack([e.S_v_u for e in edges]).inverse(),
            weight=weight,
            fixed=np.array([component[chunk] == chunk for chunk in ids]),
            ids=tuple(ids),
            unit=np.array([lever] * 3 + [1.0] * (3 if metric else 4)),
        )

    def stack(self, poses: Mapping[int, Sim3]) -> Sim3:
        """Poses in order of chunk id, batched."""
        return _stack([poses[chunk] for chunk in self.ids])

    def unstack(self, poses: Sim3) -> list[Sim3]:
        """One similarity for each chunk."""
        return [Sim3(poses.scale[k], poses.rotation[k], poses.translation[k]) for k in range(len(self.ids))]

    def norms(self, poses: Sim3 | Sequence[Sim3]) -> Array:
        """Length of each edge's residual, in levers. Shape (E,)."""
        batch = poses if isinstance(poses, Sim3) else _stack(poses)
        return np.asarray(np.linalg.norm(self._residuals(batch), axis=1))

    def solve(self, poses: Sim3, trust: Array, iterations: int) -> Sim3:
        """Poses that minimise the weighted squares, by damped Gauss-Newton from `poses`."""
        weight = self.weight * trust
        damping, cost = 1e-6, self._cost(poses, weight)
        for _ in range(iterations):
            information, gradient = self._normal_equations(poses, weight)
            step = splu((information + diags(damping * information.diagonal() + 1e-12)).tocsc()).solve(-gradient)
            tried = self._moved(poses, step.reshape(len(self.ids), -1))
            new_cost = self._cost(tried, weight)
            if new_cost > cost * (1 + 1e-12):
                damping *= 10.0
                if damping > 1e6:
                    break
                continue
            gain, poses, cost, damping = cost - new_cost, tried, new_cost, max(damping / 10.0, 1e-9)
            if gain <= 1e-10 * cost + 1e-18:
                break
        return poses

    def _residuals(self, poses: Sim3) -> Array:
        apart = self.S_u_v @ _take(poses, self.v).inverse() @ _take(poses, self.u)
        return np.asarray(apart.log()[:, : len(self.unit)] / self.unit)

    def _cost(self, poses: Sim3, weight: Array) -> float:
        return float((weight[:, None] * self._residuals(poses) ** 2).sum())

    def _moved(self, poses: Sim3, step: Array) -> Sim3:
        full = np.zeros((len(step), 7))
        full[:, : step.shape[1]] = step
        full[self.fixed] = 0.0
        return poses @ Sim3.exp(full)

    def _normal_equations(self, poses: Sim3, weight: Array) -> tuple[csc_matrix, Array]:
        """For right-hand steps; the inverse Jacobians of log are taken to first order, I +- ad(e)/2."""
        d = len(self.unit)
        residual = self._residuals(poses)
        e = np.zeros((len(residual), 7))
        e[:, :d] = residual * self.unit
        half = 0.5 * _ad(e)
        to_u = (np.eye(7) + half)[:, :d, :d] / self.unit[:, None]
        to_v = -((np.eye(7) - half) @ _adjoint(self.S_u_v))[:, :d, :d] / self.unit[:, None]
        blocks = [(self.u, to_u), (self.v, to_v)]
        count = len(self.ids) * d
        gradient = np.zeros((len(self.ids), d))
        rows, columns, values = [], [], []
        for a, Ja in blocks:
            weighted = Ja * weight[:, None, None]
            np.add.at(gradient, a, np.einsum("eij,ei->ej", weighted, residual))
            for b, Jb in blocks:
                rows.append((a[:, None, None] * d + np.arange(d)[None, :, None]).repeat(d, axis=2))
                columns.append((b[:, None, None] * d + np.arange(d)[None, None, :]).repeat(d, axis=1))
                values.append(np.einsum("eij,eik->ejk", weighted, Jb))
        information = coo_matrix(
            (np.concatenate(values).ravel(), (np.concatenate(rows).ravel(), np.concatenate(columns).ravel())),
            shape=(count, count),
        ).tocsc()
        held = np.repeat(self.fixed, d).astype(np.float64)
        gradient[self.fixed] = 0.0
        return information + diags(held * 1e9), gradient.ravel()


def _stack(poses: Sequence[Sim3]) -> Sim3:
    return Sim3(
        np.array([float(p.scale) for p in poses]),
        np.stack([p.rotation for p in poses]),
        np.stack([p.translation for p in poses]),
    )


def _take(poses: Sim3, rows: NDArray[np.int64]) -> Sim3:
    return Sim3(poses.scale[rows], poses.rotation[rows], poses.translation[rows])


def _adjoint(S: Sim3) -> Array:
    """Matrices with S exp(x) S^-1 = exp(Ad x), tangents (rho, omega, sigma). Shape (E, 7, 7)."""
    out = np.zeros((len(S.scale), 7, 7))
    out[:, :3, :3] = S.scale[:, None, None] * S.rotation
    out[:, :3, 3:6] = skew(S.translation) @ S.rotation
    out[:, :3, 6] = -S.translation
    out[:, 3:6, 3:6] = S.rotation
    out[:, 6, 6] = 1.0
    return out


def _ad(e: Array) -> Array:
    """The adjoint's derivative: ad(e) x = [e, x]. Shape (E, 7) -> (E, 7, 7)."""
    out = np.zeros((len(e), 7, 7))
    out[:, :3, :3] = skew(e[:, 3:6]) + e[:, 6, None, None] * np.eye(3)
    out[:, :3, 3:6] = skew(e[:, :3])
    out[:, :3, 6] = -e[:, :3]
    out[:, 3:6, 3:6] = skew(e[:, 3:6])
    return out
