"""Spread the support of an edge evenly: every patch of the picture counts once in every frame (paper A.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from list3r.association.overlap.inconsistency import relative_to_frame
from list3r.association.overlap.regions import EdgeSupportSettings, Floats, Ints, Mask, Regions, divide, median
from list3r.association.overlap.shared_points import Pairs
from list3r.association.overlap.support import StaticSupport
from list3r.frames.base import Camera

_CHI2_MEDIAN = 0.455
"""Median of chi^2 with one degree of freedom."""


@dataclass(frozen=True)
class BalancedSupport:
    """M correspondences spread evenly over the static surfaces."""

    p_u: Floats
    """In u. Shape (M, 3)."""
    p_v: Floats
    """In v. Shape (M, 3)."""
    weight: Floats
    """Relative information. Shape (M,)."""
    frame: Ints
    """Frame.index. Shape (M,)."""
    used: Mask
    """Pairs that contributed. Shape (N,)."""


def balanced_support(
    pairs: Pairs, static: StaticSupport, camera: Camera, settings: EdgeSupportSettings
) -> BalancedSupport:
    """Return one correspondence for each static patch: a block of the picture in one region of one frame.

    Errors of pairs in one patch are correlated, so a patch's weight saturates with its pairs, and neither a wall nor a
    confident instance outweighs the rest. The errors of a region's patches, and of pairs within them, are measured by
    the disagreement of the two chunks within frames, not taken from the model's confidence: surfaces with wrongly low
    confidence count again. All frames have the same weight, because all points of a frame share its pose error; near
    patches weigh no more than far ones, which determine rotation and scale.
    """
    usable = ~static.removed
    regions = divide(pairs, pairs.instance_u, camera, settings)
    off = relative_to_frame(pairs, static.S_v_u, usable) / np.maximum(pairs.cam_v[:, 2:], 1e-9)
    patch, count = _patches(pairs, regions, usable, camera, settings)
    trust = _within_patch(off, patch, count, usable, settings)
    weight = _information(off, patch, regions, trust, settings)
    _, frame = np.unique(pairs.frame, return_inverse=True)
    weight = weight / np.maximum(np.bincount(frame.ravel(), weight), 1e-300)[frame.ravel()]
    weight = np.asarray(weight, np.float64)
    chosen = np.flatnonzero(weight > 0)
    if count < settings.least_patches:
        return BalancedSupport(
            pairs.p_u[chosen],
            pairs.p_v[chosen],
            np.asarray(weight[chosen], np.float64),
            pairs.frame[chosen],
            weight > 0,
        )
    total = np.asarray(np.bincount(patch[chosen], weight[chosen], count), np.float64)
    rows = np.flatnonzero(total > 0)
    first = np.full(count, len(pairs), np.int64)
    np.minimum.at(first, patch[chosen], chosen)

    def mean(points: Floats) -> Floats:
        sums = [np.bincount(patch[chosen], weight[chosen] * points[chosen, k], count) for k in range(3)]
        return np.asarray(np.stack(sums, axis=1)[rows] / total[rows, None])

    return BalancedSupport(mean(pairs.p_u), mean(pairs.p_v), total[rows], pairs.frame[first[rows]], weight > 0)


def _patches(
    pairs: Pairs, regions: Regions, usable: Mask, camera: Camera, settings: EdgeSupportSettings
) -> tuple[Ints, int]:
    """Return the number of the patch of each usable pair (0 for others), and how many there are; at most `budget`."""
    _, frame = np.unique(pairs.frame, return_inverse=True)
    columns, rows = settings.patches
    while True:
        x, y = pairs.pixel % camera.width * columns // camera.width, pairs.pixel // camera.width * rows // camera.height
        key = ((frame.ravel() * len(regions.count) + regions.of_pair) * rows + y) * columns + x
        values, which = np.unique(key[usable], return_inverse=True)
        if len(values) <= settings.budget or columns * rows == 1:
            break
        columns, rows = max(1, columns // 2), max(1, rows // 2)
    patch = np.zeros(len(pairs), np.int64)
    patch[usable] = which.ravel()
    return patch, len(values)


def _within_patch(off: Floats, patch: Ints, count: int, usable: Mask, settings: EdgeSupportSettings) -> Floats:
    """Return the weight of each pair: Tukey's biweight of its distance along the ray from its patch's median. (N,)."""
    trust = np.zeros(len(off))
    rows = np.flatnonzero(usable)
    if not len(rows):
        return trust
    along, patch = off[rows, 2], patch[rows]
    sorted_along = along[np.lexsort((along, patch))]
    size = np.bincount(patch, minlength=count)
    start = np.cumsum(size) - size
    last = len(rows) - 1
    low, high = np.minimum(start + (size - 1) // 2, last), np.minimum(start + size // 2, last)
    middle = (sorted_along[low] + sorted_along[high]) / 2.0
    away = np.abs(along - middle[patch])
    limit = settings.patch_kernel * max(float(np.median(away)), 1e-9)
    trust[rows] = np.maximum(0.0, 1.0 - (away / limit) ** 2) ** 2
    return trust


def _information(off: Floats, patch: Ints, regions: Regions, trust: Floats, settings: EdgeSupportSettings) -> Floats:
    """Return information of each pair, relative to its depth: its share of 1 / (t^2 + s^2 / n) of its patch of n pairs.

    t is the deviation of whole patches of its region, s that of pairs within them, both robust, and shrunk towards
    those of all regions where a region has few. Shape (N,).
    """
    number = np.bincount(patch, trust)
    mean = np.stack([np.bincount(patch, trust * off[:, k]) for k in range(3)], axis=1)
    mean = np.asarray(mean / np.maximum(number, 1e-12)[:, None], np.float64)
    within = ((off - mean[patch]) ** 2).sum(axis=1)
    whole = (mean**2).sum(axis=1)
    counted, filled = (trust > 0) & (number[patch] > 1), number > 0
    of_patch = np.zeros(len(number), np.int64)
    of_patch[patch[trust > 0]] = regions.of_pair[trust > 0]
    floor = settings.least_deviation**2
    s_all = max(_variance(within[counted]), floor)
    t_all = max(_variance(whole[filled]) - s_all / max(float(np.median(number[filled])), 1.0), floor)
    s, t = np.full(len(regions.count), s_all), np.full(len(regions.count), t_all)
    for k in range(len(regions.count)):
        mine, patches = counted & (regions.of_pair == k), filled & (of_patch == k)
        n, m = int(mine.sum()), int(patches.sum())
        s[k] = (n * _variance(within[mine]) + settings.prior_pairs * s_all) / (n + settings.prior_pairs)
        least = settings.least_region_share * t_all
        own = max(_variance(whole[patches]) - s[k] / max(median(number[patches]), 1.0), least) if m else 0.0
        t[k] = (m * own + settings.prior_patches * t_all) / (m + settings.prior_patches)
    pair_t, pair_s = np.maximum(t, floor)[regions.of_pair], np.maximum(s, floor)[regions.of_pair]
    return np.asarray(trust / (number[patch] * pair_t + pair_s))


def _variance(squares: Floats) -> float:
    """Return robust variance from squared deviations, mostly along the ray: their median over that of chi^2_1."""
    return median(squares) / _CHI2_MEDIAN if len(squares) else 0.0
