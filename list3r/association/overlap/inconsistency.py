"""Measure how far apart two chunks place a region, against the static regions (paper 3.2 and A.3).

A region moves when the two chunks place it differently from its surroundings. The paper measures that in pixels,

    delta(o) = mean over p in Omega_o of | pi(S_v_u P_u(p)) - phi_uv(p) |,

with phi_uv(p) = p on shared frames. A pixel residual is blind to displacement along the ray, which is most of a moving
object's displacement there (its rays are given by the frame), so displacement along the ray is measured too, as a share
of depth. Both are compared with those of the static regions, never with a fixed limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.association.overlap.regions import EdgeSupportSettings, Floats, Ints, Mask, Regions, weighted_quantile
from list3r.association.overlap.shared_points import Pairs, moved
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3


@dataclass(frozen=True)
class Displacement:
    """Distance at which the two chunks place each of N pairs."""

    share: Floats
    """In the camera of v, as a share of the depth. Shape (N, 3)."""
    delta_px: Floats
    """In the picture. Shape (N,)."""
    sure: Mask
    """Pairs with enough confidence. Shape (N,)."""
    rest: Mask
    """Confident pairs that were not removed. Shape (N,)."""


@dataclass(frozen=True)
class Inconsistency:
    """Displacement of each of R regions between the two chunks."""

    delta_px: Floats
    """The paper's delta. Shape (R,)."""
    excess: Floats
    """Displacement over the largest one of static regions; 0 with too few pairs. Shape (R,)."""

    @property
    def moving(self) -> Mask:
        """Shape (R,)."""
        return np.asarray(self.excess > 1.0)


def displacement(pairs: Pairs, S_v_u: Sim3, camera: Camera, sure: Mask, removed: Mask) -> Displacement:
    """Measure how far apart the two chunks place each pair.

    A frame's pose error displaces all its points and is no motion, so points are compared in the camera of their frame,
    each chunk's by its own pose, after the frame's common change of scale is removed; where the poses of the two chunks
    agree worse than their points do, in chunk v.
    """
    off_world = moved(pairs.T_cam_v, S_v_u.apply(pairs.p_u)) - pairs.cam_v
    depth = np.maximum(pairs.cam_v[:, 2], 1e-9)
    delta = np.linalg.norm(_pixels(off_world + pairs.cam_v, camera) - _pixels(pairs.cam_v, camera), axis=1)
    delta = np.minimum(delta, np.hypot(camera.width, camera.height))
    rest = sure & ~removed
    off = relative_to_frame(pairs, S_v_u, rest)
    if _typical(off, depth, rest) > _typical(off_world, depth, rest):
        off = off_world
    return Displacement(off / depth[:, None], delta, sure, rest)


def inconsistency(
    off: Displacement, regions: Regions, frame: Ints, camera: Camera, settings: EdgeSupportSettings
) -> Inconsistency:
    """Return each region's displacement, and its ratio to the largest one of static regions. `frame` has shape (N,)."""
    sure, rest = off.sure, off.rest
    medians, row, weight = _by_region_and_frame(off.share, regions, frame, sure)
    total = np.maximum(np.bincount(row, weight, len(regions.count)), 1e-12)
    focal = np.array([camera.fx, camera.fy])
    across = np.bincount(row, weight * np.linalg.norm(medians[:, :2] * focal, axis=1), len(regions.count)) / total
    along = np.bincount(row, weight * np.abs(medians[:, 2]), len(regions.count)) / total
    judged = np.bincount(regions.of_pair, sure, len(regions.count)) >= settings.least_region_pairs
    still = np.bincount(regions.of_pair, rest, len(regions.count))
    limit_across = _limit(across, still, judged, settings, settings.least_pixels * camera.width)
    limit_along = _limit(along, still, judged, settings, settings.least_depth)
    mean_delta = np.bincount(regions.of_pair, off.delta_px * sure, len(regions.count)) / np.maximum(
        np.bincount(regions.of_pair, sure, len(regions.count)), 1
    )
    excess = np.where(judged, np.maximum(across / limit_across, along / limit_along), 0.0)
    return Inconsistency(mean_delta, excess)


def relative_to_frame(pairs: Pairs, S_v_u: Sim3, rest: Mask) -> Floats:
    """Return points of u against those of v in camera of their frame, each by its own chunk's pose. Shape (N, 3)."""
    cam_u = moved(pairs.T_cam_u, pairs.p_u)
    ratio = np.log(np.maximum(pairs.cam_v[:, 2], 1e-9) / np.maximum(cam_u[:, 2], 1e-9))
    frames, which = np.unique(pairs.frame, return_inverse=True)
    common = np.full(len(frames), np.log(float(S_v_u.scale)))
    for k in range(len(frames)):
        mine = ratio[(which == k) & rest]
        if len(mine) >= 8:
            common[k] = np.median(mine)
    return np.asarray(np.exp(common[which.ravel()])[:, None] * cam_u - pairs.cam_v)


def _by_region_and_frame(share: Floats, regions: Regions, frame: Ints, sure: Mask) -> tuple[Floats, Ints, Floats]:
    """Return the median displacement of each region in each frame, its region, and its number of pairs."""
    pick = np.flatnonzero(sure)
    _, place = np.unique(frame[pick], return_inverse=True)
    key = regions.of_pair[pick] * (int(place.max()) + 1) + place.ravel()
    order = np.argsort(key, kind="stable")
    bounds = np.flatnonzero(np.diff(key[order], prepend=-1, append=-1))
    start, size = bounds[:-1], np.diff(bounds)
    medians = np.empty((len(start), 3))
    for axis in range(3):
        ascending = share[pick[np.lexsort((share[pick, axis], key))], axis]
        medians[:, axis] = (ascending[start + (size - 1) // 2] + ascending[start + size // 2]) / 2.0
    return medians, regions.of_pair[pick[order[start]]], size.astype(np.float64)


def _limit(
    value: Floats, still: NDArray[np.signedinteger], judged: Mask, settings: EdgeSupportSettings, least: float
) -> float:
    """Return the largest displacement of a static region, from the regions that were not removed."""
    vote = np.asarray(np.sqrt(still) * judged, np.float64)
    if not vote.any():
        return float("inf")
    middle = weighted_quantile(value, vote, 0.5)
    deviation = 1.4826 * weighted_quantile(np.abs(value - middle), vote, 0.5)
    return max(settings.factor * middle, middle + settings.deviations * deviation, least)


def _pixels(cam: Floats, camera: Camera) -> Floats:
    """Return the pinhole projection, px; a point behind the camera projects far outside. Shape (N, 3) -> (N, 2)."""
    depth = np.maximum(cam[:, 2:], 1e-6)
    return np.asarray(cam[:, :2] / depth * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def _typical(off: Floats, depth: Floats, rest: Mask) -> float:
    return float(np.median(np.linalg.norm(off[rest], axis=1) / depth[rest])) if rest.any() else 0.0
