"""Find movers in free space: surfaces that were in one place for a part of a chunk only, as other frames see through.

A point of frame i that frame j sees through, to a surface behind, was not there at j. Frames spread evenly over the
chunk are compared, so that an object that is taken away is also found in the frames before it moved. This needs poses
and depth alone, so given and estimated poses are served alike; the movers of the odometry are hints, because the middle
of an object that sways is never seen through.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.motion.settings import FreeSpaceMoverSettings
from list3r.reconstruction.rgbd.view import Floats

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SmallFrames:
    """Depth images of a chunk, every n-th pixel, with their poses."""

    camera: Camera
    depth: Floats
    """Metres, 0 where unknown. Shape (F, h, w)."""
    T_chunk_cam: NDArray[np.float64]
    """Shape (F, 4, 4)."""
    posed: Mask
    """Shape (F,)."""
    stride: int
    """Subsampling of the whole image: every n-th pixel."""

    @staticmethod
    def of(
        depths: Sequence[Floats | None], T_chunk_cam: NDArray[np.float64], posed: Mask, camera: Camera, width: int
    ) -> SmallFrames:
        """Subsample the depth images; those without depth are not posed."""
        stride = max(1, round(camera.width / width))
        small = camera.every(stride)
        depth = np.zeros((len(depths), small.height, small.width), np.float32)
        for k, image in enumerate(depths):
            if image is not None:
                depth[k] = image[::stride, ::stride]
        usable = posed & np.array([d is not None for d in depths], bool)
        return SmallFrames(small, depth, T_chunk_cam, usable, stride)


def movers_in_free_space(
    frames: SmallFrames, hints: Mapping[int, Mask] | None = None, settings: FreeSpaceMoverSettings | None = None
) -> NDArray[np.bool_] | None:
    """Return the movers of each frame, at the size of the small frames; None without any. Shape (F, h, w).

    `hints` are masks of any size by position: the movers of the odometry.
    """
    s, hints = settings or FreeSpaceMoverSettings(), hints or {}
    ask = _References(frames, s)
    posed = np.flatnonzero(frames.posed).tolist()
    if not hints:
        searched = posed[:: s.search_step]
        hits = [p for p in searched if ask.anything(p)]
        if sum(bool(ask.moving(p, None).any()) for p in hits) < min(s.search_frames, len(searched)):
            return None
    out = np.zeros(frames.depth.shape, bool)
    for position in posed:
        hint = hints.get(position)
        size = (frames.camera.width, frames.camera.height)
        hinted = None if hint is None else cv2.resize(hint.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        out[position] = ask.moving(position, hinted)
    for order in (posed, posed[::-1]):
        for before, position in itertools.pairwise(order):
            if out[before].any():
                out[position] |= ask.continued(position, out[before] & ~out[position], frames.depth[before])
    return out if out.any() else None


class _References:
    """The frames in which seeing through is tested."""

    def __init__(self, frames: SmallFrames, settings: FreeSpaceMoverSettings) -> None:
        self._frames, self._s = frames, settings
        posed = np.flatnonzero(frames.posed)
        chosen = np.unique(np.linspace(0, len(posed) - 1, min(settings.references, len(posed))).round().astype(int))
        self._positions = posed[chosen].tolist()
        window = np.ones((settings.clear, settings.clear), np.uint8)
        self._nearest = {p: cv2.erode(frames.depth[p], window) for p in self._positions}
        self._known: dict[int, tuple[Mask, Mask]] = {}
        self._T_cam_chunk = {p: np.linalg.inv(frames.T_chunk_cam[p]) for p in self._positions}

    def anything(self, position: int) -> bool:
        """Return whether a coarse test finds anything that was seen through."""
        through, _ = self._ask(position, 2)
        solid = cv2.morphologyEx(through.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        return bool(solid.sum() >= self._s.least_share * through.size)

    def moving(self, position: int, hint: Mask | None) -> Mask:
        """Movers of a frame: surfaces, or their parts not seen to stay, of which enough was seen through."""
        s, depth = self._s, self._frames.depth[position]
        through, stays = self._ask(position, 1)
        whole = _whole(depth, s)
        out = np.zeros(depth.shape, bool)
        out |= _chosen(whole, whole, through, stays, s.part, s)
        out |= _chosen(whole & ~stays, whole, through, stays, s.part, s)
        if hint is not None and hint.any():
            out |= _chosen(whole & hint, whole, through, stays, s.hinted, s)
        if not out.any():
            return out
        return np.asarray(cv2.morphologyEx(out.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0)

    def continued(self, position: int, before: Mask, depth_before: Floats) -> Mask:
        """Movers of a frame that continue those of an adjacent frame: surfaces that mostly overlap it at equal depth,
        so that an object that is static for a while is not lost."""
        s, depth = self._s, self._frames.depth[position]
        out = np.zeros(depth.shape, bool)
        if before.sum() < s.least_share * before.size:
            return out
        near = before & (np.abs(depth - depth_before) < 0.1 * depth)
        through, stays = self._ask(position, 1)
        whole = _whole(depth, s)
        for region in (whole, whole & ~stays, whole & near):
            count, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=4)
            gone, kept, held = (
                np.bincount(labels.ravel(), image.ravel(), minlength=count) for image in (through, stays, near)
            )
            area = stats[:, cv2.CC_STAT_AREA]
            good = (gone >= s.hinted * (gone + kept)) & (held >= s.continued * area)
            if region is whole:
                good |= held >= s.surely_continued * area
            good &= area >= s.least_share * region.size
            good[0] = False
            out |= good[labels]
        return out

    def _ask(self, position: int, step: int) -> tuple[Mask, Mask]:
        """Return which pixels were seen through, and which were seen to stay. Shapes (h, w), subsampled by `step`.

        Pixels that are seen through and later, farther from the frame in time, seen again were never seen through: so
        bad readings and wrong poses are not taken for objects that came or went.
        """
        if step == 1 and position in self._known:
            return self._known[position]
        s, frames = self._s, self._frames
        depth = frames.depth[position][::step, ::step]
        shape = depth.shape
        known = np.flatnonzero(depth.ravel() > 0)
        points = _points(depth, frames.camera, step).reshape(-1, 3)[known]
        stays, back = np.zeros(len(known), bool), np.zeros(len(known), bool)
        votes, asked = np.zeros(len(known), np.int8), np.zeros(len(known), np.int8)
        for side in (-1, 1):
            gone = np.zeros(len(known), bool)
            for other in self._references_after(position, side):
                behind, same, seen = self._compare(points, position, other)
                back |= gone & same
                gone |= behind
                votes += behind
                asked += seen
                stays |= same & ~gone
        through = (votes > 0) & ~back & ((votes >= s.votes) | (asked <= s.votes))
        stays = (stays | back) & ~through
        found = _image(through, known, shape), _image(stays, known, shape)
        if step == 1:
            self._known[position] = found
        return found

    def _references_after(self, position: int, side: int) -> list[int]:
        near = [p for p in self._positions if side * (p - position) > 0]
        return near if side > 0 else near[::-1]

    def _compare(self, points: Floats, position: int, other: int) -> tuple[Mask, Mask, Mask]:
        """Compare points of a frame, in its camera, with another's depth: surface behind them, the same one, any."""
        s, camera = self._s, self._frames.camera
        T = self._T_cam_chunk[other] @ self._frames.T_chunk_cam[position]
        p = points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        z = p[:, 2]
        safe = np.maximum(z, np.float32(0.05))
        u = np.rint(p[:, 0] / safe * np.float32(camera.fx) + np.float32(camera.cx))
        v = np.rint(p[:, 1] / safe * np.float32(camera.fy) + np.float32(camera.cy))
        inside = (z > 0.05) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        at = np.where(inside, v * camera.width + u, 0).astype(np.int64)
        near, read = self._nearest[other].ravel()[at], self._frames.depth[other].ravel()[at]
        apart = read - z
        seen = inside & (read > 0)
        noise = s.through_sigma * s.noise.sigma(z) + np.float32(s.poses * _disagreement(apart[seen], z[seen], s))
        behind = near > z + (np.float32(s.through_m) + np.float32(s.through_share) * z + noise)
        same = np.abs(apart) < np.float32(s.same_m) + np.float32(s.same_share) * z + noise
        return inside & behind, seen & same, seen


def _disagreement(apart: Floats, z: Floats, s: FreeSpaceMoverSettings) -> float:
    """Return the disagreement of two frames on static surfaces, metres beyond noise: the error of their poses."""
    few = slice(None, None, max(1, len(apart) // 1000))
    near = np.abs(apart[few]) < s.near_share * z[few]
    if near.sum() < 20:
        return 0.0
    return max(0.0, float(np.median(np.abs(apart[few][near]) - s.noise.sigma(z[few][near]))))


def _chosen(region: Mask, whole: Mask, through: Mask, stays: Mask, part: float, s: FreeSpaceMoverSettings) -> Mask:
    """The connected parts of a region of which a share of the compared pixels was seen through, and that are not
    embedded in a static surface."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=4)
    area, least = stats[:, cv2.CC_STAT_AREA], s.least_share * region.size
    gone = np.bincount(labels.ravel(), through.ravel(), minlength=count)
    kept = np.bincount(labels.ravel(), stays.ravel(), minlength=count)
    good = (area >= least) & (gone >= np.maximum(part * (gone + kept), 0.3 * least)) & (gone >= 0.2 * part * area)
    good[0] = False
    if not good.any():
        return np.zeros(region.shape, bool)
    rim, embedded = np.zeros(count), np.zeros(count)
    for here, there in (np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1]):
        for a, b in ((here, there), (there, here)):
            border = (labels[a] > 0) & (labels[a] != labels[b])
            rim += np.bincount(labels[a][border], minlength=count)
            within = border & stays[b] & whole[b]
            embedded += np.bincount(labels[a][within], minlength=count)
    good &= embedded <= s.embedded * rim
    return np.asarray(good[labels])


def _whole(depth: Floats, s: FreeSpaceMoverSettings) -> Mask:
    """Pixels without a depth step to their neighbours."""
    limit = np.float32(s.edge_share) * depth + 3 * s.noise.sigma(depth)
    whole = depth > 0
    across, down = np.abs(np.diff(depth, axis=1)) > limit[:, 1:], np.abs(np.diff(depth, axis=0)) > limit[1:]
    whole[:, 1:] &= ~across
    whole[1:] &= ~down
    return np.asarray(whole)


def _points(depth: Floats, camera: Camera, step: int) -> Floats:
    """Points in the camera of every `step`-th pixel. Shape (h, w, 3)."""
    x = (np.arange(depth.shape[1]) * step - camera.cx) / camera.fx
    y = (np.arange(depth.shape[0]) * step - camera.cy) / camera.fy
    return np.stack([depth * x[None].astype(np.float32), depth * y[:, None].astype(np.float32), depth], axis=-1)


def _image(values: Mask, at: NDArray[np.int64], shape: tuple[int, ...]) -> Mask:
    out = np.zeros(shape[0] * shape[1], bool)
    out[at] = values
    return out.reshape(shape[0], shape[1])
