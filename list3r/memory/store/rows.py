"""Rows of the tables of what was measured, as records and back."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.records import ChunkRow, Edge, FrameRow, FrameSamples, Keyframe, MaskTrack, MotionTrack
from list3r.memory.store.codec import checksum, pack, raw_array, unpack, unpack_sim3


def f8(values: NDArray[np.float64]) -> bytes:
    """Doubles as little-endian bytes."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def read_chunk_row(row: tuple[Any, ...]) -> ChunkRow:
    """A row of `chunks`."""
    covariance = row[14]
    chunk_id, session_id, index, first, last, component, pose, fx, fy, cx, cy, height, width, scale_kind = row[:14]
    intrinsics, image_size = (fx, fy, cx, cy), (height, width)
    S_world_chunk = unpack_sim3(pose)
    return ChunkRow(
        chunk_id,
        session_id,
        index,
        first,
        last,
        component,
        S_world_chunk,
        intrinsics,
        image_size,
        scale_kind,
        _covariance(covariance, f"the uncertainty of chunk {chunk_id}"),
    )


def read_edge(row: tuple[Any, ...]) -> Edge:
    """A row of `edges`."""
    covariance = row[13]
    u, v, kind, S_v_u, confidence, weight, inliers, residual_m, accepted, reason, scores, frame_u, frame_v = row[:13]
    return Edge(
        u=u,
        v=v,
        kind=kind,
        S_v_u=unpack_sim3(S_v_u),
        confidence=confidence,
        weight=weight,
        inliers=inliers,
        residual_m=residual_m,
        accepted=bool(accepted),
        reason=reason,
        scores=json.loads(scores),
        frames=None if frame_u < 0 else (frame_u, frame_v),
        covariance=_covariance(covariance, f"the uncertainty of edge {u}-{v}"),
    )


def _covariance(blob: bytes | None, where: str) -> NDArray[np.float64] | None:
    return None if blob is None else raw_array(blob, "<f8", (7, 7), where).copy()


def read_frame_row(row: tuple[Any, ...]) -> FrameRow:
    """A row of `frames`."""
    session_id, frame_index, time_s, chunk_id, state, pose = row
    T_chunk_cam = raw_array(pose, "<f8", (4, 4), f"the pose of frame {frame_index}")
    return FrameRow(session_id, frame_index, time_s, chunk_id, state, T_chunk_cam)


def keyframe_row(chunk_id: int, keyframe: Keyframe) -> tuple[object, ...]:
    """The row of `keyframes` for a keyframe."""
    descriptor = keyframe.descriptor.astype("<f4").tobytes()
    features = pack(
        {
            "T_chunk_cam": keyframe.T_chunk_cam,
            "keypoints_xy": keyframe.keypoints_xy.astype(np.float32),
            "keypoint_descriptors": keyframe.keypoint_descriptors,
            "points_cam": keyframe.points_cam.astype(np.float32),
            "depth_small": keyframe.depth_small.astype(np.float32),
            "camera_small": np.asarray(keyframe.camera_small, dtype=np.float64),
        }
    )
    crc = checksum(descriptor, features, keyframe.jpeg)
    return chunk_id, keyframe.frame_index, descriptor, features, keyframe.jpeg, crc


def read_keyframe(chunk_id: int, frame_index: int, descriptor: bytes, features: bytes, jpeg: bytes) -> Keyframe:
    """A row of `keyframes`."""
    arrays: dict[str, Any] = unpack(features, f"keyframe {frame_index} of chunk {chunk_id}")
    fx, fy, cx, cy = (float(x) for x in arrays.pop("camera_small"))
    return Keyframe(
        frame_index=frame_index,
        descriptor=np.frombuffer(descriptor, "<f4").astype(np.float32),
        camera_small=(fx, fy, cx, cy),
        jpeg=jpeg,
        **arrays,
    )


def sample_arrays(samples: FrameSamples) -> dict[str, NDArray[Any]]:
    """Samples of a chunk's frames as arrays for one blob; the frame of a sample as its place among the posed frames."""
    return {
        "frame": samples.frame,
        "pixel": samples.pixel.astype(np.int32),
        "points": samples.points.astype(np.float32),
        "confidence": samples.confidence.astype(np.float32),
        "instance": samples.instance.astype(np.int32),
        "camera_frames": samples.camera_frames.astype(np.int64),
        "T_chunk_cam": samples.T_chunk_cam.astype(np.float64),
    }


def read_samples(arrays: dict[str, NDArray[Any]]) -> FrameSamples:
    """The inverse of `sample_arrays`; blobs of the first schema know no instances and no cameras."""
    missing: dict[str, Any] = {
        "instance": np.full(len(arrays["frame"]), -1, np.int32),
        "camera_frames": np.zeros(0, np.int64),
        "T_chunk_cam": np.zeros((0, 4, 4)),
    }
    return FrameSamples(**(missing | arrays))


def read_motion(blob: bytes | None, where: str) -> MotionTrack | None:
    """The positions of a moving local instance."""
    return None if blob is None else MotionTrack(**unpack(blob, where))


def track_arrays(track: MaskTrack) -> dict[str, NDArray[Any]]:
    """A mask track as arrays for one blob."""
    lengths = np.array([len(m) for m in track.masks], dtype=np.int32)
    runs = np.concatenate(track.masks) if track.masks else np.zeros(0, np.uint32)
    return {
        "frames": track.frames,
        "boxes_xyxy": track.boxes_xyxy.astype(np.float32),
        "centers_xy": track.centers_xy.astype(np.float32),
        "areas_px": track.areas_px.astype(np.int32),
        "visible_fraction": track.visible_fraction.astype(np.float32),
        "image_size": np.asarray(track.image_size, dtype=np.int32),
        "lengths": lengths,
        "runs": runs.astype(np.uint32),
    }


def read_track(arrays: dict[str, NDArray[Any]]) -> MaskTrack:
    """The inverse of `track_arrays`."""
    masks = tuple(np.split(arrays["runs"], np.cumsum(arrays["lengths"])[:-1])) if len(arrays["lengths"]) else ()
    height, width = (int(n) for n in arrays["image_size"])
    kept = {k: v for k, v in arrays.items() if k not in ("runs", "lengths", "image_size")}
    return MaskTrack(**kept, masks=masks, image_size=(height, width))
