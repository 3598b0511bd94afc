"""Where one surface hides another in a depth image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0))


@dataclass(frozen=True)
class DepthEdges:
    """Pixels on the near side of occlusion edges."""

    x: NDArray[np.int32]
    """Column, px. Shape (N,)."""
    y: NDArray[np.int32]
    """Row, px. Shape (N,)."""
    z: NDArray[np.float32]
    """Depth of the near side, metres. Shape (N,)."""
    horizontal: NDArray[np.bool_]
    """True where the far side lies to the left or right, False where it lies above or below. Shape (N,)."""


def depth_edges(
    depth: NDArray[np.float32], step: float = 0.06, reach_px: int = 12, max_depth_m: float = 4.0
) -> DepthEdges:
    """Near sides of the steps in a depth image.

    A step is a pixel beyond which, within `reach_px` pixels that are all unknown (the shadow of a structured-light or
    stereo sensor), something farther by `step` of the depth and `step` metres appears. `depth` is in metres, 0 where
    unknown, shape (H, W). Beyond `max_depth_m` the sensors' noise drowns such steps.
    """
    height, width = depth.shape
    near = (depth > 0) & (depth < max_depth_m)
    limit = depth + np.float32(step) * np.maximum(depth, 1.0)
    found = []
    for dy, dx in _DIRECTIONS:
        beyond = np.zeros_like(depth)
        open_ = near.copy()
        for k in range(1, reach_px + 1):
            to = np.s_[max(0, -dy * k) : height - max(0, dy * k), max(0, -dx * k) : width - max(0, dx * k)]
            at = np.s_[max(0, dy * k) : height - max(0, -dy * k), max(0, dx * k) : width - max(0, -dx * k)]
            seen = open_[to] & (depth[at] > 0)
            beyond[to][seen] = depth[at][seen]
            open_[to] &= ~seen
            if not open_[to].any():
                break
        y, x = np.nonzero(beyond > limit)
        found.append((x, y, depth[y, x], np.full(len(x), dx != 0)))
    x, y, z, horizontal = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return DepthEdges(x.astype(np.int32), y.astype(np.int32), z.astype(np.float32), horizontal)
