"""The loop over the points of surfaces that frames are asked about, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled
from list3r.memory.library.overlap.point_verdicts import FREE, MET, UNTOLD


@compiled
def tell(
    p: NDArray[np.float64],
    unit: float,
    depth: NDArray[np.float32],
    camera: tuple[float, float, float, float],
    slack: tuple[float, float, float],
    reach: tuple[float, float],
) -> NDArray[np.int8]:
    """Return what a depth image tells about points in the frame of its camera. Shape (N, 3) -> (N,).

    `depth` (h, w) and points are in units of which `unit` are a metre, `camera` is fx, fy, cx, cy. A surface may lie
    off by `slack`: metres, metres for the square of one of depth, and a share of depth; `reach` are the nearest and the
    farthest depth that tell. A pixel speaks together with its eight neighbours.
    """
    out = np.zeros(len(p), np.int8)
    fx, fy, cx, cy = camera
    height, width = depth.shape
    for n in range(len(p)):
        z = p[n, 2] / unit
        if not reach[0] < z < reach[1]:
            continue
        column, row = np.rint(p[n, 0] / p[n, 2] * fx + cx), np.rint(p[n, 1] / p[n, 2] * fy + cy)
        if 1 <= column < width - 1 and 1 <= row < height - 1:
            out[n] = _verdict(
                depth, int(row), int(column), np.float32(unit), z, slack[0] + slack[1] * z**2 + slack[2] * z
            )
    return out


@compiled
def _verdict(depth: NDArray[np.float32], row: int, column: int, metre: np.float32, z: float, slack: float) -> int:
    """Return what a pixel and its neighbours tell about a surface at depth z, metres."""
    met, known, free = False, 0, True
    for k in range(9):
        there = depth[row + k // 3 - 1, column + k % 3 - 1] / metre
        met |= abs(there - z) <= slack
        if there > 0:
            known += 1
            free &= there > z + slack
    return MET if met else FREE if free and known >= 6 else UNTOLD
