"""Whether the objects of a map rest on one another along the axis that is said to point up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_AXES = ("x", "y", "z", "-x", "-y", "-z")
_TOUCH_M = 0.04
"""Gap between an object and its support."""
_SHARE = 0.7
"""Share of an object's footprint that is on its support."""
_LEAST, _TIMES = 4, 2.0
"""Another axis is up where this many objects rest along it, and this many times more than along the stated one."""
_MOST_OBJECTS = 1500


def up_axis_notes(objects: Sequence[NDArray[np.float32]], up: str) -> tuple[str, ...]:
    """Return a note where objects, by their points (N, 3) each, clearly rest along another axis than `up`."""
    if len(objects) > _MOST_OBJECTS:
        return ()
    finite = [points[np.isfinite(points).all(axis=1)] for points in objects]
    boxes = np.array([[p.min(axis=0), p.max(axis=0)] for p in finite if len(p)]).reshape(-1, 2, 3)
    resting = {axis: _count_resting(boxes, axis) for axis in _AXES}
    best = max(resting, key=lambda axis: resting[axis])
    if resting[best] < max(_LEAST, _TIMES * resting[up]) or best == up:
        return ()
    return (
        f"{resting[best]} objects rest on others along {best} and {resting[up]} along {up}: if {best} points up, "
        f"import the map again with --up {best}",
    )


def _count_resting(boxes: NDArray[np.float64], axis: str) -> int:
    """Return how many boxes (N, 2, 3) rest on a larger one along an axis."""
    k, sign = "xyz".index(axis[-1]), -1.0 if axis.startswith("-") else 1.0
    low, high = np.sort(sign * boxes[:, :, k], axis=1).T
    sides = [j for j in range(3) if j != k]
    size = np.ptp(boxes[:, :, sides], axis=1).prod(axis=1)
    shared = np.minimum(boxes[:, None, 1, sides], boxes[None, :, 1, sides])
    shared = shared - np.maximum(boxes[:, None, 0, sides], boxes[None, :, 0, sides])
    common = np.maximum(shared, 0).prod(axis=2)
    on = (
        (np.abs(low[:, None] - high[None]) < _TOUCH_M)
        & (common > _SHARE * size[:, None])
        & (size[None] > size[:, None])
    )
    return int(on.any(axis=1).sum())
