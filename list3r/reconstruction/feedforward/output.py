"""The output of any feed-forward network for some frames, in common terms, and a chunk's reconstruction from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.core.errors import TrackingError
from list3r.reconstruction.base import DepthNoise, Reconstruction
from list3r.reconstruction.feedforward.pictures import Placement
from list3r.reconstruction.poses import select_keyframes
from list3r.reconstruction.rgbd.confidence import next_to_edge
from list3r.reconstruction.settings import NetworkSettings

LEAST_CONFIDENCE = 0.05
"""Depth of less confidence than this is unknown (the threshold of pi3's authors in their odometry)."""
LEAST_FOCAL, MOST_FOCAL = 0.2, 10.0
"""Possible focal lengths of a lens, by the picture's longer side; others are invalid."""


@dataclass(frozen=True)
class WindowOutput:
    """A network's output for n frames, at its own picture size h x w, in its own gauge and units."""

    T_window_cam: NDArray[np.float64]
    """Pose of each camera, OpenCV axes. Shape (n, 4, 4)."""
    depth: NDArray[np.float32]
    """Depth along each camera's z. Shape (n, h, w)."""
    confidence: NDArray[np.float32]
    """In [0, 1]. Shape (n, h, w)."""
    focal: NDArray[np.float64]
    """fx and fy of each frame, px of the network's picture. Shape (n, 2)."""
    principal: NDArray[np.float64]
    """cx and cy of each frame, px of the network's picture, pixel centres at whole numbers. Shape (n, 2)."""

    def arrays(self) -> tuple[NDArray[Any], ...]:
        """Its arrays, one row a frame."""
        return self.T_window_cam, self.depth, self.confidence, self.focal, self.principal

    def part(self, which: slice | NDArray[Any]) -> WindowOutput:
        """Return some of the frames."""
        return WindowOutput(*(a[which] for a in self.arrays()))

    def valid(self) -> NDArray[np.bool_]:
        """Frames with a finite rigid pose, a possible focal length, and depth somewhere. Shape (n,)."""
        R = self.T_window_cam[:, :3, :3]
        rigid = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0) < 1e-2
        longest = max(self.depth.shape[1:])
        lens = ((self.focal > LEAST_FOCAL * longest) & (self.focal < MOST_FOCAL * longest)).all(axis=1)
        finite = np.isfinite(self.T_window_cam).all(axis=(1, 2))
        return np.asarray(finite & rigid & lens & (self.known().any(axis=(1, 2))))

    def known(self) -> NDArray[np.bool_]:
        """Pixels whose depth is finite, positive, and confident enough. Shape (n, h, w)."""
        sane = np.isfinite(self.depth) & (self.depth > 0) & np.isfinite(self.confidence)
        return np.asarray(sane & (self.confidence >= LEAST_CONFIDENCE))


def middles(depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Principal points in the middle of pictures (n, h, w), px. Shape (n, 2)."""
    height, width = depth.shape[1:]
    return np.tile([(width - 1) / 2.0, (height - 1) / 2.0], (len(depth), 1))


def whole_frames(output: WindowOutput, placement: Placement) -> WindowOutput:
    """Return the output for whole frames of a network that saw them cropped or padded; unknown where cropped."""
    return replace(
        output,
        depth=placement.whole(output.depth),
        confidence=placement.whole(output.confidence),
        principal=output.principal - (placement.left, placement.top),
    )


def to_reconstruction(
    frames: Sequence[Frame],
    camera: Camera,
    output: WindowOutput,
    noise: DepthNoise | None = None,
    settings: NetworkSettings | None = None,
    known: bool = False,
) -> Reconstruction:
    """A chunk's reconstruction at the frames' own size, in the frame of its first posed camera; scale is relative.

    `camera` gives the frames' size and, where it is `known`, the rays of their pixels; otherwise the rays are by the
    medians of the network's intrinsics. Depth is that of the points on these rays nearest to the network's own. `noise`
    is that of depth from another source than a network, with sharp edges. Raises `TrackingError` when the network gives
    valid poses for fewer than two frames.
    """
    chosen = settings or NetworkSettings()
    posed = output.valid()
    if posed.sum() < min(2, len(frames)):
        raise TrackingError(
            f"the network gives no usable pose for frames {frames[0].index} to {frames[-1].index}; "
            "are these its own weights?"
        )
    T = np.tile(np.eye(4), (len(frames), 1, 1))
    first = output.T_window_cam[int(np.flatnonzero(posed)[0])]
    T[posed] = np.linalg.inv(first) @ output.T_window_cam[posed]
    shared = camera.pinhole() if known else network_camera(camera, output, posed)
    output = replace(output, depth=_on_rays(output, shared.resized(*output.depth.shape[1:])))
    shape = (len(frames), camera.height, camera.width)
    depth, confidence = np.zeros(shape, np.float32), np.zeros(shape, np.float16)
    for position in np.flatnonzero(posed).tolist():
        depth[position], confidence[position] = _enlarged(
            output.part(slice(position, position + 1)), camera, chosen if noise is None else None
        )
    keyframes = select_keyframes(T, posed, list(depth), chosen.keyframes)
    return Reconstruction(
        frame_indices=np.array([f.index for f in frames], np.int64),
        posed=posed,
        T_chunk_cam=T,
        camera=shared,
        depth=depth,
        confidence=confidence,
        scale_kind="relative",
        keyframes=np.array(keyframes, np.int64),
        depth_noise=noise,
    )


def network_camera(camera: Camera, output: WindowOutput, posed: NDArray[np.bool_]) -> Camera:
    """Return the camera of the frames with the medians of the network's intrinsics, px of the frames."""
    height, width = output.depth.shape[1:]
    K = np.median(np.concatenate([output.focal, output.principal], axis=1)[posed], axis=0)
    fx, fy, cx, cy = (float(v) for v in K)
    return Camera(width, height, fx, fy, cx, cy).resized(camera.height, camera.width)


def _on_rays(output: WindowOutput, camera: Camera) -> NDArray[np.float32]:
    """Depth of the points that are nearest to the network's on the rays of one camera of its pictures. Shape (n, h, w).

    A point z (a, b, 1) is nearest to the ray t (c, d, 1) at t = z (1 + ac + bd) / (1 + c^2 + d^2).
    """
    rows, columns = np.arange(camera.height), np.arange(camera.width)
    c, d = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    length = (1.0 + c[None, :] ** 2 + d[:, None] ** 2).astype(np.float32)
    out = output.depth.copy()
    for depth, (fx, fy), (cx, cy) in zip(out, output.focal, output.principal, strict=True):
        if not np.allclose((fx, fy, cx, cy), (camera.fx, camera.fy, camera.cx, camera.cy), rtol=1e-6):
            a, b = (columns - cx) / fx, (rows - cy) / fy
            depth *= (1.0 + (a * c)[None, :] + (b * d)[:, None]).astype(np.float32) / length
    return out


def _enlarged(
    one: WindowOutput, camera: Camera, smeared: NetworkSettings | None
) -> tuple[NDArray[np.float32], NDArray[np.float16]]:
    """Return depth and confidence of one frame at the frames' size; unknown where a neighbour of a pixel is unknown.

    `smeared` marks pixels where depth interpolates between two surfaces.
    """
    size = (camera.width, camera.height)
    known = one.known()[0]
    depth = np.where(known, one.depth[0], np.float32(0))
    confidence = np.where(known, np.clip(one.confidence[0], 0.0, 1.0), np.float32(0)).astype(np.float32)
    if smeared is not None:
        confidence[next_to_edge(depth, known, smeared.edge_step)] *= np.float32(smeared.edge_confidence)
    large = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.999
    out = np.where(large, cv2.resize(depth, size, interpolation=cv2.INTER_LINEAR), np.float32(0))
    sure = np.where(large, cv2.resize(confidence, size, interpolation=cv2.INTER_LINEAR), 0.0)
    return out.astype(np.float32), sure.astype(np.float16)


def with_given_poses(made: Reconstruction, frames: Sequence[Frame]) -> Reconstruction:
    """The reconstruction moved to the source's given poses, its depth scaled to them (then metric).

    The scale is the ratio of the cameras' distances from their centre. Raises `TrackingError` when fewer than two
    frames have a valid pose, or when the cameras do not move, which leaves the scale undetermined.
    """
    given = [f.T_source_cam for f in frames]
    posed = made.posed & np.array([g is not None and bool(np.isfinite(g).all()) for g in given])
    if posed.sum() < 2:
        raise TrackingError(f"fewer than two of the frames from {frames[0].index} have a valid pose")
    T = np.tile(np.eye(4), (len(frames), 1, 1))
    T[posed] = np.stack([g for g, good in zip(given, posed, strict=True) if good and g is not None])
    ours, theirs = made.T_chunk_cam[posed][:, :3, 3], T[posed][:, :3, 3]
    away, true = (np.linalg.norm(c - c.mean(axis=0), axis=1) for c in (ours, theirs))
    reach = float(np.median(made.depth[posed][made.depth[posed] > 0]))
    if float(away.max()) < 1e-3 * reach:
        raise TrackingError(f"the camera does not move in frames {frames[0].index} to {frames[-1].index}: no scale")
    scale = float((away * true).sum() / (away * away).sum())
    return replace(
        made,
        posed=posed,
        T_chunk_cam=T,
        depth=np.where(posed[:, None, None], made.depth * np.float32(scale), np.float32(0)),
        confidence=np.where(posed[:, None, None], made.confidence, np.float16(0)),
        scale_kind="metric",
        keyframes=made.keyframes[posed[made.keyframes]],
        depth_noise=None if made.depth_noise is None else made.depth_noise.scaled(scale),
    )
