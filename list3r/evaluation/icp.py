"""Registration of an estimated cloud to the true one by its surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from list3r.evaluation.cloud import Array
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3


@dataclass(frozen=True)
class IcpSettings:
    """How clouds are registered."""

    reach_m: float = 0.3
    """Greatest distance of matched points in the first round; it shrinks to `least_reach_m`."""
    least_reach_m: float = 0.05
    shrink: float = 0.85
    """Factor on that distance from round to round."""
    least_stiffness: float = 1e-5
    """Least eigenvalue of the motion's information, as a share of the greatest: below, the surfaces leave it open."""
    rounds: int = 60
    """Most rounds."""
    points: int = 20_000
    """Points of the estimate that are matched."""
    least_share: float = 0.1
    """Least share of them that must have a partner within reach."""


def register(
    truth: ArrayLike, truth_normals: ArrayLike, estimate: ArrayLike, *, with_scale: bool, settings: IcpSettings
) -> Sim3:
    """Return S_truth_estimate by point-to-plane ICP (Chen and Medioni 1992), for clouds (M, 3), (N, 3) that nearly are
    right.

    Raises `DegenerateError` when too few points have a partner, and when the surfaces leave a motion open.
    """
    q, n, p = (np.asarray(v, dtype=np.float64) for v in (truth, truth_normals, estimate))
    if len(p) > settings.points:
        p = p[np.sort(np.random.default_rng(0).choice(len(p), settings.points, replace=False))]
    tree = cKDTree(q, balanced_tree=False)
    S = Sim3.identity()
    reach = settings.reach_m
    for _ in range(settings.rounds):
        moved = S.apply(p)
        nearest = tree.query(moved, distance_upper_bound=reach, workers=-1)
        distance, row = np.asarray(nearest[0]), np.asarray(nearest[1])
        near = np.isfinite(distance)
        if near.sum() < max(10, settings.least_share * len(p)):
            raise DegenerateError(
                f"{near.sum()} of {len(p)} points are within {reach:.2f} m of the truth: ICP needs nearly "
                "aligned clouds; align by --align TRAJECTORY first"
            )
        step = _step(moved[near], q[row[near]], n[row[near]], reach, with_scale, settings.least_stiffness)
        S = step @ S
        still = float(np.abs(step.log()).max()) < 1e-6
        if still and reach <= settings.least_reach_m:
            break
        reach = max(settings.least_reach_m, reach * settings.shrink)
    return S


def _step(moved: Array, target: Array, normal: Array, reach: float, with_scale: bool, least_stiffness: float) -> Sim3:
    """Return one Gauss-Newton step on distances to planes under Tukey's weights."""
    middle = moved.mean(axis=0)
    arm = moved - middle
    columns = [normal, np.cross(arm, normal)]
    if with_scale:
        columns.append(np.einsum("nk,nk->n", arm, normal)[:, None])
    jacobian = np.concatenate(columns, axis=1)
    residual = np.einsum("nk,nk->n", normal, moved - target)
    weight = np.clip(1 - (residual / reach) ** 2, 0, None) ** 2
    hessian = (weight[:, None] * jacobian).T @ jacobian
    extent = max(float(np.sqrt((arm**2).sum(axis=1).mean())), 1e-9)
    units = np.array([1.0] * 3 + [extent] * (jacobian.shape[1] - 3))
    scaled = hessian / np.outer(units, units)
    values = np.linalg.eigvalsh(scaled)
    if values[0] < least_stiffness * values[-1]:
        raise DegenerateError(
            "the surfaces leave a motion undetermined (one plane, or a tube): ICP cannot align these clouds"
        )
    x = np.zeros(7)
    x[: jacobian.shape[1]] = -np.linalg.solve(hessian, jacobian.T @ (weight * residual))
    about = Sim3(np.ones(()), np.eye(3), middle)
    return about @ Sim3.exp(x) @ about.inverse()
