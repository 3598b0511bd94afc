"""Masks followed through a chunk by re-projection with a depth check (paper 3.1, A.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.compiled import compiled
from list3r.frames.base import Frame
from list3r.instances.base import Proposals
from list3r.instances.geometric.features import mean_feature
from list3r.instances.geometric.kernels import label_runs, without_lone
from list3r.instances.geometric.support import collect_supports
from list3r.instances.geometric.views import ChunkViews, chunk_views
from list3r.instances.separation import cannot_link_pairs
from list3r.instances.settings import InstanceSettings
from list3r.instances.tracking.joining import join_candidates, warp_labels
from list3r.memory.core.records import LocalInstance, LocalLibrary, MaskTrack, Support
from list3r.reconstruction.base import Reconstruction

Ints = NDArray[np.int64]

SAMPLES = 150
"""Support points of an instance that are projected into every frame."""


class CodedMask(NamedTuple):
    """One instance in one frame, at the size of the colour image."""

    runs: NDArray[np.uint32]
    area: int
    box: tuple[float, float, float, float]
    center: tuple[float, float]


@dataclass
class GrowingTrack:
    """The growing track of one instance."""

    frames: list[int] = field(default_factory=list)
    masks: list[CodedMask] = field(default_factory=list)
    visible: list[float] = field(default_factory=list)
    agreement: list[float] = field(default_factory=list)


def mask_track(frames: ArrayLike, masks: Sequence[CodedMask], visible: ArrayLike, size: tuple[int, int]) -> MaskTrack:
    """Return a track as it is kept: `size` is (height, width) of its masks."""
    runs, areas, boxes, centers = zip(*masks, strict=True)
    return MaskTrack(
        np.array(frames, np.int64),
        np.array(boxes, np.float32),
        np.array(centers, np.float32),
        np.array(areas, np.int32),
        np.array(visible, np.float32),
        runs,
        size,
    )


class ReprojectionTracker:
    """Follows every candidate through the chunk along the chunk's own geometry."""

    def __init__(self, settings: InstanceSettings | None = None) -> None:
        self.settings = settings or InstanceSettings()

    def __call__(
        self,
        frames: Sequence[Frame],
        reconstruction: Reconstruction,
        proposals: Sequence[Proposals],
        feature_space: str,
    ) -> LocalLibrary:
        """Join the candidates, follow them through every posed frame, keep the tracks that are stable."""
        views = chunk_views(frames, reconstruction, self.settings)
        joined = join_candidates(views, proposals)
        count = max((int(j.max()) + 1 for j in joined if len(j)), default=0)
        images = [_instance_image(views, p, j) for p, j in zip(proposals, joined, strict=True)]
        supports = collect_supports(views, proposals, images, count, self.settings.track.support_points)
        positions = np.array([p.position for p in proposals], np.int64)

        def labels_of(position: int) -> NDArray[np.int32]:
            return frame_labels(views, proposals, images, positions, position)

        return LabelledChunk(views, proposals, joined, supports, self.settings).library(labels_of, feature_space)


@dataclass(frozen=True)
class LabelledChunk:
    """Candidates that were given to instances, and the instances' supports: the last step of every tracker."""

    views: ChunkViews
    proposals: Sequence[Proposals]
    joined: Sequence[NDArray[np.int64]]
    """Instance of each candidate of each anchor, -1 for none."""
    supports: Sequence[Support]
    """One for each instance."""
    settings: InstanceSettings

    def library(self, labels_of: Callable[[int], NDArray[np.int32]], feature_space: str) -> LocalLibrary:
        """Return the stable tracks.

        `labels_of` gives instance + 1 of each pixel of a frame at working size, by position.
        """
        posed = np.flatnonzero(self.views.reconstruction.posed).tolist()
        return self._library(self.follow(labels_of, posed), feature_space)

    def follow(self, labels_of: Callable[[int], NDArray[np.int32]], positions: Sequence[int]) -> list[GrowingTrack]:
        """Return where each instance is seen among the frames at some positions."""
        views, supports = self.views, self.supports
        tracks = [GrowingTrack() for _ in supports]
        samples, owner = _sample_supports(supports)
        settings, camera = self.settings.track, views.reconstruction.camera
        min_area = settings.min_area_px * camera.width * camera.height / (640 * 480)
        for position in positions:
            labels = labels_of(position)
            seen, hit = _look_for(views, position, labels, samples, owner=owner, count=len(supports))
            runs = encode_labels(labels, views.stride, (camera.height, camera.width))
            for instance, mask in runs.items():
                if mask.area < min_area:
                    continue
                track = tracks[instance]
                track.frames.append(int(views.reconstruction.frame_indices[position]))
                track.masks.append(mask)
                track.visible.append(float(seen[instance]))
                track.agreement.append(float(hit[instance]))
        return tracks

    def _library(self, tracks: Sequence[GrowingTrack], feature_space: str) -> LocalLibrary:
        views = self.views
        size = (views.reconstruction.camera.height, views.reconstruction.camera.width)
        posed = int(views.reconstruction.posed.sum())
        least = self.settings.track.least_frames(posed)
        instances: list[LocalInstance] = []
        for number, (track, support) in enumerate(zip(tracks, self.supports, strict=True)):
            stability = float(np.mean(track.agreement)) if track.agreement else 0.0
            if len(track.frames) < least or stability < self.settings.track.min_stability or len(support.points) < 10:
                continue
            found = zip(self.proposals, self.joined, strict=True)
            seen = _SeenViews([(p, n) for p, owner in found for n in np.flatnonzero(owner == number).tolist()])
            plane, structure = seen.surface(views)
            stability *= 1.0 if structure else seen.whole()
            record = mask_track(track.frames, track.masks, track.visible, size)
            instance = LocalInstance(len(instances), record, seen.feature(), support, stability, plane, structure)
            if not structure:
                instance = replace(instance, names=seen.names(), named=seen.named())
            instances.append(instance)
        pairs = cannot_link_pairs(instances, self.settings.track.cannot_link_frames, views.unit)
        return LocalLibrary(tuple(instances), pairs, feature_space)


def _instance_image(views: ChunkViews, proposals: Proposals, joined: NDArray[np.int64]) -> NDArray[np.int32]:
    """Instance + 1 of each pixel of an anchor at working size."""
    table = np.append(0, joined + 1).astype(np.int32)
    return table[proposals.labels[:: views.stride, :: views.stride]]


def frame_labels(
    views: ChunkViews,
    proposals: Sequence[Proposals],
    images: Sequence[NDArray[np.int32]],
    positions: NDArray[np.int64],
    position: int,
) -> NDArray[np.int32]:
    """Instance + 1 of each pixel of a frame, propagated from the nearest anchors that see it. Shape (h, w)."""
    if position in positions:
        return _tidy(images[int(np.flatnonzero(positions == position)[0])], views.small_depth(position))
    depth = views.small_depth(position)
    labels = np.zeros(depth.shape, np.int32)
    left = depth.copy()
    pose = views.pose(position)
    for nearest in np.argsort(np.abs(positions - position), kind="stable")[:3].tolist():
        source = views.view(proposals[nearest].position)
        moved = np.linalg.inv(source.T_chunk_cam) @ pose
        found, _ = warp_labels(views, images[nearest], source, left, moved)
        labels = np.where(labels > 0, labels, found)
        left[found > 0] = 0.0
    return _tidy(labels, depth)


def _tidy(labels: NDArray[np.int32], depth: NDArray[np.float32]) -> NDArray[np.int32]:
    """Labels without lone pixels, grown over pixels without a label that they surround."""
    kept, most = without_lone(np.ascontiguousarray(labels, np.int32))
    filled = cv2.morphologyEx((kept > 0).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    grow = (kept == 0) & (filled > 0) & (depth <= 0)
    return np.where(grow, most, kept).astype(np.int32)


def encode_labels(labels: NDArray[np.int32], stride: int, shape: tuple[int, int]) -> dict[int, CodedMask]:
    """Every instance of a label image, at the colour image's size."""
    starts, stops, value = label_runs(np.ascontiguousarray(labels, np.int32), stride, *shape)
    order = np.argsort(value, kind="stable")
    starts, stops, value = starts[order], stops[order], value[order]
    bounds = np.append(np.flatnonzero(np.diff(value, prepend=-1)), len(value))
    runs, ends, figures = _codes(starts, stops, bounds, *shape)
    out = {}
    for k, (area, x0, y0, x1, y1, x, y) in enumerate(figures.tolist()):
        mask = CodedMask(runs[ends[k] : ends[k + 1]], int(area), (x0, y0, x1, y1), (x, y))
        out[int(value[bounds[k]]) - 1] = mask
    return out


@compiled
def _codes(
    starts: Ints, stops: Ints, bounds: Ints, height: int, width: int
) -> tuple[NDArray[np.uint32], Ints, NDArray[np.float64]]:
    """Concatenated run-length codes of masks, where each ends, and area, box and centroid of each (M, 7).

    `starts` and `stops` (N,) are runs of pixels, those of mask k from `bounds[k]` to `bounds[k + 1]`.
    """
    runs, used = np.empty(2 * len(starts) + len(bounds), np.uint32), 0
    ends, figures = np.zeros(len(bounds), np.int64), np.zeros((len(bounds) - 1, 7))
    for k in range(len(bounds) - 1):
        at, area, across, down = 0, 0, 0.0, 0.0
        x0, y0, x1, y1 = width, height, 0, 0
        for n in range(bounds[k], bounds[k + 1]):
            runs[used], runs[used + 1] = starts[n] - at, stops[n] - starts[n]
            used, at = used + 2, stops[n]
            row, last_row = starts[n] // width, (stops[n] - 1) // width
            left, right = starts[n] % width, (stops[n] - 1) % width
            middle = (starts[n] + stops[n] - 1) / 2.0
            if last_row > row:
                left, right = 0, width - 1
            length = stops[n] - starts[n]
            across += length * (width / 2.0 if last_row > row else middle % width)
            down += length * (middle // width)
            x0, y0, x1, y1 = min(x0, left), min(y0, row), max(x1, right + 1), max(y1, last_row + 1)
            area += length
        if at < height * width:
            runs[used], used = height * width - at, used + 1
        ends[k + 1] = used
        figures[k] = np.array([area, x0, y0, x1, y1, across / area, down / area])
    return runs[:used], ends, figures


def _sample_supports(supports: Sequence[Support]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    parts, owner = [np.zeros((0, 3), np.float32)], [np.zeros(0, np.int64)]
    for number, support in enumerate(supports):
        chosen = np.unique(np.linspace(0, len(support.points) - 1, min(SAMPLES, len(support.points))).astype(int))
        parts.append(support.points[chosen])
        owner.append(np.full(len(chosen), number))
    return np.concatenate(parts), np.concatenate(owner)


def _look_for(
    views: ChunkViews,
    position: int,
    labels: NDArray[np.int32],
    samples: NDArray[np.float32],
    *,
    owner: NDArray[np.int64],
    count: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """For each instance: share of its samples that are seen, and share of these that are on its mask."""
    T_cam_chunk = np.linalg.inv(views.pose(position))
    p = samples @ T_cam_chunk[:3, :3].T.astype(np.float32) + T_cam_chunk[:3, 3].astype(np.float32)
    z = np.maximum(p[:, 2], 1e-6)
    camera = views.camera
    u = np.rint(p[:, 0] / z * camera.fx + camera.cx).astype(np.int64)
    v = np.rint(p[:, 1] / z * camera.fy + camera.cy).astype(np.int64)
    inside = (p[:, 2] > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    read = views.small_depth(position)[v, u]
    tolerance = 4.0 * views.sigma(z) + 0.005 * views.unit
    seen = inside & (read > 0) & (np.abs(read - z) < tolerance)
    on_mask = seen & (labels[v, u] == owner + 1)
    total = np.maximum(np.bincount(owner, minlength=count), 1)
    seen_count = np.bincount(owner, seen, minlength=count)
    hit = np.bincount(owner, on_mask, minlength=count)
    return seen_count / total, hit / np.maximum(seen_count, 1)


@dataclass(frozen=True)
class _SeenViews:
    """The candidates, on all anchors, that one instance was found as."""

    found: Sequence[tuple[Proposals, int]]
    """Candidates of an anchor, and the number of the one that is meant."""

    def surface(self, views: ChunkViews) -> tuple[NDArray[np.float64] | None, bool]:
        """Return the plane in chunk coordinates, if a candidate has one, and whether the instance bounds the room."""
        structure = any(p.structure is not None and bool(p.structure[n]) for p, n in self.found)
        for p, n in self.found:
            if np.isfinite(p.plane[n]).all():
                return np.asarray(p.plane[n] @ np.linalg.inv(views.pose(p.position))), structure
        return None, structure

    def whole(self) -> float:
        """Return the mean probability that the candidates are one object; 1 where it is unknown."""
        said = np.array([p.whole[n] for p, n in self.found if p.whole is not None], np.float32)
        return float(said.mean()) if len(said) else 1.0

    def names(self) -> tuple[tuple[str, float], ...]:
        """Return the names of the candidates, with their scores, in order of the anchors."""
        return tuple((p.names[n], float(p.score[n])) for p, n in self.found if p.names is not None)

    def named(self) -> tuple[tuple[str, float], ...]:
        """Return the names that the instance may have: the mean over its candidates."""
        said = [p.named[n] for p, n in self.found if p.named is not None]
        total: dict[str, float] = {}
        for name, probability in (pair for names in said for pair in names):
            total[name] = total.get(name, 0.0) + probability / len(said)
        return tuple(sorted(total.items(), key=lambda item: (-item[1], item[0])))

    def feature(self) -> NDArray[np.float32]:
        """Return the mean feature of the candidates."""
        return mean_feature(
            np.array([p.features[n] for p, n in self.found]), np.array([p.score[n] for p, n in self.found])
        )
