"""Frames of a map with their features, and which of them may overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.features.vlad import describe_rooted
from list3r.reconstruction.sfm.keyframe_features import LocalFeatures
from list3r.reconstruction.sfm.mapping import SparseMap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MapView:
    """One frame of a map."""

    key: int
    T_map_cam: Array
    """Shape (4, 4)."""
    features: LocalFeatures
    descriptor: NDArray[np.float32]
    """Unit descriptor of the whole frame. Shape (D,)."""
    points_cam: Array
    """Features in camera coordinates, map units, NaN where the map has no point. Shape (N, 3)."""
    seen_cam: Array
    """All points of the map that it sees, by features or corners, in camera coordinates. Shape (M, 3)."""

    @property
    def depth(self) -> float:
        """Median depth of the points that it sees, map units; 1 without any."""
        return float(np.median(self.seen_cam[:, 2])) if len(self.seen_cam) else 1.0


def view_of(key: int, found: SparseMap, features: LocalFeatures, first_id: int) -> MapView:
    """Return a keyframe of a map, whose features are numbered from `first_id` on."""
    T, seen = found.T_map_cam[key], found.seen[key]
    places = np.array([found.points[int(n)] for n in seen.ids], np.float64).reshape(-1, 3)
    cam = (places - T[:3, 3]) @ T[:3, :3]
    row = seen.ids - first_id
    own = (row >= 0) & (row < len(features.xy))
    points = np.full((len(features.xy), 3), np.nan)
    points[row[own]] = cam[own]
    return MapView(key, T, features, describe_rooted(features.descriptors), points, cam)


def shared_views(views: Sequence[MapView], camera: Camera, sample: int = 48, margin: float = 0.15) -> Array:
    """Return the share of each view's points inside the picture of each other one, the lesser of both directions.
    Shape (V, V).

    The `margin` of the picture on every side does not count, since poses have drifted; points behind a wall do.
    """
    share = np.zeros((len(views), len(views)))
    T = np.linalg.inv(np.stack([v.T_map_cam for v in views]))
    low, high = np.array([margin, 1.0 - margin])[:, None] * np.array([camera.width, camera.height])
    for k, view in enumerate(views):
        if not len(view.seen_cam):
            continue
        points = view.seen_cam[:: max(1, len(view.seen_cam) // sample)]
        world = points @ view.T_map_cam[:3, :3].T + view.T_map_cam[:3, 3]
        there = np.einsum("vij,nj->vni", T[:, :3, :3], world) + T[:, None, :3, 3]
        z = np.maximum(there[..., 2], 1e-9)
        at = there[..., :2] / z[..., None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        inside = (there[..., 2] > 0) & (at > low).all(axis=-1) & (at < high).all(axis=-1)
        share[k] = inside.mean(axis=1)
    return np.asarray(np.minimum(share, share.T))
