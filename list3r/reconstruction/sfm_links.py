"""What keyframes of a chunk see in common: tracked corners, and local features where tracks do not reach.

Corners tie keyframes of one run of tracks. Where all tracks ended at once, keyframes of all runs that look alike are
matched by local features; these join the corners as further points of the same views.
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
