"""The loops of `reprojection`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled

Floats = NDArray[np.float32]


@compiled
def project(
    depth: Floats, slope: Floats, shift: Floats, straight: bool, height: int, width: int
) -> tuple[Floats, NDArray[np.int32]]:
    """Nearest depth at each pixel of a camera, 0 for none, and the source pixel it comes from, -1. Shapes (H, W).

    u = (slope[0] z + shift[0]) / (slope[2] z + shift[2]), likewise v; where `straight` the divisor is z. `depth` and
    the rows of `slope` have N source pixels.
    """
    out, origin = np.zeros((height, width), np.float32), np.full((height, width), -1, np.int32)
    one, half, none = np.float32(1), np.float32(0.5), np.float32(0)
    for k in range(len(depth)):
        z = depth[k]
        if not z > none:
            continue
        if straight:
            there, inverse = z, one / z
            u, v = slope[0, k] + shift[0] * inverse, slope[1, k] + shift[1] * inverse
        else:
            there = slope[2, k] * z + shift[2]
            if not there > none:
                continue
            inverse = one / there
            u, v = (slope[0, k] * z + shift[0]) * inverse, (slope[1, k] * z + shift[1]) * inverse
        u, v = u + half, v + half
        if u >= none and u < width and v >= none and v < height:
            row, column = int(v), int(u)
            before = out[row, column]
            if before == none or there < before:
                out[row, column], origin[row, column] = there, k
    return out, origin


@compiled
def close_gaps(out: Floats, origin: NDArray[np.int32], fine: Floats, jump: float, noise: float) -> Floats:
    """`out` with pixels filled that rounding missed, or where a far surface shows through such a gap in a near one.

    A pixel is filled from two opposite neighbours when the depth pixels these came from are themselves close
    neighbours on one surface, with depth known between them. A true hole or an edge is left as it is. `out` and
    `origin` are those of `project`, shape (H, W); `fine` is the depth image they come from, shape (h, w).
    """
    filled = out.copy()
    height, width = out.shape
    steep = np.float32(1 + 2 * jump)
    for row in range(height):
        for column in range(width):
            here = out[row, column]
            value = here
            if 0 < row < height - 1 and _is_gap(here, out[row - 1, column], out[row + 1, column], steep):
                one = _one_surface(origin[row - 1, column], origin[row + 1, column], fine, jump, noise)
                value = _between(value, out[row - 1, column], out[row + 1, column], one)
            if 0 < column < width - 1 and _is_gap(here, out[row, column - 1], out[row, column + 1], steep):
                one = _one_surface(origin[row, column - 1], origin[row, column + 1], fine, jump, noise)
                value = _between(value, out[row, column - 1], out[row, column + 1], one)
            filled[row, column] = value
    return filled


@compiled
def _is_gap(here: np.float32, before: np.float32, after: np.float32, steep: np.float32) -> bool:
    """Whether a pixel between two that are known is not, or lies far behind them."""
    return bool(before > 0 and after > 0 and (here == 0 or here > steep * max(before, after)))


@compiled
def _between(value: np.float32, before: np.float32, after: np.float32, one_surface: bool) -> np.float32:
    """The depth between two neighbours where that is nearer than what a pixel has, or it has none."""
    between = np.float32(0.5) * (before + after)
    return between if one_surface and (value == 0 or value > between) else value


@compiled
def _one_surface(a: int, b: int, fine: Floats, jump: float, noise: float) -> bool:
    """Whether two pixels of the depth image are at most three apart on one surface."""
    width = fine.shape[1]
    ay, ax, by, bx = a // width, a % width, b // width, b % width
    if abs(ay - by) > 3 or abs(ax - bx) > 3:
        return False
    middle = fine[(ay + by) // 2, (ax + bx) // 2]
    allowed = 3 * jump * middle + noise * middle * middle
    return bool(middle > 0 and abs(fine[ay, ax] - middle) <= allowed and abs(fine[by, bx] - middle) <= allowed)
