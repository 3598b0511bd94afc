"""Run-length codes of masks: alternating lengths of background and foreground along the rows, background first."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FULL_SIDE_PX = 96.0
"""A mask whose area has at least this side shows an instance as well as a larger one."""


def shown_surface(
    visible_fraction: ArrayLike, area_px: ArrayLike, full_side_px: float = FULL_SIDE_PX
) -> NDArray[np.float64]:
    """Return how much of an instance's surface pictures show, in [0, 1]; less, linearly in its side, where it is small.

    `visible_fraction` is the share of its surface that is seen, `area_px` the area of its mask. Shapes broadcast.
    """
    side = np.sqrt(np.asarray(area_px, np.float64)) / full_side_px
    return np.asarray(np.asarray(visible_fraction, np.float64) * np.minimum(1.0, side))


def encode_mask(mask: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Run lengths of a mask, row by row. Shape (H, W) -> (R,)."""
    flat = np.concatenate([[False], mask.ravel(), [False]])
    edges = np.flatnonzero(flat[1:] != flat[:-1])
    bounds = np.concatenate([[0], edges, [mask.size]])
    runs = np.diff(bounds)
    return (runs[:-1] if len(runs) % 2 and runs[-1] == 0 else runs).astype(np.uint32)


def decode_mask(runs: NDArray[np.uint32], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask of run lengths. Shape (R,) -> (H, W). Raises `ValueError` when the runs do not fill the shape."""
    if int(runs.astype(np.uint64).sum()) > shape[0] * shape[1]:
        raise ValueError(f"runs of {int(runs.sum())} pixels do not fit a mask of {shape[1]}x{shape[0]}")
    flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    out = np.zeros(shape[0] * shape[1], dtype=bool)
    out[: len(flat)] = flat
    return out.reshape(shape)
