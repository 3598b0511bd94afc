"""Track movers from frame to frame by position, size and colour, and drop those that went nowhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.motion.free_space import SmallFrames
from list3r.reconstruction.motion.settings import MoverTrackSettings
from list3r.reconstruction.rgbd.view import pixel_rays

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Blob:
    """One mover in one frame."""

    position: int
    """Of the frame in the chunk."""
    mask: NDArray[np.bool_]
    """Shape (h, w)."""
    low: Array
    """Lower corner of its trimmed extent, camera coordinates. Shape (3,)."""
    high: Array
    """Upper corner. Shape (3,)."""
    cut: NDArray[np.bool_]
    """Whether the border of the picture cuts it: left, top, right, bottom. Shape (4,)."""
    rgb: Array
    """Mean colour. Shape (3,)."""
    thickness: float
    """Visible depth of its surface along a row of the picture, median over rows."""


@dataclass
class MoverTrack:
    """One mover over time."""

    blobs: list[Blob] = field(default_factory=list)
    places: list[Array] = field(default_factory=list)
    """Centres of the blobs, chunk coordinates."""


def track_movers(
    masks: NDArray[np.bool_],
    colors: Sequence[NDArray[np.uint8]],
    times_s: Array,
    frames: SmallFrames,
    settings: MoverTrackSettings | None = None,
) -> NDArray[np.uint8] | None:
    """Return the number of the mover at each pixel, from 1, 0 for static ones; None without any. Shape (F, h, w).

    `masks` (F, h, w) mark candidates; a blob that is seen in too few frames, or that goes nowhere, is left out.
    `colors` are the frames' pictures at any size, RGB.
    """
    s = settings or MoverTrackSettings()
    tracks: list[MoverTrack] = []
    for position in np.flatnonzero(masks.any(axis=(1, 2))).tolist():
        blobs = _blobs(masks[position], colors[position], frames, position, s)
        _assign(tracks, blobs, times_s, frames, s)
    tracks = _together(tracks, s)
    kept = [t for t in tracks if len(t.blobs) >= s.min_frames and _went(t, frames, s)][: s.most_tracks]
    if not kept:
        return None
    out = np.zeros(masks.shape, np.uint8)
    for number, track in enumerate(kept, start=1):
        for blob in track.blobs:
            out[blob.position][blob.mask] = number
    return out


def middles(blobs: Sequence[Blob], T_chunk_cam: Array) -> Array:
    """Centre of each blob in the chunk, including the part outside of the picture. Shape (V, 3).

    Of a blob that is cut on one side the other side is known, and the full width and height from frames that saw it
    whole (or most of it). The back of an object is hidden: it is assumed to be at least half as deep as it is wide.
    """
    extent = np.array([b.high - b.low for b in blobs])
    cut = np.array([b.cut for b in blobs])
    out = np.empty((len(blobs), 3))
    full = np.empty(2)
    for axis in (0, 1):
        whole = ~cut[:, axis] & ~cut[:, axis + 2]
        sizes = extent[whole, axis] if whole.any() else extent[:, axis]
        full[axis] = np.quantile(sizes, 0.5 if whole.sum() >= 3 else 1.0)
    for n, blob in enumerate(blobs):
        middle = (blob.low + blob.high) / 2.0
        for axis in (0, 1):
            first, last = blob.cut[axis], blob.cut[axis + 2]
            if first != last and extent[n, axis] < full[axis]:
                half = full[axis] / 2.0
                middle[axis] = blob.high[axis] - half if first else blob.low[axis] + half
        middle[2] += max(0.0, 0.25 * min(full[0], float(extent[n, 0])) - 0.5 * blob.thickness)
        T = T_chunk_cam[blob.position]
        out[n] = T[:3, :3] @ middle + T[:3, 3]
    return out


def measure_blob(mask: NDArray[np.bool_], color: NDArray[np.uint8], frames: SmallFrames, position: int) -> Blob | None:
    """Return a mask of a frame as a blob; None where its depth is unknown. `color` is RGB of any size."""
    depth = frames.depth[position]
    inside = mask & (depth > 0)
    if inside.sum() < 4:
        return None
    height, width = depth.shape
    points = (depth[..., None] * pixel_rays(frames.camera))[inside]
    near, far = np.quantile(points[:, 2], [0.1, 0.9])
    close = (points[:, 2] > near - 0.3) & (points[:, 2] < far + 0.3)
    points, row = points[close].astype(np.float64), np.nonzero(inside)[0][close]
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    known_rows, known_columns = np.flatnonzero((depth > 0).any(axis=1)), np.flatnonzero((depth > 0).any(axis=0))
    cut = np.array(
        [
            columns[0] <= known_columns[0] + 1,
            rows[0] <= known_rows[0] + 1,
            columns[-1] >= known_columns[-1] - 1,
            rows[-1] >= known_rows[-1] - 1,
        ]
    )
    small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
    return Blob(position, mask, low, high, cut, small[mask].mean(axis=0), _thickness(points[:, 2], row))


def _thickness(z: Array, row: NDArray[np.int64]) -> float:
    order = np.argsort(row, kind="stable")
    start = np.flatnonzero(np.diff(row[order], prepend=-1))
    deep = np.maximum.reduceat(z[order], start) - np.minimum.reduceat(z[order], start)
    return float(np.median(deep))


def _blobs(
    mask: NDArray[np.bool_], color: NDArray[np.uint8], frames: SmallFrames, position: int, s: MoverTrackSettings
) -> list[Blob]:
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    parts = [labels == n for n in range(1, count)]
    found = [b for b in (measure_blob(part, color, frames, position) for part in parts) if b is not None]
    group = list(range(len(found)))
    for a in range(len(found)):
        for b in range(a):
            if _gap(found[a], found[b]) < s.gap_m:
                group = [group[b] if g == group[a] else g for g in group]
    out = []
    for g in sorted(set(group)):
        union = np.any([found[n].mask for n in range(len(found)) if group[n] == g], axis=0)
        blob = measure_blob(union, color, frames, position)
        if blob is not None and union.sum() >= s.least_share * union.size:
            out.append(blob)
    return out


def _gap(a: Blob, b: Blob) -> float:
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(a.low - b.high, b.low - a.high))))


def _place(blob: Blob, frames: SmallFrames) -> Array:
    T = frames.T_chunk_cam[blob.position]
    return np.asarray(T[:3, :3] @ ((blob.low + blob.high) / 2.0) + T[:3, 3])


def _assign(
    tracks: list[MoverTrack], blobs: Sequence[Blob], times_s: Array, frames: SmallFrames, s: MoverTrackSettings
) -> None:
    """Assign each blob to the track that expects it nearest, best pairs first; the rest begin tracks."""
    pairs = []
    for n, blob in enumerate(blobs):
        place = _place(blob, frames)
        for k, track in enumerate(tracks):
            last = track.blobs[-1]
            gap_s = float(times_s[blob.position] - times_s[last.position])
            if gap_s > s.most_gap_s or np.linalg.norm(blob.rgb - last.rgb) > s.most_color:
                continue
            slack = 0.5 * float(np.linalg.norm((blob.high - blob.low) - (last.high - last.low)))
            away = float(np.linalg.norm(place - _expected(track, blob.position, times_s)))
            if away <= s.reach_m + s.speed_m_per_s * gap_s + slack:
                pairs.append((away, n, k))
    taken: set[int] = set()
    given: set[int] = set()
    for _, n, k in sorted(pairs):
        if n not in given and k not in taken:
            given.add(n)
            taken.add(k)
            tracks[k].blobs.append(blobs[n])
            tracks[k].places.append(_place(blobs[n], frames))
    for n, blob in enumerate(blobs):
        if n not in given:
            tracks.append(MoverTrack([blob], [_place(blob, frames)]))


def _together(tracks: list[MoverTrack], s: MoverTrackSettings) -> list[MoverTrack]:
    """Merge tracks that are next to each other in most frames of the shorter one: parts of one object."""
    out: list[MoverTrack] = []
    for track in sorted(tracks, key=lambda t: (-len(t.blobs), t.blobs[0].position)):
        if not any(_took_in(whole, track, s) for whole in out):
            out.append(track)
    return sorted(out, key=lambda t: t.blobs[0].position)


def _took_in(whole: MoverTrack, track: MoverTrack, s: MoverTrackSettings) -> bool:
    """Merge a track into one that it is next to; returns whether it was."""
    by_frame = {b.position: n for n, b in enumerate(whole.blobs)}
    shared = [(b, by_frame[b.position]) for b in track.blobs if b.position in by_frame]
    near = [b for b, n in shared if _gap(b, whole.blobs[n]) < 2 * s.gap_m]
    if not shared or len(shared) < s.together * len(track.blobs) or len(near) < s.together * len(shared):
        return False
    for blob, n in shared:
        whole.blobs[n] = _union(whole.blobs[n], blob)
    return True


def _union(a: Blob, b: Blob) -> Blob:
    share = a.mask.sum() / max(1, a.mask.sum() + b.mask.sum())
    low, high = np.minimum(a.low, b.low), np.maximum(a.high, b.high)
    return Blob(
        a.position,
        a.mask | b.mask,
        low,
        high,
        a.cut | b.cut,
        share * a.rgb + (1 - share) * b.rgb,
        max(a.thickness, b.thickness),
    )


def _expected(track: MoverTrack, position: int, times_s: Array) -> Array:
    """Return the predicted position of a track: at half of its last velocity, because objects turn and stop."""
    if len(track.places) < 2:
        return track.places[-1]
    a, b = track.blobs[-2].position, track.blobs[-1].position
    step = (track.places[-1] - track.places[-2]) / max(float(times_s[b] - times_s[a]), 1e-3)
    return np.asarray(track.places[-1] + 0.5 * step * min(float(times_s[position] - times_s[b]), 0.5))


def _went(track: MoverTrack, frames: SmallFrames, s: MoverTrackSettings) -> bool:
    """Whether two of its positions are apart: by a part of its width, so that no change of view can cause it."""
    places = middles(track.blobs, frames.T_chunk_cam)
    if len(places) > 3:
        places = np.asarray(cv2.blur(places, (1, 3), borderType=cv2.BORDER_REPLICATE), np.float64)
    width = float(np.median([max(b.high[0] - b.low[0], b.high[2] - b.low[2]) for b in track.blobs]))
    apart = np.linalg.norm(places - places[0], axis=1)
    far = places[int(np.argmax(apart))]
    return bool(np.linalg.norm(places - far, axis=1).max() >= max(s.moved_m, s.moved_share * width))
