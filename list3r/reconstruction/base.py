"""The interface of every reconstruction model: frames in, poses and depth with confidence out."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.core.errors import TrackingError


@dataclass(frozen=True)
class KeyframeSpacing:
    """How far a camera moves from one keyframe to the next; either is enough."""

    turn_deg: float = 12.0
    shift: float = 0.12
    """Translation as a share of the median depth."""


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviation of depth, a + b (z - c)^2, the law of structured light.

    The constants are those of Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise", 2012, eq. 3.
    """

    constant_m: float = 0.0012
    quadratic_per_m: float = 0.0019
    nearest_m: float = 0.4

    def sigma(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Standard deviation of depth values, metres. Any shape."""
        away = depth - np.float32(self.nearest_m)
        return np.float32(self.constant_m) + np.float32(self.quadratic_per_m) * away * away


@dataclass(frozen=True)
class DepthNoise:
    """Noise of depth that a model computed: standard deviation base + quadratic * z^2, chunk units.

    Frames share their errors, so neither their agreement nor their mean is more accurate than one frame.
    """

    base: float
    quadratic: float
    half_share: float = 0.0
    """Deviation, as a share of depth, at which confidence is one half; 0 where confidence says nothing of it."""

    def scaled(self, scale: float) -> DepthNoise:
        """Return the same noise where a new unit is `scale` former units."""
        return DepthNoise(self.base * scale, self.quadratic / scale, self.half_share)

    def sigma(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Standard deviation of depths, chunk units. Shape (...)."""
        return np.asarray(self.base + self.quadratic * depth * depth, np.float32)

    def doubt(self, depth: NDArray[np.float32], confidence: NDArray[np.float16]) -> NDArray[np.float32]:
        """Standard deviation by confidence, chunk units; it includes deformation of whole surfaces. Shape (...).

        Confidence is 1 / (1 + (sigma / half)^2).
        """
        c = np.clip(confidence.astype(np.float32), 0.01, 1.0)
        return np.asarray(self.half_share * np.sqrt(1.0 / c - 1.0) * depth, np.float32)


@dataclass(frozen=True)
class PosedOnly:
    """Frames of a chunk that have a pose and no depth."""

    frame_indices: NDArray[np.int64]
    """Frame.index of each frame. Shape (M,)."""
    posed: NDArray[np.bool_]
    """False where the camera was lost. Shape (M,)."""
    T_chunk_cam: NDArray[np.float64]
    """Shape (M, 4, 4)."""


@dataclass(frozen=True)
class Reconstruction:
    """Geometry of one chunk, in the chunk's own frame and units."""

    frame_indices: NDArray[np.int64]
    """Frame.index of each frame. Shape (F,)."""
    posed: NDArray[np.bool_]
    """False where the camera was lost; such a frame's pose is meaningless. Shape (F,)."""
    T_chunk_cam: NDArray[np.float64]
    """Pose of the colour camera in the chunk. Shape (F, 4, 4)."""
    camera: Camera
    """Pinhole camera shared by the frames, px."""
    depth: NDArray[np.float32]
    """Depth along the camera's z, chunk units, 0 where unknown. Shape (F, H, W)."""
    confidence: NDArray[np.float16]
    """In [0, 1]; 0 where depth is unknown. Shape (F, H, W)."""
    scale_kind: str
    """metric or relative."""
    keyframes: NDArray[np.int64]
    """Positions (into F) of the keyframes, ascending. Shape (K,)."""
    movers: NDArray[np.uint8] | None = None
    """Number of the mover at every n-th pixel, from 1, and 0 for static pixels; None where the model looks for none or
    nothing moves. Depth and confidence are 0 on movers. Shape (F, h, w)."""
    depth_noise: DepthNoise | None = None
    """Noise of computed depth; None for a sensor's readings, whose noise is known and independent by frame."""
    between: PosedOnly | None = None
    """Further frames of the chunk, disjoint from the above."""
    unsure: frozenset[int] = frozenset()
    """`Frame.index` of those whose pose little supports."""

    def __post_init__(self) -> None:
        count = len(self.frame_indices)
        assert self.posed.shape == (count,)
        assert self.T_chunk_cam.shape == (count, 4, 4)
        assert self.depth.shape == self.confidence.shape == (count, self.camera.height, self.camera.width)

    def part(self, which: slice) -> Reconstruction:
        """Return some of the frames, without keyframes."""
        return replace(
            self,
            frame_indices=self.frame_indices[which],
            posed=self.posed[which],
            T_chunk_cam=self.T_chunk_cam[which],
            depth=self.depth[which],
            confidence=self.confidence[which],
            keyframes=np.zeros(0, np.int64),
        )


Around = Callable[[int, int], tuple[Sequence[Frame], Sequence[Frame]]]
"""(step, count) gives up to `count` frames before and as many behind a chunk, `step` apart, in order of time."""


class Reconstructor(Protocol):
    """A reconstruction model."""

    def __call__(self, frames: Sequence[Frame], camera: Camera) -> Reconstruction:
        """Reconstruct a chunk. Raises `TrackingError` when no two frames can be related."""
        ...


@dataclass(frozen=True)
class WindowSide:
    """The frames of one place in a joint window."""

    frames: Sequence[Frame]
    camera: Camera
    """Of the frames."""
    camera_known: bool
    """False where only the size of the camera is right and the rest is a guess."""


@runtime_checkable
class JointModel(Protocol):
    """A model that reconstructs frames of several places together, though they share no frame."""

    def joint(self, sides: Sequence[WindowSide]) -> tuple[Reconstruction, ...]:
        """Reconstruct all sides in one gauge. Raises `TrackingError` when a side cannot be posed."""
        ...


def reconstruct_jointly(model: Reconstructor, sides: Sequence[WindowSide]) -> tuple[Reconstruction, ...]:
    """Reconstruct frames of several places in one gauge, as one chunk where the model has no joint mode.

    Raises `TrackingError` when a side cannot be posed, or when such a chunk would have several cameras.
    """
    if isinstance(model, JointModel):
        return model.joint(sides)
    if len({side.camera for side in sides}) > 1:
        raise TrackingError("the places were filmed by different cameras")
    made = model([frame for side in sides for frame in side.frames], sides[0].camera)
    ends = np.cumsum([0, *(len(side.frames) for side in sides)]).tolist()
    return tuple(made.part(slice(*span)) for span in itertools.pairwise(ends))


def backproject(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Points of a depth image in camera coordinates, the depth's units. Shape (H, W) -> (H, W, 3)."""
    x = (np.arange(camera.width, dtype=np.float32) - camera.cx) / camera.fx
    y = (np.arange(camera.height, dtype=np.float32) - camera.cy) / camera.fy
    return np.stack([depth * x[None, :], depth * y[:, None], depth], axis=-1)
