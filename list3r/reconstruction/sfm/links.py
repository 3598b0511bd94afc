"""Matches between keyframes of a chunk: tracked corners, and local features where tracks do not reach.

Corners connect keyframes of one run of tracks. Where all tracks ended at once, similar keyframes of all runs are
matched by local features. Frames before and behind the chunk are mapped with it, and all keyframes are matched by
features as well, because corners alone deform a chunk with little motion (research/colour-video 0065).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from list3r.reconstruction.sfm.keyframe_features import Finder, LocalFeatures, likely_pairs, make_finder, match_features
from list3r.reconstruction.sfm.mapping import KeyframeView, MapProblem, shared_rows
from list3r.reconstruction.sfm.settings import LEAST_MATCHES, LinkSettings
from list3r.reconstruction.sfm.tracks import CornerTracks, Gray

_FEATURE_IDS = 1_000_000
"""First feature number of the first keyframe, above all track numbers."""
_AHEAD_IDS = 500_000
"""The same for features by which a keyframe is matched with the ones ahead."""
_NO_ROWS = np.zeros((0, 2), np.int64)


def keyframe_problem(
    tracks: CornerTracks, grays: Sequence[Gray], settings: LinkSettings | None = None, finder: Finder | None = None
) -> MapProblem:
    """Return the keyframes of a chunk as a problem for the mapper, by position in the chunk.

    `finder` finds features where tracks do not reach; None takes SIFT.
    """
    chosen = settings or LinkSettings()
    problem = corner_problem(tracks)
    if len(np.unique(tracks.run[list(tracks.keyframes)])) < 2:
        return problem
    return with_features(problem, finder or make_finder(grays, None, None, chosen.features), chosen)


def corner_problem(tracks: CornerTracks) -> MapProblem:
    """Return the keyframes of a chunk with their tracked corners alone."""
    views = {k: KeyframeView(tracks.ids[k], tracks.xy[k]) for k in tracks.keyframes}
    pairs = {}
    for n, a in enumerate(tracks.keyframes):
        for b in tracks.keyframes[n + 1 :]:
            rows = shared_rows(views[a], views[b]) if tracks.run[a] == tracks.run[b] else _NO_ROWS
            if len(rows) >= LEAST_MATCHES:
                pairs[a, b] = rows
    return MapProblem(views, pairs)


def context_step(tracks: CornerTracks, settings: LinkSettings) -> int:
    """Return the distance, in frames, of the context frames that are mapped with a chunk."""
    apart = settings.context_step * len(tracks.run) / max(1, len(tracks.keyframes))
    return int(np.clip(round(apart), 1, settings.most_step))


def with_neighbours(
    problem: MapProblem, before: Sequence[int], behind: Sequence[int], finder: Finder, settings: LinkSettings
) -> MapProblem:
    """The problem with features of its keyframes, and of frames before and behind them, each matched with some ahead.

    `before` and `behind` are in order of time, by the finder's positions.
    """
    order = [*before, *sorted(problem.views), *behind]
    found = {key: finder(key) for key in order}
    views, first = _joined(problem.views, found, _AHEAD_IDS)
    pairs, matched = dict(problem.pairs), set(problem.matched)
    for n, one in enumerate(order):
        for other in order[n + 1 : n + 1 + settings.ahead]:
            a, b = min(one, other), max(one, other)
            rows = match_features(found[a], found[b])
            if len(rows) < LEAST_MATCHES:
                continue
            rows = rows + np.array([first[a], first[b]])
            if (a, b) not in pairs:
                matched.add((a, b))
            pairs[a, b] = np.concatenate([pairs[a, b], rows]) if (a, b) in pairs else rows
    return MapProblem(views, pairs, frozenset(matched), frozenset([*before, *behind]))


def with_features(problem: MapProblem, finder: Finder, settings: LinkSettings) -> MapProblem:
    """Return the problem with similar keyframes that share no tracks matched by features."""
    pairs, found = dict(problem.pairs), {key: finder(key) for key in sorted(problem.views)}
    views, first = _joined(problem.views, found, 0)
    for a, b in likely_pairs(found, set(pairs), settings.features):
        rows = match_features(found[a], found[b])
        if len(rows) >= LEAST_MATCHES:
            pairs[a, b] = rows + np.array([first[a], first[b]])
    return MapProblem(views, pairs, frozenset(set(pairs) - set(problem.pairs)))


def _joined(
    views: Mapping[int, KeyframeView], found: Mapping[int, LocalFeatures], from_id: int
) -> tuple[dict[int, KeyframeView], dict[int, int]]:
    """Return keyframes with features behind their corners, and where in each these begin."""
    out, first = {}, {}
    for key, features in found.items():
        view = views.get(key, KeyframeView(np.zeros(0, np.int64), np.zeros((0, 2), np.float32)))
        first[key] = len(view.ids)
        ids = _FEATURE_IDS * (key + 1) + from_id + np.arange(len(features.xy))
        xy = np.concatenate([view.xy, features.xy]).astype(np.float32)
        out[key] = KeyframeView(np.concatenate([view.ids, ids]), xy)
    return out, first
