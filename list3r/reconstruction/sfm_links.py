"""What keyframes of a chunk see in common: tracked corners, and local features where tracks do not reach.

Corners tie keyframes of one run of tracks. Where all tracks ended at once, and between keyframes that lie far apart in
time, SIFT features are matched; they join the corners as further points of the same views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.features import match
from list3r.reconstruction.sfm_mapping import MapProblem, View, shared_rows
from list3r.reconstruction.sfm_tracks import Gray, Tracks


@dataclass(frozen=True)
class LinkSettings:
    """Which keyframes are related, and how features are found."""

    features: int = 1000
    """SIFT features of a keyframe that is matched."""
    contrast: float = 0.015
    """SIFT's contrast threshold."""
    ratio: float = 0.85
    """Lowe's ratio."""
    ends: int = 2
    """Keyframes on either side of a break that are matched with each other."""
    runs_ahead: int = 3
    """Runs behind a break that are looked at."""
    least_matches: int = 20
    """Fewest shared corners or features that make a pair."""


_FEATURE_IDS = 1_000_000
"""Numbers of features start here for the first keyframe, so that they never meet those of tracks."""


def keyframe_problem(tracks: Tracks, grays: Sequence[Gray], settings: LinkSettings | None = None) -> MapProblem:
    """The keyframes of a chunk as a problem for the mapper, by position in the chunk."""
    chosen = settings or LinkSettings()
    views = {k: View(tracks.ids[k], tracks.xy[k]) for k in tracks.keyframes}
    pairs = {}
    for n, a in enumerate(tracks.keyframes):
        for b in tracks.keyframes[n + 1 :]:
            if tracks.run[a] == tracks.run[b] and len(rows := shared_rows(views[a], views[b])) >= chosen.least_matches:
                pairs[a, b] = rows
    return with_features(MapProblem(views, pairs), grays, _across_breaks(tracks, chosen), chosen)


def with_features(
    problem: MapProblem, grays: Sequence[Gray], wanted: Sequence[tuple[int, int]], settings: LinkSettings
) -> MapProblem:
    """The problem with SIFT matches of the wanted pairs of views added, `grays` by key of the view."""
    views, pairs = dict(problem.views), dict(problem.pairs)
    found = {key: _features(grays[key], settings) for key in sorted({k for pair in wanted for k in pair})}
    first = {}
    for key, (xy, _) in found.items():
        view = views[key]
        first[key] = len(view.ids)
        ids = _FEATURE_IDS * (key + 1) + np.arange(len(xy))
        views[key] = View(np.concatenate([view.ids, ids]), np.concatenate([view.xy, xy]).astype(np.float32))
    for a, b in wanted:
        rows = match(found[a][1], found[b][1], settings.ratio)
        if len(rows) >= settings.least_matches:
            rows = rows + np.array([first[a], first[b]])
            pairs[a, b] = np.concatenate([pairs[a, b], rows]) if (a, b) in pairs else rows
    return MapProblem(views, pairs)


def _across_breaks(tracks: Tracks, settings: LinkSettings) -> list[tuple[int, int]]:
    """Pairs of keyframes on either side of a break."""
    runs = [[k for k in tracks.keyframes if tracks.run[k] == r] for r in range(int(tracks.run.max(initial=-1)) + 1)]
    runs = [run for run in runs if run]
    wanted = []
    for n, before in enumerate(runs):
        for behind in runs[n + 1 : n + 1 + settings.runs_ahead]:
            wanted += [(a, b) for a in before[-settings.ends :] for b in behind[: settings.ends]]
    return wanted


def _features(gray: Gray, settings: LinkSettings) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    sift = cv2.SIFT.create(nfeatures=settings.features, contrastThreshold=settings.contrast)
    keypoints, descriptors = sift.detectAndCompute(gray, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
    xy = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
    order = np.lexsort((xy[:, 0], xy[:, 1], -np.array([k.response for k in keypoints])))[: settings.features]
    _, single = np.unique(xy[order], axis=0, return_index=True)
    order = order[np.sort(single)]
    return xy[order], descriptors[order].astype(np.uint8)
