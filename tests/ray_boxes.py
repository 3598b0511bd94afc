"""Rays through axis-aligned boxes, axis by axis, for the scenes that tests cast."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def through_box(
    origin: Sequence[float] | Array, directions: Sequence[Array] | Array, low: Sequence[float], high: Sequence[float]
) -> tuple[Array, Array]:
    """How far along each ray it enters and leaves a box; it misses where it would leave before it enters.

    `directions` are the rays' x, y and z, each of any shape.
    """
    enter = leave = None
    with np.errstate(divide="ignore", invalid="ignore"):
        for o, d, a, b in zip(origin, directions, low, high, strict=True):
            one, other = (a - o) / d, (b - o) / d
            near, far = np.minimum(one, other), np.maximum(one, other)
            enter = near if enter is None else np.maximum(enter, near)
            leave = far if leave is None else np.minimum(leave, far)
    assert enter is not None and leave is not None
    return enter, leave
