"""Instance-aware merging as in the paper (sections 3.2, A.3 and A.4), for a row of `benchmarks/association.py`.

All confident pairs give a first transformation; instances with a large delta(o) are removed; from the rest the support
is sampled by confidence and coverage, and aligned with confidences as weights. The paper gives no number for "large",
for the cells or for the size of the sample; those here are ours, and marked so.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np

from benchmarks.peers.plain_alignment import plain_align, plain_support
from list3r.association.overlap.alignment import Alignment
from list3r.association.overlap.balance import BalancedSupport, balanced_support
from list3r.association.overlap.inconsistency import displacement
from list3r.association.overlap.overlap_edge import EdgeSettings
from list3r.association.overlap.regions import EdgeSupportSettings, Mask, confident
from list3r.association.overlap.shared_points import Pairs
from list3r.association.overlap.support import Fit, StaticSupport, static_support
from list3r.frames.base import Camera
from list3r.memory.core.errors import DegenerateError

SIGMA_R = 0.02
"""Of the confidence m_uv, as a share of the spread of the points; the paper gives none."""


@dataclass(frozen=True)
class PaperSupportSettings(EdgeSupportSettings):
    """Settings under which edges are measured as the paper writes it."""

    large: float = 3.0
    """An instance leaves when its delta(o) is larger than so many times the median of all instances' ..."""
    cells: int = 16
    """Cells of space across the spread of the points, for coverage."""
    sample: int = 6000
    """Most pairs that are aligned."""


@contextmanager
def paper_merging() -> Iterator[None]:
    """Let edges with `PaperSupportSettings` be measured as the paper writes it, and all others as they are."""
    edges = "list3r.association.overlap.overlap_edge"
    with ExitStack() as stack:
        for name, function in (("static_support", _static), ("balanced_support", _sampled), ("align_support", _align)):
            stack.enter_context(patch(f"{edges}.{name}", function))
        yield


def without_large_delta(pairs: Pairs, camera: Camera, settings: PaperSupportSettings) -> StaticSupport:
    """Leave out the instances with a large delta(o), by the masks of u. Raises `DegenerateError`."""
    sure = confident(pairs, settings)
    if not sure.any():
        raise DegenerateError("no shared point has enough confidence in both chunks")
    none = np.zeros(len(pairs), bool)
    T_uv = plain_align(
        pairs.p_u[sure], pairs.p_v[sure], pairs.weight[sure], pairs.frame[sure], metric=False, residual_scale=SIGMA_R
    ).S_v_u
    off_px = displacement(pairs, T_uv, camera, sure, none).delta_px
    ids, of_pair, count = np.unique(pairs.instance_u[sure], return_inverse=True, return_counts=True)
    delta = np.bincount(of_pair.ravel(), off_px[sure]) / count
    judged = (ids >= 0) & (count >= settings.least_region_pairs)
    limit = (
        max(settings.large * float(np.median(delta[judged])), settings.least_pixels * camera.width)
        if judged.any()
        else 0.0
    )
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


def sampled(pairs: Pairs, static: StaticSupport, settings: PaperSupportSettings) -> BalancedSupport:
    """Sample by confidence and coverage: the surest pairs of every cell of space and every instance in turn."""
    left = np.flatnonzero(static.confident & ~static.removed)
    rank = coverage_turn(pairs.p_v[left], pairs.instance_u[left], pairs.weight[left], settings.cells)
    rows = np.sort(left[np.argsort(rank, kind="stable")[: settings.sample]])
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


def _static(
    pairs: Pairs, camera: Camera, fit: Fit, settings: EdgeSupportSettings, known: Mask | None = None
) -> StaticSupport:
    if isinstance(settings, PaperSupportSettings):
        return without_large_delta(pairs, camera, settings)
    return static_support(pairs, camera, fit, settings, known)


def _sampled(pairs: Pairs, static: StaticSupport, camera: Camera, settings: EdgeSupportSettings) -> BalancedSupport:
    if isinstance(settings, PaperSupportSettings):
        return sampled(pairs, static, settings)
    return balanced_support(pairs, static, camera, settings)


def _align(support: BalancedSupport, metric: bool, settings: EdgeSettings) -> Alignment:
    if isinstance(settings.support, PaperSupportSettings):
        s = support
        return plain_align(s.p_u, s.p_v, s.weight, s.frame, metric, SIGMA_R)
    return plain_support(support, metric, settings)
