"""Moving instances: masks, a track of places, and surface points where they were seen last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.geometric.features import object_feature
from list3r.instances.geometric.fusion import small_color
from list3r.instances.geometric.support import thin
from list3r.instances.settings import FEATURE_SPACE, MoverInstanceSettings
from list3r.instances.tracking.reprojection import encode_labels, mask_track
from list3r.memory.core.records import LocalInstance, LocalLibrary, MaskTrack, MotionTrack, Support
from list3r.reconstruction.base import Reconstruction, backproject
from list3r.reconstruction.motion.free_space import SmallFrames
from list3r.reconstruction.motion.tracks import Blob, measure_blob, middles
from list3r.reconstruction.rgbd.confidence import depth_confidence
from list3r.reconstruction.rgbd.settings import ConfidenceSettings

Array = NDArray[np.float64]


def with_movers(
    library: LocalLibrary,
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    settings: MoverInstanceSettings | None = None,
) -> LocalLibrary:
    """Return the library with one more instance for each moving object; `dynamic`, with its `motion`.

    Their points come from the frames' own depth, since the reconstruction holds static surfaces only.
    """
    s = settings or MoverInstanceSettings()
    if reconstruction.movers is None:
        return library
    camera, width = reconstruction.camera, reconstruction.movers.shape[2]
    small = SmallFrames.of([f.depth for f in frames], reconstruction.T_chunk_cam, reconstruction.posed, camera, width)
    first = len(library.instances)
    found: list[LocalInstance] = []
    for number in range(1, int(reconstruction.movers.max()) + 1):
        instance = _instance(first + len(found), number, frames, reconstruction, small, s)
        if instance is not None:
            found.append(instance)
    same_space = library.feature_space == FEATURE_SPACE
    if not same_space and library.instances:
        blank = np.zeros_like(library.instances[0].feature)
        found = [replace(i, feature=blank) for i in found]
    pairs = np.concatenate([library.cannot_link, _apart(found, s.cannot_link_frames)]).astype(np.int32)
    return replace(library, instances=(*library.instances, *found), cannot_link=pairs)


def _instance(
    local_id: int,
    number: int,
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    small: SmallFrames,
    s: MoverInstanceSettings,
) -> LocalInstance | None:
    assert reconstruction.movers is not None
    masks = reconstruction.movers == number
    positions = np.flatnonzero(masks.any(axis=(1, 2))).tolist()
    blobs = [b for b in (measure_blob(masks[p], frames[p].color, small, p) for p in positions) if b is not None]
    if not blobs:
        return None
    places = middles(blobs, reconstruction.T_chunk_cam)
    track = _mask_track(blobs, reconstruction, small)
    support = _support(blobs, places, frames, reconstruction, small, s)
    if len(support.points) < 10:
        return None
    up = -reconstruction.T_chunk_cam[reconstruction.posed][:, :3, 1].mean(axis=0)
    feature = object_feature(support.points, support.rgb, up / max(float(np.linalg.norm(up)), 1e-9), 1.0)
    span = blobs[-1].position - blobs[0].position + 1
    motion = MotionTrack(track.frames, places.astype(np.float32))
    stability = float(np.clip(len(blobs) / span, 0.4, 1.0))
    return LocalInstance(local_id, track, feature, support, stability, dynamic=True, motion=motion)


def _mask_track(blobs: Sequence[Blob], reconstruction: Reconstruction, small: SmallFrames) -> MaskTrack:
    size = (reconstruction.camera.height, reconstruction.camera.width)
    masks = [encode_labels(b.mask.astype(np.int32), small.stride, size)[0] for b in blobs]
    metric = np.array([m.area * (b.low[2] + b.high[2]) ** 2 for m, b in zip(masks, blobs, strict=True)])
    visible = np.clip(metric / max(float(np.quantile(metric, 0.9)), 1e-9), 0.0, 1.0)
    return mask_track(reconstruction.frame_indices[[b.position for b in blobs]], masks, visible, size)


def _support(
    blobs: Sequence[Blob],
    places: Array,
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    small: SmallFrames,
    s: MoverInstanceSettings,
) -> Support:
    """Points where it was last, from the last good view and its neighbours."""
    size = np.array([b.mask.sum() for b in blobs], float)
    good = (size >= s.whole * size.max()) & ~np.array([b.cut.any() for b in blobs])
    if not good.any():
        good = size >= s.whole * size.max()
    last = int(np.flatnonzero(good)[-1])
    resting = np.flatnonzero(np.linalg.norm(places - places[-1], axis=1) < s.rest_m)
    chosen = [n for n in range(last - s.neighbours, last + s.neighbours + 1) if 0 <= n < len(blobs)]
    if len(resting) > 2 * s.neighbours and good[resting].any():
        chosen = resting[good[resting]][:: max(1, len(resting) // (2 * s.neighbours + 1))].tolist()
        last = chosen[-1]
    stride = max(1, round(reconstruction.camera.width / 320))
    points, rgb, confidence = [], [], []
    for n in chosen:
        seen, color, sure = _points(blobs[n], frames[blobs[n].position], reconstruction, small, stride, s.confidence)
        points.append(seen + (places[last] - places[n]).astype(np.float32))
        rgb.append(color)
        confidence.append(sure)
    return thin(np.concatenate(points), np.concatenate(rgb), np.concatenate(confidence), 1.0, s.support_points)


def _points(
    blob: Blob,
    frame: Frame,
    reconstruction: Reconstruction,
    small: SmallFrames,
    stride: int,
    settings: ConfidenceSettings,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]:
    """Points in the chunk, colours and confidence of a blob's pixels, every `stride`-th of the frame."""
    assert frame.depth is not None
    camera = reconstruction.camera
    full = np.repeat(np.repeat(blob.mask, small.stride, axis=0), small.stride, axis=1)
    mask = full[: camera.height, : camera.width] & (frame.depth > 0)
    mask &= (frame.depth > blob.low[2] - 0.05) & (frame.depth < blob.high[2] + 0.05)
    inside = mask[::stride, ::stride]
    T = reconstruction.T_chunk_cam[blob.position]
    points = backproject(frame.depth, camera)[::stride, ::stride][inside] @ T[:3, :3].T.astype(np.float32)
    confidence = depth_confidence(frame.depth, camera, settings)[::stride, ::stride][inside]
    color = small_color(frame.color, stride)[inside]
    return points + T[:3, 3].astype(np.float32), color, confidence.astype(np.float32)


def _apart(movers: Sequence[LocalInstance], least: int) -> NDArray[np.int32]:
    """Pairs that were seen side by side: two objects. Shape (P, 2)."""
    pairs = [
        (a.local_id, b.local_id)
        for n, a in enumerate(movers)
        for b in movers[n + 1 :]
        if len(np.intersect1d(a.track.frames, b.track.frames)) >= least
    ]
    return np.array(pairs, np.int32).reshape(-1, 2)
