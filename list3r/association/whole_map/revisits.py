"""Frames of a map, not neighbours in time, that overlap: proposed by pose and descriptor, decided by geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.whole_map.settings import RevisitPairSettings
from list3r.association.whole_map.views import MapView, shared_views
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.reconstruction.sfm.frame_poses import pose_of
from list3r.reconstruction.sfm.keyframe_features import match_features
from list3r.reconstruction.sfm.settings import LEAST_MATCHES

Array = NDArray[np.float64]
Pair = tuple[int, int]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Revisit:
    """Two overlapping views, by their rows."""

    a: int
    b: int
    S_b_a: Sim3
    """From a's camera to b's; the scale is the map's drift between them."""
    inliers: int


def candidate_pairs(views: Sequence[MapView], camera: Camera, settings: RevisitPairSettings) -> list[Pair]:
    """Return pairs of views that may overlap, by their rows, the smaller first."""
    count = len(views)
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) >= settings.apart
    forward = np.stack([v.T_map_cam[:3, 2] for v in views])
    turned = forward @ forward.T > np.cos(np.deg2rad(settings.most_turn_deg))
    share = np.where(apart & turned, shared_views(views, camera), 0.0)
    descriptors = np.stack([v.descriptor for v in views]).astype(np.float64)
    cosine = np.where(apart, descriptors @ descriptors.T, -1.0)
    found: set[Pair] = set()
    for k in range(count):
        best = np.argsort(-share[k], kind="stable")[: settings.partners]
        chosen = best[share[k, best] >= settings.least_shared].tolist()
        chosen += np.argsort(-cosine[k], kind="stable")[: settings.alike].tolist()
        found |= {(min(k, n), max(k, n)) for n in chosen if apart[k, n]}
    return sorted(found)


def find_revisits(
    views: Sequence[MapView], camera: Camera, settings: RevisitPairSettings
) -> tuple[list[Revisit], dict[Pair, Rows]]:
    """Revisits consistent with the map's drift between, and the rows of the features (M, 2) of each."""
    places = np.stack([v.T_map_cam[:3, 3] for v in views])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    out, common = [], {}
    for a, b in candidate_pairs(views, camera, settings):
        rows = match_features(views[a].features, views[b].features)
        if len(rows) < LEAST_MATCHES:
            continue
        at_a, at_b = rows.T
        sides = views[a].points_cam[at_a], views[b].features.xy[at_b], views[b].points_cam[at_b]
        found = relation(*sides, camera, settings)
        if found is not None and _fits(found.S_b_a, views[a], views[b], (b - a, float(way[b] - way[a])), settings):
            out.append(Revisit(a, b, found.S_b_a, found.inliers))
            common[a, b] = rows
    return out, common


def seen_again(
    views: Sequence[MapView], camera: Camera, revisits: Sequence[Revisit], settings: RevisitPairSettings
) -> list[Revisit]:
    """Return the revisits between whose views some view hardly overlaps the first one."""
    share = shared_views(views, camera)
    return [r for r in revisits if share[r.a, r.a + 1 : r.b].min(initial=1.0) < settings.away]


@dataclass(frozen=True)
class ViewRelation:
    """The relation of two views."""

    S_b_a: Sim3
    """From a's camera to b's, the scale from points of both maps; 1 where these are too few."""
    inliers: int
    """Features that agree."""
    least_scale_points: bool


def relation(
    points_a: Array, xy_b: NDArray[np.float32], points_b: Array, camera: Camera, settings: RevisitPairSettings
) -> ViewRelation | None:
    """Return the relation of two views from points of a, (M, 3) in its camera coordinates, their pixels in b, (M, 2),
    and the same points of b's map, (M, 3) in b's camera; NaN where unknown."""
    known = np.isfinite(points_a[:, 0])
    points, xy_b, points_b = points_a[known], xy_b[known], points_b[known]
    found = pose_of(xy_b, points, camera, None, settings.pose)
    if found is None:
        return None
    T_b_a, agree = np.asarray(np.linalg.inv(found[0]), np.float64), found[1]
    there = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    own = points_b[:, 2]
    both = agree & np.isfinite(own) & (own > 0) & (there[:, 2] > 0)
    enough = bool(both.sum() >= settings.least_scale_points)
    scale = float(np.exp(np.median(np.log(own[both] / there[both, 2])))) if enough else 1.0
    return ViewRelation(Sim3(np.asarray(scale), T_b_a[:3, :3], scale * T_b_a[:3, 3]), int(agree.sum()), enough)


def _fits(S_b_a: Sim3, a: MapView, b: MapView, between: tuple[int, float], s: RevisitPairSettings) -> bool:
    """Return whether a revisit is within the map's possible drift along `between`: frames, and map units."""
    count, way = between
    off = (S_b_a.inverse() @ Sim3.from_matrix(np.linalg.inv(b.T_map_cam) @ a.T_map_cam)).log()
    return bool(
        np.linalg.norm(off[:3]) < s.shift[0] * a.depth + s.shift[1] * way
        and np.linalg.norm(off[3:6]) < s.turn_rad[0] + s.turn_rad[1] * count
        and abs(off[6]) < s.log_scale[0] + s.log_scale[1] * count
    )
