"""Divide the pixels that two chunks share into regions: the masks of either chunk, and blocks of the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.shared_points import Pairs
from list3r.frames.base import Camera

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class EdgeSupportSettings:
    """Limits of confidence and motion, and how the support is spread."""

    confidence_share: float = 0.1
    """Least confidence, as a share of the smaller median of the two chunks (VGGT-Long's rule)."""
    blocks: tuple[int, int] = (4, 3)
    """Columns and rows of blocks into which pixels without an instance are divided."""
    least_region_pairs: int = 12
    """Fewest pairs on which a region is judged."""
    factor: float = 3.0
    """A region moves when its displacement is this many times that of static regions"""
    deviations: float = 6.0
    """and this many robust deviations of the static regions more,"""
    least_pixels: float = 0.002
    """and at least this share of the image's width"""
    least_depth: float = 0.01
    """or, along the ray, this share of its depth."""
    plainly: float = 3.0
    """Multiple of that limit beyond which a region plainly moves; below it may be wrongly tracked or badly
    reconstructed. Both leave the support."""
    rounds: int = 2
    """Rounds of alignment and removal."""
    hypotheses: int = 6
    """Largest regions that are tried as the static ones."""
    patches: tuple[int, int] = (8, 6)
    """Columns and rows of patches, each of which is one correspondence in each frame and region."""
    prior_patches: int = 60
    """Pseudo-count of patches that shrinks a region's error towards that of all regions (errors last over frames)."""
    least_patches: int = 300
    """With fewer patches than this the pairs themselves are used."""
    budget: int = 6000
    """Most correspondences of the alignment."""
    patch_kernel: float = 8.0
    """Distance from its patch's median along the ray beyond which a pair has no weight (Tukey's biweight), in medians
    of that distance."""
    prior_pairs: int = 20
    """Pseudo-count of pairs that shrinks a region's scatter within patches towards that of all regions."""
    least_region_share: float = 0.05
    """Least variance of a region's patches, as a share of that of all regions."""
    vote_quantile: float = 0.4
    """Quantile of the regions' disagreement with a hypothesis that measures its best fit: static regions are more than
    this share."""
    all_pairs_share: float = 0.98
    """The hypothesis of all pairs is taken where its votes reach this share of the best one's."""
    least_deviation: float = 0.001
    """Disagreement, as a share of the depth, below which chunks do not count as disagreeing."""


@dataclass(frozen=True)
class Regions:
    """A division of the pairs into R regions by the masks of one chunk."""

    label: Ints
    """Local id of each region, -1 for a block of the picture without an instance. Shape (R,)."""
    of_pair: Ints
    """Region of each pair. Shape (N,)."""
    count: Ints
    """Pairs of each region. Shape (R,)."""


def confident(pairs: Pairs, settings: EdgeSupportSettings) -> Mask:
    """Return pairs with enough confidence. Shape (N,)."""
    least = settings.confidence_share * min(np.median(pairs.confidence_u), np.median(pairs.confidence_v))
    return np.asarray((pairs.confidence_u > least) & (pairs.confidence_v > least))


def divide(pairs: Pairs, instance: Ints, camera: Camera, settings: EdgeSupportSettings) -> Regions:
    """Return regions by one chunk's instances, and by blocks of the picture elsewhere."""
    columns, rows = settings.blocks
    block = (pairs.pixel % camera.width) * columns // camera.width
    block = block + columns * ((pairs.pixel // camera.width) * rows // camera.height)
    key = np.where(instance >= 0, instance, -1 - block)
    values, of_pair, count = np.unique(key, return_inverse=True, return_counts=True)
    return Regions(np.maximum(values, -1), of_pair.ravel().astype(np.int64), count)


def median(values: Floats) -> float:
    """Return the median, NaN of nothing."""
    return float(np.median(values)) if len(values) else float("nan")


def weighted_quantile(values: Floats, weight: Floats, share: float) -> float:
    known = np.asarray(np.isfinite(values) & (weight > 0))
    if not known.any():
        return 0.0
    order = np.argsort(values[known], kind="stable")
    total = np.asarray(np.cumsum(weight[known][order]))
    return float(values[known][order][int(np.searchsorted(total, share * total[-1]))])
