"""Join maps of parts of one video where they overlap: a camera that rotates in place passes no scale on, and the map
breaks there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.whole_map.revisits import relation
from list3r.association.whole_map.settings import JoiningSettings, RevisitPairSettings
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.reconstruction.features.vlad import describe_rooted
from list3r.reconstruction.sfm.keyframe_features import LocalFeatures, match_features
from list3r.reconstruction.sfm.mapping import KeyframeView, MapProblem, SparseMap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Side:
    """A map, and the points that each of its keyframes sees."""

    found: SparseMap
    points_cam: dict[int, Array]
    """All corners and features of a keyframe in its camera coordinates, NaN where the map has none, by key. Shape
    (N, 3)."""


def join_maps(
    maps: Sequence[SparseMap],
    problem: MapProblem,
    features: Mapping[int, LocalFeatures],
    camera: Camera,
    settings: tuple[JoiningSettings, RevisitPairSettings],
) -> SparseMap:
    """Return the largest map with those that can be joined to it, one after another; they may share keyframes."""
    descriptors = {k: describe_rooted(f.descriptors) for k, f in features.items()}
    left = list(maps[1:])
    whole = maps[0]
    joined = True
    while joined and left:
        joined = False
        for other in list(left):
            if other.T_map_cam.keys() <= whole.T_map_cam.keys():
                left.remove(other)
                continue
            a, b = _side(whole, problem), _side(other, problem)
            pairs = _candidates(list(a.points_cam), list(b.points_cam), descriptors, settings[0])
            S = _relation_of_maps(a, b, [_rows(p, problem, features) for p in pairs], problem, camera, settings)
            if S is not None:
                whole, joined = _merged(whole, other, S), True
                left.remove(other)
    return whole


def _side(found: SparseMap, problem: MapProblem) -> _Side:
    return _Side(found, {k: seen_points(found, problem.views[k], k) for k in sorted(found.T_map_cam)})


def seen_points(found: SparseMap, view: KeyframeView, key: int) -> Array:
    """All that a keyframe sees, in its camera coordinates, NaN where the map has no point. Shape (N, 3)."""
    T, held = found.T_map_cam[key], set(found.seen[key].ids.tolist())
    nowhere = np.full(3, np.nan)
    places = np.array([found.points[n] if n in held else nowhere for n in view.ids.tolist()]).reshape(-1, 3)
    return np.asarray((places - T[:3, 3]) @ T[:3, :3])


def _candidates(
    a: Sequence[int], b: Sequence[int], descriptors: Mapping[int, NDArray[np.float32]], how: JoiningSettings
) -> list[tuple[int, int]]:
    """Keyframes of the two maps, by key, that may overlap; one that both maps hold is paired with itself."""
    cosine = np.stack([descriptors[n] for n in b]) @ np.stack([descriptors[m] for m in a]).T
    place = {key: k for k, key in enumerate(sorted({*a, *b}))}
    out: set[tuple[int, int]] = set()
    for row, n in zip(cosine, b, strict=True):
        out |= {(a[m], n) for m in np.argsort(-row, kind="stable")[: how.partners].tolist()}
        out |= {(m, n) for m in a if abs(place[m] - place[n]) <= how.near}
    return sorted(out)


@dataclass(frozen=True)
class _Pair:
    a: int
    b: int
    rows: NDArray[np.int64]
    """Matching rows of the two keyframes. Shape (M, 2)."""


def _rows(pair: tuple[int, int], problem: MapProblem, features: Mapping[int, LocalFeatures]) -> _Pair:
    a, b = pair
    if a == b:
        return _Pair(a, b, np.repeat(np.arange(len(problem.views[a].ids))[:, None], 2, axis=1))
    if (a, b) in problem.pairs:
        return _Pair(a, b, problem.pairs[a, b])
    if (b, a) in problem.pairs:
        return _Pair(a, b, problem.pairs[b, a][:, ::-1])
    first = [len(problem.views[k].ids) - len(features[k].xy) for k in pair]
    return _Pair(a, b, match_features(features[a], features[b]) + np.array(first))


def _relation_of_maps(
    a: _Side,
    b: _Side,
    pairs: Sequence[_Pair],
    problem: MapProblem,
    camera: Camera,
    settings: tuple[JoiningSettings, RevisitPairSettings],
) -> Sim3 | None:
    """S_a_b between two maps; None where too few relations agree."""
    how = settings[0]
    found = []
    for pair in pairs:
        at_a, at_b = pair.rows.T
        points_b = b.points_cam[pair.b]
        measured = relation(
            a.points_cam[pair.a][at_a], problem.views[pair.b].xy[at_b], points_b[at_b], camera, settings[1]
        )
        if measured is not None and measured.least_scale_points:
            T_a, T_b = (Sim3.from_matrix(m.found.T_map_cam[k]) for m, k in ((a, pair.a), (b, pair.b)))
            found.append((T_a @ measured.S_b_a.inverse() @ T_b.inverse(), T_b, float(np.nanmedian(points_b[:, 2]))))
    votes = [sum(_agree(S, other, T_b, depth, how) for other, _, _ in found) for S, T_b, depth in found]
    best = int(np.argmax(votes)) if votes else 0
    if not votes or votes[best] < max(how.least_agreeing, how.least_share * len(votes)):
        return None
    S, T_b, depth = found[best]
    middle = np.median([(S.inverse() @ other).log() for other, _, _ in found if _agree(S, other, T_b, depth, how)], 0)
    return S @ Sim3.exp(middle)


def _agree(one: Sim3, other: Sim3, T_b: Sim3, depth: float, how: JoiningSettings) -> bool:
    """Return whether two relations S_a_b place a view of b, at a typical depth, equally."""
    off = ((one @ T_b).inverse() @ other @ T_b).log()
    near = np.linalg.norm(off[:3]) < how.shift * depth and np.linalg.norm(off[3:6]) < how.turn_rad
    return bool(near and abs(off[6]) < how.log_scale)


def _merged(whole: SparseMap, other: SparseMap, S: Sim3) -> SparseMap:
    """Both maps in the frame of the first; a track that both hold keeps its point there, and a keyframe its pose."""
    poses, seen = dict(whole.T_map_cam), dict(whole.seen)
    for key, T in other.T_map_cam.items():
        placed = S @ Sim3.from_matrix(T)
        poses.setdefault(key, Sim3(np.ones(()), placed.rotation, placed.translation).as_matrix())
        fresh = _without(other.seen[key], whole.points)
        before = seen.get(key)
        seen[key] = fresh if before is None else _both(before, fresh)
    places = S.apply(np.array(list(other.points.values())).reshape(-1, 3))
    points = dict(zip(other.points, places, strict=True)) | whole.points
    return replace(whole, T_map_cam=poses, points=points, seen=seen)


def _both(a: KeyframeView, b: KeyframeView) -> KeyframeView:
    return KeyframeView(np.concatenate([a.ids, b.ids]), np.concatenate([a.xy, b.xy]))


def _without(view: KeyframeView, points: Mapping[int, Array]) -> KeyframeView:
    return view.where([k for k, n in enumerate(view.ids.tolist()) if n not in points])
