"""What keyframes of a chunk see in common: tracked corners, and local features where tracks do not reach.

Corners tie keyframes of one run of tracks. Where all tracks ended at once, keyframes of all runs that look alike are
matched by local features; these join the corners as further points of the same views.

Frames in the largest part and ATE after Sim(3), at first with SIFT of the two keyframes on either side of a break only:
redkitchen every 15th, 20th and 30th frame 28 of 67, 13 of 50 and 7 of 33; now 67 (0.048 m), 50 (0.048 m) and 33
(0.050 m) by SIFT, and the same by ALIKED. Every 20th frame of 400 to 720, where no place is seen again: SIFT 5 of 16,
ALIKED 16 (0.026 m). The bare cabinet, 58 frames 0.6 s apart: SIFT 6, ALIKED 21 (0.015 m). Simulated walks with fast
turns: SIFT 28 of 53, ALIKED 26 to 28. XFeat is not used here: 24 of the 33, and a map of the cabinet 1.27 m off.
Before matched pairs had to fit an essential matrix with a third of their matches (`MappingSettings.matched_share`)
ALIKED bent one of those walks by 0.94 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from list3r.reconstruction.sfm_features import Finder, FinderSettings, likely_pairs, make_finder, match_features
from list3r.reconstruction.sfm_mapping import MapProblem, View, shared_rows
from list3r.reconstruction.sfm_tracks import Gray, Tracks


@dataclass(frozen=True)
class LinkSettings:
    """Which keyframes are related, and how features are found."""

    features: FinderSettings = field(default_factory=FinderSettings)
    least_matches: int = 20
    """Fewest shared corners or features that make a pair."""


_FEATURE_IDS = 1_000_000
"""Numbers of features start here for the first keyframe, so that they never meet those of tracks."""


def keyframe_problem(
    tracks: Tracks, grays: Sequence[Gray], settings: LinkSettings | None = None, finder: Finder | None = None
) -> MapProblem:
    """The keyframes of a chunk as a problem for the mapper, by position in the chunk.

    `finder` finds features where tracks do not reach; None takes SIFT.
    """
    chosen = settings or LinkSettings()
    views = {k: View(tracks.ids[k], tracks.xy[k]) for k in tracks.keyframes}
    pairs = {}
    for n, a in enumerate(tracks.keyframes):
        for b in tracks.keyframes[n + 1 :]:
            if tracks.run[a] == tracks.run[b] and len(rows := shared_rows(views[a], views[b])) >= chosen.least_matches:
                pairs[a, b] = rows
    problem = MapProblem(views, pairs)
    if len(np.unique(tracks.run[list(tracks.keyframes)])) < 2:
        return problem
    return with_features(problem, finder or make_finder(grays, None, None, chosen.features), chosen)


def with_features(problem: MapProblem, finder: Finder, settings: LinkSettings) -> MapProblem:
    """The problem with keyframes that look alike, and share no tracks, matched by features."""
    views, pairs = dict(problem.views), dict(problem.pairs)
    found = {key: finder(key) for key in sorted(views)}
    first = {key: len(view.ids) for key, view in views.items()}
    for key, features in found.items():
        view, ids = views[key], _FEATURE_IDS * (key + 1) + np.arange(len(features.xy))
        xy = np.concatenate([view.xy, features.xy]).astype(np.float32)
        views[key] = View(np.concatenate([view.ids, ids]), xy)
    for a, b in likely_pairs(found, set(pairs), settings.features):
        rows = match_features(found[a], found[b])
        if len(rows) >= settings.least_matches:
            pairs[a, b] = rows + np.array([first[a], first[b]])
    return MapProblem(views, pairs, frozenset(set(pairs) - set(problem.pairs)))
