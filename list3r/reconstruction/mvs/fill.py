"""Fill flat regions without texture with the plane of their rim, if that is one, at low confidence."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.mvs.settings import RegionFillSettings

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


def fill_regions(
    inverse: Floats, sigma: Floats, color: NDArray[np.uint8], settings: RegionFillSettings
) -> tuple[Floats, Floats]:
    """Inverse depth and sigma (h, w) with flat regions filled. `color` is RGB of the same size, shape (h, w, 3).

    Inverse depth of a plane is linear in the pixel's position, so three pixels of the rim make a hypothesis.
    """
    labels, count = _regions(inverse > 0, color, settings)
    inverse, sigma = inverse.copy(), sigma.copy()
    smooth = cv2.blur(color, (5, 5)).astype(np.float32)
    for label, box in count:
        region = labels[box] == label
        found = _plane_of_rim(region, inverse[box], sigma[box], smooth[box], settings)
        if found is not None:
            rows, columns = np.nonzero(region)
            values = found[0] + found[1] * columns + found[2] * rows
            at = rows + box[0].start, columns + box[1].start
            inverse[at], sigma[at] = values, settings.sigma
    return inverse, sigma


def _regions(
    known: Mask, color: NDArray[np.uint8], settings: RegionFillSettings
) -> tuple[NDArray[np.int32], list[tuple[int, tuple[slice, slice]]]]:
    """Numbered regions without depth, separated at edges of colour; each with a box that includes its rim."""
    gray = cv2.GaussianBlur(color, (3, 3), 0).astype(np.float32)
    dx = np.abs(cv2.filter2D(gray, -1, np.array([[-1.0, 0.0, 1.0]], np.float32))).max(axis=2)
    dy = np.abs(cv2.filter2D(gray, -1, np.array([[-1.0], [0.0], [1.0]], np.float32))).max(axis=2)
    open_ = (~known & (np.maximum(dx, dy) < settings.edge)).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(open_, connectivity=4)
    height, width = known.shape
    out = []
    for label in range(1, count):
        x, y, w, h, area = stats[label].tolist()
        if settings.least_px <= area <= settings.most_share * known.size:
            pad = settings.rim_px + 2
            rows = slice(max(0, y - pad), min(height, y + h + pad))
            out.append((label, (rows, slice(max(0, x - pad), min(width, x + w + pad)))))
    grown = cv2.dilate(labels.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
    labels = np.where((labels == 0) & ~known, grown, labels)
    return labels.astype(np.int32), sorted(out)


def _plane_of_rim(
    region: Mask, inverse: Floats, sigma: Floats, color: Floats, settings: RegionFillSettings
) -> NDArray[np.float64] | None:
    """(c, a, b) of inverse depth = c + a x + b y in the box, None where the rim is no plane."""
    size = 2 * settings.rim_px + 1
    near = cv2.dilate(region.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    own = np.median(color[region], axis=0)
    alike = np.abs(color - own).max(axis=2) < settings.rim_color
    rows, columns = np.nonzero(near & ~region & (inverse > 0) & (sigma < settings.sigma) & alike)
    if len(rows) < settings.rim_least:
        return None
    x, y = columns.astype(np.float64), rows.astype(np.float64)
    places = np.stack([np.ones_like(x), x, y], axis=1)
    w = inverse[rows, columns].astype(np.float64)
    plane = _best_plane(places, w, settings)
    if plane is None:
        return None
    on = np.abs(places @ plane - w) < settings.tolerance * w
    if on.mean() < settings.agree:
        return None
    plane = np.asarray(np.linalg.lstsq(places[on], w[on], rcond=None)[0], np.float64)
    hull = cv2.convexHull(np.stack([columns[on], rows[on]], axis=1).astype(np.int32))
    inside = cv2.fillConvexPoly(np.zeros(region.shape, np.uint8), hull, (1.0,)) > 0
    r, c = np.nonzero(region)
    values = plane[0] + plane[1] * c + plane[2] * r
    if np.mean(inside[region]) < settings.around or values.min() < 0.5 * w.min() or values.max() > 2.0 * w.max():
        return None
    return plane


def _best_plane(
    places: NDArray[np.float64], w: NDArray[np.float64], settings: RegionFillSettings
) -> NDArray[np.float64] | None:
    """Return the plane through three pixels of the rim with most inliers among the rim."""
    rng = np.random.default_rng(len(w))
    few = rng.choice(len(w), min(300, len(w)), replace=False)
    picks = rng.integers(0, len(w), (settings.hypotheses, 3))
    systems = places[picks]
    good = np.abs(np.linalg.det(systems)) > 20.0
    if not good.any():
        return None
    planes = np.linalg.solve(systems[good], w[picks[good]][..., None])[..., 0]
    near = np.abs(planes @ places[few].T - w[few]) < settings.tolerance * w[few]
    return np.asarray(planes[int(np.argmax(near.sum(axis=1)))])
