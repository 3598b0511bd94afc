"""Errors of a reconstructed cloud: accuracy, completeness, Chamfer distance, normal consistency, F-score."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import JsonFields

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CloudErrors(JsonFields):
    """How a cloud differs from the truth, both in one frame of reference and in metres."""

    accuracy_cm: float
    """Mean distance from the estimate's points to the truth."""
    accuracy_median_cm: float
    completeness_cm: float
    """Mean distance from the truth's points to the estimate."""
    completeness_median_cm: float
    chamfer_cm: float
    """Mean of accuracy and completeness, as in the paper's tables."""
    normal_consistency: float | None
    """Mean |cosine| between normals of nearest points, both ways, in [0, 1]; None without normals."""
    threshold_cm: float
    precision: float
    """Share of the estimate's points within the threshold of the truth."""
    recall: float
    """Share of the truth's points within the threshold of the estimate."""
    f_score: float
    """Harmonic mean of the two (Knapitsch et al., "Tanks and temples", 2017)."""


@dataclass(frozen=True)
class CloudDistances:
    """From every point of one cloud to the nearest of the other, metres."""

    to_truth: Array
    """Of the estimate's points (N,)."""
    nearest_truth: NDArray[np.int64]
    """Row of the truth's point. Shape (N,)."""
    to_estimate: Array
    """Of the truth's points (M,)."""
    nearest_estimate: NDArray[np.int64]
    """Row of the estimate's point. Shape (M,)."""


def evaluate_cloud(
    truth: ArrayLike,
    estimate: ArrayLike,
    normals: tuple[ArrayLike | None, ArrayLike | None] = (None, None),
    threshold_m: float = 0.05,
    truncate_m: float | None = None,
    distances: CloudDistances | None = None,
) -> CloudErrors:
    """Compare two clouds (M, 3) and (N, 3) of one coordinate frame, metres.

    `normals` are unit normals of the truth (M, 3) and of the estimate (N, 3); None where unknown.

    `truncate_m` caps single distances, where parts of the truth were never in view; None leaves them. `distances` are
    the results of `cloud_distances` if computed already. Raises `OptionError` for an empty cloud, points that are not
    finite and a threshold that is no length.
    """
    a, b = _points(truth, "truth"), _points(estimate, "estimate")
    if not threshold_m > 0 or not (truncate_m is None or truncate_m > 0):
        raise OptionError(f"threshold {threshold_m} m, greatest distance {truncate_m} m: both must be above 0")
    found = distances or cloud_distances(a, b)
    to_truth, to_estimate = found.to_truth, found.to_estimate
    precision, recall = float(np.mean(to_truth <= threshold_m)), float(np.mean(to_estimate <= threshold_m))
    if truncate_m is not None:
        to_truth, to_estimate = np.minimum(to_truth, truncate_m), np.minimum(to_estimate, truncate_m)
    consistency = None
    if normals[0] is not None and normals[1] is not None:
        n, m = (np.asarray(side, dtype=np.float64) for side in normals)
        if n.shape != a.shape or m.shape != b.shape:
            raise OptionError(f"normals of shape {n.shape} and {m.shape} for points of shape {a.shape} and {b.shape}")
        there = np.abs(np.einsum("nk,nk->n", n[found.nearest_truth], m)).mean()
        back = np.abs(np.einsum("nk,nk->n", n, m[found.nearest_estimate])).mean()
        consistency = float((there + back) / 2)
    return CloudErrors(
        accuracy_cm=100 * float(to_truth.mean()),
        accuracy_median_cm=100 * float(np.median(to_truth)),
        completeness_cm=100 * float(to_estimate.mean()),
        completeness_median_cm=100 * float(np.median(to_estimate)),
        chamfer_cm=50 * float(to_truth.mean() + to_estimate.mean()),
        normal_consistency=consistency,
        threshold_cm=100 * threshold_m,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
    )


def cloud_distances(truth: ArrayLike, estimate: ArrayLike) -> CloudDistances:
    """Return the nearest neighbours both ways of two clouds (M, 3) and (N, 3). Raises as `evaluate_cloud`."""
    a, b = _points(truth, "truth"), _points(estimate, "estimate")
    order_a, order_b = near_order(a), near_order(b)
    return CloudDistances(*_nearest(a, order_a, b, order_b), *_nearest(b, order_b, a, order_a))


def near_order(points: Array) -> NDArray[np.int64]:
    """Return rows in an order that keeps neighbours in space together. Shape (N,). Trees built and queried in that
    order use the processor's cache: three times as fast for a million points.
    """
    low = points.min(axis=0)
    cell = max(float(np.max(points.max(axis=0) - low)) / 200, 1e-12)
    x, y, z = np.minimum((points - low) / cell, 255).astype(np.int64).T
    return np.argsort((x * 256 + y) * 256 + z, kind="stable")


def _nearest(
    targets: Array, target_order: NDArray[np.int64], points: Array, order: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Return the distance to the nearest target of each point, and its row."""
    tree = cKDTree(targets[target_order], balanced_tree=False)
    near_distance, near_row = tree.query(points[order], workers=-1)
    distance, row = np.empty(len(points)), np.empty(len(points), dtype=np.int64)
    distance[order], row[order] = near_distance, target_order[near_row]
    return distance, row


def _points(points: ArrayLike, name: str) -> Array:
    p = np.asarray(points, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or len(p) == 0:
        raise OptionError(f"the {name} cloud has shape {p.shape}; expected (N, 3) with at least one point")
    if not np.isfinite(p).all():
        raise OptionError(f"the {name} cloud has points that are not finite; leave them out first")
    return p
