"""What a chunk keeps of its frames so that others can be placed against it: keyframes and overlap samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.masks import decode_mask
from list3r.memory.records import FrameSamples, Keyframe, LocalLibrary
from list3r.reconstruction.base import Reconstruction
from list3r.reconstruction.descriptor import DescriptorSettings, frame_descriptor
from list3r.reconstruction.features import FeatureSettings, detect
from list3r.reconstruction.view import SensorNoise, shrink_camera, shrink_depth


@dataclass(frozen=True)
class KeyframeSettings:
    """What is kept of a keyframe."""

    depth_width: int = 160
    """Width of the small depth image, px."""
    jpeg_quality: int = 85
    features: FeatureSettings = field(default_factory=FeatureSettings)
    descriptor: DescriptorSettings = field(default_factory=DescriptorSettings)
    noise: SensorNoise = field(default_factory=SensorNoise)


@dataclass(frozen=True)
class SampleSettings:
    """Which points of its frames a chunk keeps for alignment."""

    columns: int = 16
    rows: int = 12


def make_keyframes(
    frames: Sequence[Frame],
    reconstruction: Reconstruction,
    keep_jpeg: bool,
    settings: KeyframeSettings | None = None,
) -> tuple[Keyframe, ...]:
    """The keyframes of a chunk, in order of time."""
    chosen = settings or KeyframeSettings()
    return tuple(
        _make_keyframe(frames[position], reconstruction, int(position), keep_jpeg, chosen)
        for position in reconstruction.keyframes
        if reconstruction.posed[position]
    )


def frame_samples(
    reconstruction: Reconstruction, library: LocalLibrary | None = None, settings: SampleSettings | None = None
) -> FrameSamples:
    """Points of all posed frames on one fixed pixel grid, with the instances whose masks hold them."""
    chosen = settings or SampleSettings()
    positions = np.flatnonzero(reconstruction.posed)
    camera = reconstruction.camera
    row, column = (g.ravel() for g in _pixel_grid(camera, chosen))
    depth = reconstruction.depth[positions][:, row, column]
    confidence = reconstruction.confidence[positions][:, row, column].astype(np.float32)
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(row))], axis=1)
    T = reconstruction.T_chunk_cam[positions]
    points = np.einsum("fij,fnj->fni", T[:, :3, :3], depth[..., None] * rays) + T[:, None, :3, 3]
    known = (depth > 0) & (confidence > 0)
    frame = np.broadcast_to(reconstruction.frame_indices[positions][:, None], depth.shape)
    pixel = np.broadcast_to((row * camera.width + column)[None], depth.shape)
    return FrameSamples(
        frame=frame[known].astype(np.int64),
        pixel=pixel[known].astype(np.int32),
        points=points[known].astype(np.float32),
        confidence=confidence[known],
        instance=_instances(library, reconstruction, positions, row, column)[known],
        camera_frames=reconstruction.frame_indices[positions].astype(np.int64),
        T_chunk_cam=T.astype(np.float64),
    )


def _instances(
    library: LocalLibrary | None,
    reconstruction: Reconstruction,
    positions: NDArray[np.int64],
    row: NDArray[np.int64],
    column: NDArray[np.int64],
) -> NDArray[np.int32]:
    """Local id of the smallest mask at each grid pixel of each frame, -1 for none. Shape (G, N)."""
    out = np.full((len(positions), len(row)), -1, np.int32)
    place = {int(reconstruction.frame_indices[p]): k for k, p in enumerate(positions)}
    area = np.full(out.shape, np.iinfo(np.int32).max, np.int32)
    for instance in library.instances if library is not None else ():
        track = instance.track
        for index, mask, size in zip(track.frames, track.masks, track.areas_px, strict=True):
            k = place.get(int(index))
            if k is None:
                continue
            held = decode_mask(mask, track.image_size)[row, column] & (size < area[k])
            out[k, held], area[k, held] = instance.local_id, size
    return out


def _pixel_grid(camera: Camera, settings: SampleSettings) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows = ((np.arange(settings.rows) + 0.5) * camera.height / settings.rows).astype(np.int64)
    columns = ((np.arange(settings.columns) + 0.5) * camera.width / settings.columns).astype(np.int64)
    grid = np.meshgrid(rows, columns, indexing="ij")
    return grid[0], grid[1]


def _make_keyframe(
    frame: Frame, reconstruction: Reconstruction, position: int, keep_jpeg: bool, settings: KeyframeSettings
) -> Keyframe:
    camera, depth = reconstruction.camera, reconstruction.depth[position]
    features = detect(frame.color, depth, camera, settings.features)
    small = shrink_camera(camera, settings.depth_width)
    return Keyframe(
        frame_index=frame.index,
        T_chunk_cam=reconstruction.T_chunk_cam[position].copy(),
        descriptor=frame_descriptor(frame.color, features.descriptors, settings.descriptor),
        keypoints_xy=features.xy,
        keypoint_descriptors=features.descriptors,
        points_cam=features.points_cam,
        depth_small=shrink_depth(depth, small, settings.noise),
        camera_small=(small.fx, small.fy, small.cx, small.cy),
        jpeg=_jpeg(frame.color, settings.jpeg_quality) if keep_jpeg else b"",
    )


def _jpeg(color: NDArray[np.uint8], quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return bytes(data.tobytes())
