"""Align two dense reconstructions of the same frames: an entry for the point maps of any feed-forward model.

Errors of neighbouring pixels are correlated, so a few thousand well spread pixels suffice. They are read on a grid that
shifts from frame to frame; outliers of a first robust fit are removed; and each part of space gives an equal share of
the rest, so that a near wall does not outvote the room. Space is divided by the middle of the two points: by one side
alone, cells at the rim would prefer points moved outwards by noise, and the scale would grow.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.alignment import Alignment, AlignmentSettings, align, robust_start
from list3r.association.paper.support import coverage_turn
from list3r.memory.core.errors import DegenerateError
from list3r.memory.core.geometry import Sim3

Floats = NDArray[np.floating]

_LEVELS = 12
"""Levels of confidence at which the scatter is measured."""


@dataclass(frozen=True)
class PointMapSettings:
    """Which pixels of two point maps make the support."""

    candidates: int = 75_000
    """Pixels used, over all frames."""
    pairs: int = 25_000
    """Pixels that the alignment works on, at most."""
    least_confidence: float = 0.1
    """Least confidence of a pixel on both sides, in medians of that side."""
    gate: float = 6.0
    """A pixel is left out when the first fit leaves it more than so many median residuals."""
    cells: int = 16
    """Cells across the spread of the points, for even coverage."""
    align: AlignmentSettings = field(default_factory=AlignmentSettings)


def align_point_maps(
    points_u: Floats,
    confidence_u: Floats,
    points_v: Floats,
    confidence_v: Floats,
    metric: bool,
    settings: PointMapSettings | None = None,
) -> Alignment:
    """The similarity (rigid when `metric`) that takes point maps of u to those of v, which hold the same F frames.

    Points have shape (F, H, W, 3), each in the coordinates of its own reconstruction; confidences (F, H, W), larger is
    better, on any scale; a pixel whose confidence is not positive or whose point is not finite is left out. `residual`
    and `inside` of the result belong to the pixels that were chosen. Raises `DegenerateError`.
    """
    chosen = settings or PointMapSettings()
    assert points_u.shape == points_v.shape == (*confidence_u.shape, 3) and confidence_u.shape == confidence_v.shape
    p_u, p_v, c_u, c_v, group = _candidates(points_u, confidence_u, points_v, confidence_v, chosen.candidates)
    keep = np.isfinite(p_u).all(axis=1) & np.isfinite(p_v).all(axis=1)
    for c in (c_u, c_v):
        known = keep & np.isfinite(c) & (c > 0)
        if not known.any():
            raise DegenerateError("the point maps share no pixel that is finite and has a confidence above zero")
        keep &= known & (c >= chosen.least_confidence * np.median(c[known]))
    p_u, p_v, group = p_u[keep], p_v[keep], group[keep]
    weight = np.sqrt(c_u[keep] * c_v[keep])
    S_v_u = robust_start(p_u, p_v, weight, group, metric, chosen.align)
    middle = (S_v_u.apply(p_u) + p_v) / 2.0
    weight = _worth(S_v_u, p_u, p_v, weight)
    rank = coverage_turn(middle, np.zeros(len(middle), np.int64), weight, chosen.cells)
    rank[_contradicted(S_v_u, p_u, p_v, chosen.gate)] = len(rank)
    best = np.sort(np.argsort(rank, kind="stable")[: chosen.pairs])
    best = best[rank[best] < len(rank)]
    return align(p_u[best], p_v[best], weight[best], group[best], metric, chosen.align)


def _worth(
    S_v_u: Sim3, p_u: NDArray[np.float64], p_v: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weights by the calibrated confidence, on any scale: one over the variance at its level. Shape (N,)."""
    off = S_v_u.apply(p_u) - p_v
    square = np.einsum("ni,ni->n", off, off)
    parts = np.array_split(np.argsort(weight, kind="stable"), _LEVELS)
    middles = [float(np.median(weight[part])) for part in parts]
    variance = np.array([float(np.median(square[part])) for part in parts])
    if not variance.min() > 0:
        return weight
    return np.asarray(variance.min() / np.interp(weight, middles, variance))


def _candidates(
    points_u: Floats, confidence_u: Floats, points_v: Floats, confidence_v: Floats, most: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Points, confidences and frame of pixels on a grid that shifts from frame to frame."""
    frames, height, width = confidence_u.shape
    step = max(1, int(np.ceil(np.sqrt(frames * height * width / most))))
    out: list[list[NDArray[np.float64]]] = [[], [], [], []]
    counts = []
    for k in range(frames):
        rows, columns = slice((7 * k) % step, None, step), slice((3 * k) % step, None, step)
        for part, array in zip(out, (points_u, points_v, confidence_u, confidence_v), strict=True):
            taken = array[k, rows, columns]
            part.append(np.asarray(taken.reshape(-1, *taken.shape[2:]), np.float64))
        counts.append(len(out[0][-1]))
    p_u, p_v, c_u, c_v = (np.concatenate(part) for part in out)
    return p_u, p_v, c_u, c_v, np.repeat(np.arange(frames), counts)


def _contradicted(S_v_u: Sim3, p_u: NDArray[np.float64], p_v: NDArray[np.float64], gate: float) -> NDArray[np.bool_]:
    """Pixels that a first fit contradicts; they are apart, and equal shares of space would favour them. Shape (N,)."""
    off = S_v_u.apply(p_u) - p_v
    square = np.einsum("ni,ni->n", off, off)
    return np.asarray(square > gate**2 * np.median(square) + 1e-12 * np.median(np.einsum("ni,ni->n", p_v, p_v)))
