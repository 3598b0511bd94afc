"""Maps of parts of one video joined where they see the same: a camera that turns on the spot carries no scale along,
and what is mapped falls apart there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.whole_map.revisits import relation
from list3r.association.whole_map.settings import JoiningSettings, RevisitPairSettings
from list3r.association.whole_map.views import MapView, view_of
from list3r.frames.base import Camera
from list3r.memory.geometry import Sim3
from list3r.reconstruction.sfm.keyframe_features import LocalFeatures, match_features
from list3r.reconstruction.sfm.mapping import KeyframeView, SparseMap

Array = NDArray[np.float64]


def join_maps(
    maps: Sequence[SparseMap],
    features: Mapping[int, LocalFeatures],
    first_ids: Mapping[int, int],
    camera: Camera,
    settings: tuple[JoiningSettings, RevisitPairSettings],
) -> SparseMap:
    """Return the largest map with those that can be joined to it, one after another.

    `features` and the number of the first of them are by key of the frame.
    """
    left = list(maps[1:])
    whole = maps[0]
    joined = True
    while joined and left:
        joined = False
        for other in list(left):
            if other.T_map_cam.keys() & whole.T_map_cam.keys():
                left.remove(other)
                continue
            sides = [[view_of(k, m, features[k], first_ids[k]) for k in sorted(m.T_map_cam)] for m in (whole, other)]
            S = _relation_of_maps(sides[0], sides[1], camera, *settings)
            if S is not None:
                whole, joined = _merged(whole, other, S), True
                left.remove(other)
    return whole


def _relation_of_maps(
    a: Sequence[MapView], b: Sequence[MapView], camera: Camera, how: JoiningSettings, pairs: RevisitPairSettings
) -> Sim3 | None:
    """S_a_b between the maps of two lists of views; None where too few relations agree."""
    found = []
    for m, n in _candidates(a, b, how):
        told = relation(a[m], b[n], match_features(a[m].features, b[n].features), camera, pairs)
        if told is not None and told.tells_scale:
            T_a, T_b = Sim3.from_matrix(a[m].T_map_cam), Sim3.from_matrix(b[n].T_map_cam)
            found.append((T_a @ told.S_b_a.inverse() @ T_b.inverse(), b[n]))
    votes = [sum(_agree(S, other, view, how) for other, _ in found) for S, view in found]
    best = int(np.argmax(votes)) if votes else 0
    if not votes or votes[best] < max(how.least_agreeing, how.least_share * len(votes)):
        return None
    agreeing = [S for S, _ in found if _agree(found[best][0], S, found[best][1], how)]
    middle = np.median([(found[best][0].inverse() @ S).log() for S in agreeing], axis=0)
    return found[best][0] @ Sim3.exp(middle)


def _candidates(a: Sequence[MapView], b: Sequence[MapView], how: JoiningSettings) -> list[tuple[int, int]]:
    cosine = np.stack([v.look for v in b]) @ np.stack([v.look for v in a]).T
    order = sorted([*(v.key for v in a), *(v.key for v in b)])
    place = {key: k for k, key in enumerate(order)}
    out: set[tuple[int, int]] = set()
    for n, view in enumerate(b):
        out |= {(int(m), n) for m in np.argsort(-cosine[n], kind="stable")[: how.partners]}
        out |= {(m, n) for m, other in enumerate(a) if abs(place[other.key] - place[view.key]) <= how.near}
    return sorted(out)


def _agree(one: Sim3, other: Sim3, view: MapView, how: JoiningSettings) -> bool:
    """Tell whether two relations S_a_b put a view at the same place."""
    T = Sim3.from_matrix(view.T_map_cam)
    off = ((one @ T).inverse() @ other @ T).log()
    near = np.linalg.norm(off[:3]) < how.shift * view.depth and np.linalg.norm(off[3:6]) < how.turn_rad
    return bool(near and abs(off[6]) < how.log_scale)


def _merged(whole: SparseMap, other: SparseMap, S: Sim3) -> SparseMap:
    """Both maps in the frame of the first; a track that both hold keeps its point there."""
    poses = {}
    for key, T in other.T_map_cam.items():
        placed = S @ Sim3.from_matrix(T)
        poses[key] = Sim3(np.ones(()), placed.rotation, placed.translation).as_matrix()
    fresh = {n: S.apply(xyz) for n, xyz in other.points.items() if n not in whole.points}
    seen = {key: _without(view, whole.points) for key, view in other.seen.items()}
    return replace(
        whole,
        T_map_cam=whole.T_map_cam | poses,
        points=whole.points | fresh,
        seen=dict(whole.seen) | seen,
    )


def _without(view: KeyframeView, points: Mapping[int, Array]) -> KeyframeView:
    return view.where([k for k, n in enumerate(view.ids.tolist()) if n not in points])
