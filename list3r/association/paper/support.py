"""Instance-aware merging as in the paper (sections 3.2, A.3 and A.4).

All confident pairs give a first transformation; instances with a large delta(o) are removed; from the rest the support
is sampled by confidence and coverage, and aligned with confidences as weights. The paper gives no number for "large",
for the cells or for the size of the sample; those here are ours, and marked so.
"""

from __future__ import annotations

import numpy as np

from list3r.association.overlap.balance import BalancedSupport
from list3r.association.overlap.inconsistency import displacement
from list3r.association.overlap.regions import EdgeSupportSettings, confident
from list3r.association.overlap.shared_points import Pairs
from list3r.association.overlap.support import StaticSupport
from list3r.association.paper.plain_alignment import plain_align
from list3r.frames.base import Camera
from list3r.memory.core.errors import DegenerateError

LARGE = 3.0
"""An instance leaves when its delta(o) is larger than so many times the median of all instances'."""
CELLS = 16
"""Cells of space across the spread of the points, for coverage."""
SAMPLE = 6000
"""Most pairs that are aligned."""


def without_large_delta(pairs: Pairs, camera: Camera, regions: EdgeSupportSettings) -> StaticSupport:
    """Leave out the instances with a large delta(o), by the masks of u. Raises `DegenerateError`."""
    sure = confident(pairs, regions)
    if not sure.any():
        raise DegenerateError("no shared point has enough confidence in both chunks")
    none = np.zeros(len(pairs), bool)
    T_uv = plain_align(pairs.p_u[sure], pairs.p_v[sure], pairs.weight[sure], pairs.frame[sure], metric=False).S_v_u
    off_px = displacement(pairs, T_uv, camera, sure, none).delta_px
    ids, of_pair, count = np.unique(pairs.instance_u[sure], return_inverse=True, return_counts=True)
    delta = np.bincount(of_pair.ravel(), off_px[sure]) / count
    judged = (ids >= 0) & (count >= regions.least_region_pairs)
    limit = max(LARGE * float(np.median(delta[judged])), regions.least_pixels * camera.width) if judged.any() else 0.0
    large = frozenset(ids[judged & (delta > limit)].tolist())
    nobody: frozenset[int] = frozenset()
    return StaticSupport(
        S_v_u=T_uv,
        confident=sure,
        removed=np.isin(pairs.instance_u, list(large)),
        left_out_u=large,
        left_out_v=nobody,
        moving_u=nobody,
        moving_v=nobody,
        delta_max_px=float(delta[judged & (delta <= limit)].max(initial=0.0)),
    )


def sampled(pairs: Pairs, static: StaticSupport, most: int = SAMPLE) -> BalancedSupport:
    """Sample by confidence and coverage: the surest pairs of every cell of space and every instance in turn."""
    left = np.flatnonzero(static.confident & ~static.removed)
    rank = coverage_turn(pairs.p_v[left], pairs.instance_u[left], pairs.weight[left], CELLS)
    rows = np.sort(left[np.argsort(rank, kind="stable")[:most]])
    used = np.zeros(len(pairs), bool)
    used[rows] = True
    return BalancedSupport(pairs.p_u[rows], pairs.p_v[rows], pairs.weight[rows], pairs.frame[rows], used)


def coverage_turn(points: np.ndarray, instance: np.ndarray, weight: np.ndarray, cells: int) -> np.ndarray:
    """Return the turn at which each point is taken, 0 the first: in each cell of each instance the surest one first.

    Shapes (N, 3), (N,), (N,) to (N,).
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    side = max(float(np.linalg.norm(high - low)), 1e-300) / cells
    cell = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
    _, group = np.unique(np.column_stack([cell, instance]), axis=0, return_inverse=True)
    group = group.ravel()
    order = np.lexsort((-weight, group))
    first = np.flatnonzero(np.diff(group[order], prepend=-1))
    turn = np.empty(len(points), np.int64)
    turn[order] = np.arange(len(points)) - np.repeat(first, np.diff([*first, len(points)]))
    return turn
