"""Poses of the frames between the keyframes, from the map's points of their corners."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.poses import small_motion
from list3r.reconstruction.sfm.colmap import inverse, make_lens, matrix_of, pixel_unit, pycolmap
from list3r.reconstruction.sfm.kernels import pose_equations
from list3r.reconstruction.sfm.mapping import Poses, SparseMap
from list3r.reconstruction.sfm.settings import SEED, FramePoseSettings
from list3r.reconstruction.sfm.tracks import CornerTracks, Gray

Floats = NDArray[np.float32]


@dataclass
class PosedSegment:
    """Frames posed in one map."""

    found: SparseMap
    T_map_cam: dict[int, Poses]
    """By position in the chunk."""
    seen: dict[int, tuple[Floats, NDArray[np.float64]]]
    """Pixels of the map's points in each frame, (N, 2), and the points, (N, 3) map coordinates."""

    def depths(self, position: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (N, 2) and depths (N,), map units, of the points seen in a frame."""
        xy, points = self.seen[position]
        T_cam_map = np.linalg.inv(self.T_map_cam[position])
        z = points @ T_cam_map[2, :3] + T_cam_map[2, 3]
        return xy[z > 0].astype(np.float64), z[z > 0]


def pose_segments(
    maps: Sequence[SparseMap],
    tracks: CornerTracks,
    grays: Sequence[Gray],
    settings: FramePoseSettings | None = None,
    *,
    adjusted: bool = False,
) -> list[PosedSegment]:
    """Pose all frames that can be posed in one of the maps, each in the first that holds it; largest segment first.

    Keyframes that are `adjusted` keep their poses.
    """
    chosen = settings or FramePoseSettings()
    left = set(range(len(grays)))
    segments = []
    for found in maps:
        segment = _fill(found, tracks, sorted(left), chosen, adjusted)
        _bridge(segment, grays, sorted(left), chosen)
        left -= set(segment.T_map_cam)
        segments.append(segment)
    segments = [s for s in segments if len(s.T_map_cam) >= 2]
    return sorted(segments, key=lambda s: (-len(s.T_map_cam), min(s.T_map_cam)))


def _fill(
    found: SparseMap, tracks: CornerTracks, positions: Iterable[int], settings: FramePoseSettings, adjusted: bool
) -> PosedSegment:
    numbers = np.array([*sorted(found.points), np.iinfo(np.int64).max], np.int64)
    places = np.array([found.points[int(n)] for n in numbers[:-1]]).reshape(-1, 3)
    segment = PosedSegment(found, {}, {})
    registered = sorted(found.T_map_cam)
    for position in positions:
        row = np.minimum(np.searchsorted(numbers, tracks.ids[position]), len(numbers) - 1)
        known = numbers[row] == tracks.ids[position]
        xy, points = tracks.xy[position][known], places[row[known]]
        if position in found.seen:
            xy, points = _with_features(found, position, tracks, xy, points)
        if adjusted and position in found.T_map_cam:
            segment.T_map_cam[position], segment.seen[position] = found.T_map_cam[position], (xy, points)
            continue
        start = segment.T_map_cam.get(position - 1)
        if position in found.T_map_cam or start is None:
            start = found.T_map_cam[min(registered, key=lambda k: (abs(k - position), k))]
        posed = pose_of(xy, points, found.camera, start, settings)
        if posed is not None:
            segment.T_map_cam[position] = posed[0]
            segment.seen[position] = xy[posed[1]], points[posed[1]]
        elif position in found.T_map_cam and len(xy) == 0:
            segment.T_map_cam[position] = found.T_map_cam[position]
            segment.seen[position] = xy, points
    return segment


def _with_features(
    found: SparseMap, position: int, tracks: CornerTracks, xy: Floats, points: NDArray[np.float64]
) -> tuple[Floats, NDArray[np.float64]]:
    """Return the map's points that a keyframe sees by its corners, and those by other features."""
    seen = found.seen[position]
    rows = np.flatnonzero(~np.isin(seen.ids, tracks.ids[position])).tolist()
    if not rows:
        return xy, points
    others = seen.where(rows)
    places = np.array([found.points[int(n)] for n in others.ids]).reshape(-1, 3)
    return np.concatenate([xy, others.xy]), np.concatenate([points, places])


def pose_of(
    xy: Floats, points: NDArray[np.float64], camera: Camera, start: Poses | None, settings: FramePoseSettings
) -> tuple[Poses, NDArray[np.bool_]] | None:
    """T_map_cam from points (N, 3) and their pixels (N, 2), and the inliers; None when too few agree.

    From `start` by robust refinement; where that fails, or without one, by sampling.
    """
    if len(xy) < settings.least_matches:
        return None
    lens, px = make_lens(camera, ""), xy.astype(np.float64) + 0.5
    gate = settings.pose_error_px * pixel_unit(camera)
    if start is not None:
        found = _refined(px, points, camera, start, np.ones(len(px), bool), settings)
        if found is not None and found[1].mean() > settings.refined_share:
            return found
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed, options.ransac.num_threads = gate, SEED, 1
    guess = pycolmap.estimate_and_refine_absolute_pose(px, points, lens, options)
    if guess is None or guess["num_inliers"] < settings.least_matches:
        return None
    T = inverse(matrix_of(guess["cam_from_world"]))
    found = _refined(px, points, camera, T, np.asarray(guess["inlier_mask"], bool), settings)
    return found if found is not None and found[1].mean() > settings.sampled_share else None


_ITERATIONS, _ROUNDS = 3, 6
"""Steps of a refinement, after which inliers are selected again, until they no longer change, and the most such rounds.
The last steps to a minimum change the error of a path by hundredths of a millimetre (research/speed 0183)."""


def _refined(
    px: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: Camera,
    start: Poses,
    rows: NDArray[np.bool_],
    settings: FramePoseSettings,
) -> tuple[Poses, NDArray[np.bool_]] | None:
    """Return the pose by Gauss-Newton from `start`, and the inliers; None when too few agree."""
    T_cam_map, lens = inverse(start), np.array([camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5])
    gate, scale = settings.pose_error_px * pixel_unit(camera), 0.5 * pixel_unit(camera)
    for _ in range(_ROUNDS):
        for _ in range(_ITERATIONS):
            information, gradient = pose_equations(T_cam_map, px, points, rows, lens, scale)
            try:
                T_cam_map = small_motion(-np.linalg.solve(information, gradient)) @ T_cam_map
            except np.linalg.LinAlgError:
                return None
        seen = points @ T_cam_map[:3, :3].T + T_cam_map[:3, 3]
        z = np.maximum(seen[:, 2], 1e-9)
        at = seen[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx + 0.5, camera.cy + 0.5)
        before, rows = rows, (seen[:, 2] > 0) & (np.linalg.norm(at - px, axis=1) < gate)
        if rows.sum() < settings.least_inliers:
            return None
        if np.array_equal(rows, before):
            break
    return inverse(T_cam_map), rows


def _bridge(
    segment: PosedSegment, grays: Sequence[Gray], positions: Sequence[int], settings: FramePoseSettings
) -> None:
    """Pose frames that lost their corners, in place, by tracking the map's points that the neighbours see."""
    posed = sorted(segment.T_map_cam)
    for before, behind in pairwise(posed):
        gap = range(before + 1, behind)
        if not 0 < len(gap) <= settings.bridge:
            continue
        for position in gap:
            near = before if position - before <= behind - position else behind
            if position in positions:
                _look_for(segment, grays, near, position, settings)


def _look_for(
    segment: PosedSegment, grays: Sequence[Gray], near: int, position: int, settings: FramePoseSettings
) -> None:
    xy, points = segment.seen[near]
    if len(xy) < settings.least_matches:
        return
    size = (settings.bridge_window_px, settings.bridge_window_px)
    a, b = grays[near], grays[position]
    place, found, _ = cv2.calcOpticalFlowPyrLK(a, b, xy, np.zeros_like(xy), winSize=size, maxLevel=5)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(b, a, place, np.zeros_like(xy), winSize=size, maxLevel=5)
    place = np.asarray(place, np.float32)
    good = (
        (found.ravel() > 0)
        & (returned.ravel() > 0)
        & (np.linalg.norm(np.asarray(back) - xy, axis=1) < settings.bridge_return_px)
    )
    made = pose_of(place[good], points[good], segment.found.camera, segment.T_map_cam[near], settings)
    if made is not None and made[1].mean() > settings.bridged_share:
        segment.T_map_cam[position] = made[0]
        segment.seen[position] = place[good][made[1]], points[good][made[1]]
