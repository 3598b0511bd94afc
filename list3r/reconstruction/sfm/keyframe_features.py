"""Local features of keyframes, and which keyframes are worth matching: those whose best features already agree
(preemptive matching; Wu, "Towards linear-time incremental structure from motion", 3DV 2013)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from list3r.frames.sift import RATIO, nearest_pairs, root_sift, sift
from list3r.reconstruction.features.learned import LearnedDetector
from list3r.reconstruction.features.local import LEARNED_RATIO
from list3r.reconstruction.sfm.settings import FinderSettings

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class LocalFeatures:
    """Features of a picture, best first."""

    xy: Floats
    """px. Shape (N, 2)."""
    descriptors: Floats
    """Unit vectors. Shape (N, D)."""
    ratio: float
    """Lowe's ratio for them."""

    def surest(self, count: int) -> LocalFeatures:
        """Return the first features."""
        return LocalFeatures(self.xy[:count], self.descriptors[:count], self.ratio)


Finder = Callable[[int], LocalFeatures]
"""Features of the frame at a position in the chunk."""


def make_finder(
    grays: Sequence[NDArray[np.uint8]],
    colors: Sequence[NDArray[np.uint8]] | None,
    detector: LearnedDetector | None,
    settings: FinderSettings,
) -> Finder:
    """SIFT features of grey pictures, or learned ones of the colour pictures."""
    if detector is None or colors is None:
        return lambda position: sift_features(grays[position], settings)

    def find(position: int) -> LocalFeatures:
        found = detector(colors[position], settings.learned_count)
        return LocalFeatures(found.xy, found.descriptors, LEARNED_RATIO)

    return find


def sift_features(gray: NDArray[np.uint8], settings: FinderSettings) -> LocalFeatures:
    """SIFT features of a grey picture, one per position."""
    xy, descriptors = sift(gray, settings.count, settings.width, settings.contrast)
    single = np.sort(np.unique(xy, axis=0, return_index=True)[1])
    return LocalFeatures(xy[single], root_sift(descriptors[single]), RATIO)


def match_features(a: LocalFeatures, b: LocalFeatures) -> Ints:
    """Matching rows of two pictures. Shape (M, 2)."""
    return nearest_pairs(a.descriptors, b.descriptors, a.ratio)


def likely_pairs(
    features: Mapping[int, LocalFeatures], known: set[tuple[int, int]], settings: FinderSettings
) -> list[tuple[int, int]]:
    """Pairs of keyframes worth matching, none of those `known`, in order."""
    surest = {k: f.surest(settings.few) for k, f in features.items()}
    agreeing: dict[int, list[tuple[int, tuple[int, int]]]] = {k: [] for k in features}
    for a, b in combinations(sorted(features), 2):
        if (a, b) in known:
            continue
        count = len(match_features(surest[a], surest[b]))
        if count >= settings.least_few:
            agreeing[a].append((-count, (a, b)))
            agreeing[b].append((-count, (a, b)))
    return sorted({pair for found in agreeing.values() for _, pair in sorted(found)[: settings.partners]})
