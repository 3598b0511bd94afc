"""Whether pictures can be explained by a camera that only rotates; then a map has no depth.

With a wrong or free focal length, structure from motion makes a map of such pictures too. So for pairs of views the
best rotation is fitted at focal lengths around the camera's: x_b ~ K R K^-1 x_a (Hartley and Zisserman, Multiple View
Geometry, 8.4.2; research/colour-video 0071).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from list3r.frames.base import Camera
from list3r.reconstruction.sfm.settings import LEAST_MATCHES, PureRotationSettings

Floats = NDArray[np.float64]
Places = Mapping[int, NDArray[np.float32]]
"""Pixels of common points in each view. Shape (N, 2)."""
Rows = Mapping[tuple[int, int], NDArray[np.int64]]
"""Matching rows of two views, by the two views' keys, the smaller first. Shape (M, 2)."""


def only_turns(
    places: Places, pairs: Rows, keys: Collection[int], camera: Camera, settings: PureRotationSettings | None = None
) -> bool:
    """Return whether the views `keys` of one camera can be explained without translation."""
    s = settings or PureRotationSettings()
    return turning_error(_farthest_pairs(places, pairs, keys, s), camera, s) < s.most_px


def turning_error(pairs: Sequence[tuple[Floats, Floats]], camera: Camera, settings: PureRotationSettings) -> float:
    """Return the residual of the best rotations at the best focal length, px of a picture 640 wide; 0 without pairs."""
    if not pairs:
        return 0.0
    longer = max(camera.width, camera.height)
    centred = [tuple(xy - (camera.cx, camera.cy) for xy in pair) for pair in pairs]

    def left(log_ratio: float) -> float:
        focal = 0.5 * (camera.fx + camera.fy) * float(np.exp(log_ratio))
        errors = [_pair_error(a, b, focal, settings) for a, b in centred]
        return float(np.median(errors)) * 640.0 / longer

    grid = np.linspace(-1.0, 1.0, 7) * np.log(settings.focal_ratio)
    found = [left(f) for f in grid]
    best = int(np.argmin(found))
    low, high = grid[max(0, best - 1)], grid[min(len(grid) - 1, best + 1)]
    finer = minimize_scalar(left, bounds=(low, high), method="bounded", options={"maxiter": 10})
    return min(found[best], float(finer.fun))


def _farthest_pairs(
    places: Places, pairs: Rows, keys: Collection[int], settings: PureRotationSettings
) -> list[tuple[Floats, Floats]]:
    """Common pixels of views spread over the video and the last view that shares enough with each."""
    last = {}
    for (a, b), rows in sorted(pairs.items()):
        if a in keys and b in keys and len(rows) >= LEAST_MATCHES:
            last[a] = b
    rows_of = [(a, b, pairs[a, b]) for a, b in sorted(last.items())]
    rows_of = rows_of[:: max(1, len(rows_of) // settings.most_pairs)]
    return [(places[a][r[:, 0]].astype(np.float64), places[b][r[:, 1]].astype(np.float64)) for a, b, r in rows_of]


def _pair_error(a: Floats, b: Floats, focal: float, settings: PureRotationSettings) -> float:
    """Return the settings' percentile of the residual of the best rotation between two views, px."""
    rays_a, rays_b = (np.column_stack([xy, np.full(len(xy), focal)]) for xy in (a, b))
    rays_a, rays_b = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in (rays_a, rays_b))
    kept = np.ones(len(a), bool)
    off = np.zeros(len(a))
    for _ in range(settings.rounds):
        U, _, Vt = np.linalg.svd(rays_b[kept].T @ rays_a[kept])
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        seen = rays_a @ R.T
        place = seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) * focal
        off = np.linalg.norm(place - b, axis=1)
        kept = off <= np.quantile(off, settings.share)
    return float(np.quantile(off, settings.share))
