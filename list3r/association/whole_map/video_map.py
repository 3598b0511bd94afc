"""One map of a whole video of wide steps, before its chunks (research/colour-video 0074).

Frames are tracked and matched with those ahead, and mapped in one go; then revisits are searched, drift is spread
between them, and all is adjusted together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.whole_map.drift import spread_drift
from list3r.association.whole_map.joining import join_maps
from list3r.association.whole_map.revisits import find_revisits, seen_again
from list3r.association.whole_map.settings import VideoMapSettings
from list3r.association.whole_map.views import view_of
from list3r.frames.base import Camera
from list3r.reconstruction.sfm.adjustment import adjust
from list3r.reconstruction.sfm.frame_poses import PosedSegment, pose_segments
from list3r.reconstruction.sfm.global_map import with_global_map
from list3r.reconstruction.sfm.keyframe_features import LocalFeatures, make_finder, match_features
from list3r.reconstruction.sfm.mapping import KeyframeView, MapProblem, SparseMap, build_maps, shared_rows
from list3r.reconstruction.sfm.settings import LEAST_MATCHES, MIDDLE_DEPTH, SfmSettings
from list3r.reconstruction.sfm.tracks import CornerTracks, Gray, follow_corners
from list3r.reconstruction.sfm.two_view import verified_rows

Array = NDArray[np.float64]

_IDS = 1_000_000
"""Features of the first frame are numbered from here on; those of every frame have this many numbers."""


@dataclass(frozen=True)
class VideoMap:
    """The camera poses of a whole video, in one frame of reference and scale."""

    T_map_cam: dict[int, Array]
    """By position of the frame. Shape (4, 4) each."""
    revisits: list[tuple[int, int, int]]
    """Positions of frames that see again a place that was out of sight between them, the earlier first, and the number
    of features."""
    keyframes: tuple[MapProblem, SparseMap]
    """Some of the map's keyframes, with their points."""


def map_video(grays: Sequence[Gray], camera: Camera, sfm: SfmSettings, settings: VideoMapSettings) -> VideoMap | None:
    """Return the map of all frames of a video; None where it falls into pieces or poses too few."""
    tracks = follow_corners(grays, sfm.tracks)
    finder = make_finder(grays, None, None, settings.features)
    features = {key: finder(key) for key in tracks.keyframes}
    problem = video_problem(tracks, features, settings)
    verified = verified_rows(problem, camera, settings.mapping)
    maps = build_maps(problem, camera, settings=settings.mapping, verified=verified)
    maps = with_global_map(maps, problem, camera, settings.mapping, verified)
    if not maps:
        return None
    joined = join_maps(maps, problem, features, camera, (settings.joining, settings.revisits))
    if len(joined.T_map_cam) < settings.least_posed * len(tracks.keyframes):
        return None
    found, revisits = _closed(joined, problem, features, camera, settings)
    segments = pose_segments([found], tracks, grays, sfm.fill, adjusted=True)
    if not segments or len(segments[0].T_map_cam) < settings.least_posed * len(grays):
        return None
    return VideoMap(_scaled(segments[0]), revisits, _some_keyframes(found, problem))


def _some_keyframes(found: SparseMap, problem: MapProblem) -> tuple[MapProblem, SparseMap]:
    """Return every third keyframe of a map: enough to estimate the camera."""
    kept = sorted(found.T_map_cam)[::3]
    some = replace(found, T_map_cam={k: found.T_map_cam[k] for k in kept}, seen={k: found.seen[k] for k in kept})
    return MapProblem({k: problem.views[k] for k in kept}, {}), some


def _scaled(segment: PosedSegment) -> dict[int, Array]:
    """Poses by position, scaled to the chunks' usual median depth."""
    depths = np.concatenate([segment.depths(k)[1] for k in sorted(segment.seen)])
    scale = MIDDLE_DEPTH / float(np.median(depths)) if len(depths) else 1.0
    lengths = np.ones((4, 4))
    lengths[:3, 3] = scale
    return {k: T * lengths for k, T in sorted(segment.T_map_cam.items())}


def video_problem(tracks: CornerTracks, features: dict[int, LocalFeatures], settings: VideoMapSettings) -> MapProblem:
    """Return keyframes with corners and features, each paired with those ahead."""
    views, first, pairs, matched = {}, {}, {}, set()
    for key in tracks.keyframes:
        first[key] = len(tracks.ids[key])
        ids = np.concatenate([tracks.ids[key], _first_id(key) + np.arange(len(features[key].xy))])
        views[key] = KeyframeView(ids, np.concatenate([tracks.xy[key], features[key].xy]).astype(np.float32))
    corners = {k: KeyframeView(tracks.ids[k], tracks.xy[k]) for k in tracks.keyframes}
    for n, a in enumerate(tracks.keyframes):
        for b in (tracks.keyframes[n + step] for step in settings.pair_steps if n + step < len(tracks.keyframes)):
            rows = shared_rows(corners[a], corners[b]) if tracks.run[a] == tracks.run[b] else _NO_ROWS
            alike = match_features(features[a], features[b])
            if len(rows) < LEAST_MATCHES and len(alike) >= LEAST_MATCHES:
                matched.add((a, b))
            alike = alike if len(alike) >= LEAST_MATCHES else _NO_ROWS
            rows = np.concatenate([rows, alike + np.array([first[a], first[b]])])
            if len(rows) >= LEAST_MATCHES:
                pairs[a, b] = rows
    return MapProblem(views, pairs, frozenset(matched))


_NO_ROWS = np.zeros((0, 2), np.int64)


def _first_id(key: int) -> int:
    return _IDS * (key + 1)


def _closed(
    found: SparseMap,
    problem: MapProblem,
    features: dict[int, LocalFeatures],
    camera: Camera,
    settings: VideoMapSettings,
) -> tuple[SparseMap, list[tuple[int, int, int]]]:
    """Return the map adjusted, with its revisits closed, and the revisits."""
    views = [view_of(k, found, features[k], _first_id(k)) for k in sorted(found.T_map_cam)]
    revisits, common = find_revisits(views, camera, settings.revisits)
    T_map_cam, believed = spread_drift(views, revisits, settings.drift) if revisits else (found.T_map_cam, [])
    kept = {k: problem.views[k] for k in T_map_cam}
    pairs = {p: rows for p, rows in problem.pairs.items() if p[0] in kept and p[1] in kept}
    relations = {}
    for r in believed:
        a, b = views[r.a].key, views[r.b].key
        first = [len(problem.views[k].ids) - len(features[k].xy) for k in (a, b)]
        relations[a, b] = common[r.a, r.b] + np.array(first)
    wider = MapProblem(kept, pairs | relations, problem.matched | set(relations))
    closed = adjust(wider, camera, T_map_cam, settings.adjustment)
    if closed is None:
        return found, []
    again = seen_again(views, camera, believed, settings.revisits)
    return replace(closed, camera=found.camera), [(views[r.a].key, views[r.b].key, r.inliers) for r in again]
