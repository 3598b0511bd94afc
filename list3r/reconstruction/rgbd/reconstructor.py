"""Reconstruction `rgbd`: sensor depth with poses that are given or estimated.

Estimated poses come from dense registration of each frame to a model of surface elements, depth and brightness
together (`odometry`, `frame_registration`, `surfels`); local features find frames again after a break (`features`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.core.errors import OptionError, TrackingError
from list3r.reconstruction.base import Around, PosedOnly, Reconstruction
from list3r.reconstruction.motion.free_space import SmallFrames, movers_in_free_space
from list3r.reconstruction.motion.tracks import track_movers
from list3r.reconstruction.pose_prior import bridged, source_from_chunk, stacked
from list3r.reconstruction.poses import given_poses, select_keyframes
from list3r.reconstruction.registry import ModelOptions
from list3r.reconstruction.rgbd.confidence import depth_confidence
from list3r.reconstruction.rgbd.odometry import CameraTracker
from list3r.reconstruction.rgbd.settings import RgbdSettings
from list3r.reconstruction.rgbd.view import Floats

T_ = TypeVar("T_")


def make(options: ModelOptions) -> RgbdReconstructor:
    """Return the model; it runs on the CPU whatever device is named."""
    return RgbdReconstructor(options.settings.rgbd, options.poses)


@dataclass(frozen=True)
class RgbdReconstructor:
    """Poses and depth of RGB-D frames, metres.

    The chunk's frame is the camera of its first posed frame where poses are estimated, the source's own world where
    they are given, and near that where they are a prior.
    """

    settings: RgbdSettings = field(default_factory=RgbdSettings)
    poses: str = "estimate"
    """given, prior or estimate."""

    def __post_init__(self) -> None:
        if self.poses not in ("given", "prior", "estimate"):
            raise OptionError(f"poses {self.poses!r}: choose given, prior or estimate")

    def __call__(self, frames: Sequence[Frame], camera: Camera) -> Reconstruction:
        """Reconstruct a chunk.

        Raises `TrackingError` when the frames have no depth, when no given pose is valid, or when no two frames can
        be related.
        """
        return self.thinned(frames, camera, {frame.index for frame in frames})

    def thinned(self, frames: Sequence[Frame], camera: Camera, deep: Collection[int]) -> Reconstruction:
        """Reconstruct a chunk of which only the frames of the numbers `deep` get depth, and the others a pose.

        The others are used only where the camera is lost without them. Raises as above.
        """
        return self._largest(frames, camera, deep)[0]

    def parts(
        self,
        frames: Sequence[Frame],
        camera: Camera,
        around: Around | None = None,
        deep: Collection[int] | None = None,
    ) -> list[Reconstruction]:
        """All stretches that could be tracked, each by itself, in order of time; frames of none are the largest's.

        A chunk falls into several where nothing holds the camera for a while, as before a bare wall. `deep` as in
        `thinned`. Raises as above.
        """
        all_deep = {frame.index for frame in frames} if deep is None else deep
        largest, apart = self._largest(frames, camera, all_deep)
        others: list[Reconstruction] = []
        for stretch in apart:
            try:
                others += self.parts([frames[k] for k in stretch], camera, None, all_deep)
            except TrackingError:
                continue
        elsewhere = {index for part in others for index in _numbers(part)}
        return sorted([_without(largest, elsewhere), *others], key=lambda part: max(_numbers(part)))

    def _largest(
        self, frames: Sequence[Frame], camera: Camera, deep: Collection[int]
    ) -> tuple[Reconstruction, list[list[int]]]:
        """Reconstruct the longest stretch of a chunk that could be tracked; also the positions of the others."""
        used = [k for k, frame in enumerate(frames) if frame.index in deep]
        shown = [frames[k] for k in used]
        if not any(frame.depth is not None for frame in shown):
            raise TrackingError("the frames have no depth; the rgbd reconstruction needs it")
        depth = np.zeros((len(shown), camera.height, camera.width), np.float32)
        for k, frame in enumerate(shown):
            if frame.depth is not None:
                depth[k] = frame.depth
        faced: Mapping[int, Floats] = {}
        apart: list[list[int]] = []
        unsure: frozenset[int] = frozenset()
        if self.poses == "given":
            T, posed = given_poses(frames)
            movers = self._find_movers(shown, T[used], posed[used], camera, {})
        else:
            T, posed, keyframes, tracker = self._estimate(frames, camera, used)
            movers = self._find_movers(shown, T[used], posed[used], camera, _among(tracker.mover_masks, used))
            if movers is not None:
                known = {used[k]: _rim(m > 0) for k, m in enumerate(movers) if m.any()}
                T, posed, keyframes, tracker = self._estimate(frames, camera, used, known)
                movers = self._find_movers(shown, T[used], posed[used], camera, _among(tracker.mover_masks, used))
            faced, apart = _among(tracker.cosines, used), self._apart(tracker, posed)
            tracked = {*tracker.segments[0].T_segment_cam, *(k for run in tracker.passed for k in run)}
            unsure = frozenset(frames[k].index for k in tracker.unproven | (set(range(len(frames))) - tracked))
        if not posed[used].any():
            raise TrackingError(f"the camera is not found in frames {frames[0].index} to {frames[-1].index}")
        if self.poses == "given" or len(used) < len(frames):
            depths = [frame.depth for frame in shown]
            keyframes = select_keyframes(T[used], posed[used], depths, self.settings.odometry.keyframes)
        if movers is not None:
            _take_out(depth, movers)
            faced = {k: cosine for k, cosine in faced.items() if not movers[k].any()}
        confidence = np.zeros(depth.shape, np.float16)
        for k, image in enumerate(depth):
            confidence[k] = depth_confidence(image, camera, self.settings.confidence, faced.get(k))
        indices = np.array([frame.index for frame in frames], np.int64)
        rest = np.setdiff1d(np.arange(len(frames)), used)
        largest = Reconstruction(
            frame_indices=indices[used],
            posed=posed[used],
            T_chunk_cam=T[used],
            camera=camera,
            depth=depth,
            confidence=confidence,
            scale_kind="metric",
            keyframes=np.array(keyframes, np.int64),
            movers=movers,
            between=PosedOnly(indices[rest], posed[rest], T[rest]) if len(rest) else None,
            unsure=unsure,
        )
        return largest, apart

    def _apart(self, tracker: CameraTracker, posed: NDArray[np.bool_]) -> list[list[int]]:
        """Positions of the frames of each stretch that stayed apart, with those that were skipped within it."""
        out = []
        for segment in tracker.segments:
            own = set(segment.T_segment_cam)
            own |= {k for run in tracker.passed if {run[0] - 1, run[-1] + 1} <= own for k in run}
            own -= set(np.flatnonzero(posed).tolist())
            if len(own) >= self.settings.odometry.short_segment:
                out.append(sorted(own))
        return out

    def _find_movers(
        self,
        frames: Sequence[Frame],
        T_chunk_cam: NDArray[np.float64],
        posed: NDArray[np.bool_],
        camera: Camera,
        hints: Mapping[int, NDArray[np.bool_]],
    ) -> NDArray[np.uint8] | None:
        """Number the movers, see `Reconstruction.movers`."""
        small = SmallFrames.of([f.depth for f in frames], T_chunk_cam, posed, camera, self.settings.movers.width)
        masks = movers_in_free_space(small, hints, self.settings.movers)
        if masks is None:
            return None
        times_s = np.array([f.time_s for f in frames])
        return track_movers(masks, [f.color for f in frames], times_s, small, self.settings.mover_tracks)

    def _estimate(
        self,
        frames: Sequence[Frame],
        camera: Camera,
        used: Sequence[int],
        known: Mapping[int, NDArray[np.bool_]] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], list[int], CameraTracker]:
        """Poses, which frames have one, keyframes, and the tracker; without the masks of `known`.

        Frames that are not `used` (positions) are looked at only where the camera is lost without them.
        """
        how = self.settings.odometry
        between = set(range(len(frames))) - set(used)
        tracker = CameraTracker(frames, camera, how, known, prior=self.poses == "prior", between=between)
        segments = tracker.run()
        if not segments or (len(segments[0].T_segment_cam) < 2 and len(frames) > 1):
            raise TrackingError(
                f"no two of the {len(frames)} frames from {frames[0].index} to {frames[-1].index} can be related; "
                "the camera moves too fast, or depth or texture is missing"
            )
        T, posed = np.tile(np.eye(4), (len(frames), 1, 1)), np.zeros(len(frames), bool)
        for position, pose in segments[0].T_segment_cam.items():
            T[position], posed[position] = pose, True
        T[posed] = np.linalg.inv(T[int(np.flatnonzero(posed)[0])]) @ T[posed]
        _pose_passed(T, posed, tracker.passed, [frame.time_s for frame in frames])
        if self.poses == "prior":
            given = stacked([f.T_source_cam for f in frames])
            T_source_chunk = source_from_chunk(T, posed, given, self.settings.odometry.prior)
            T, posed = bridged(T, posed, given, self.settings.odometry.prior)
            T[posed] = T[posed] if T_source_chunk is None else T_source_chunk @ T[posed]
        return T, posed, segments[0].keyframes, tracker


def _pose_passed(
    T: NDArray[np.float64], posed: NDArray[np.bool_], passed: Sequence[Sequence[int]], times_s: Sequence[float]
) -> None:
    """Pose skipped frames, in place, by a steady motion between the two frames around each run of them.

    Where the time stamps are equal they are in the middle. `T` (F, 4, 4) and `posed` (F,) are of all frames.
    """
    for run in passed:
        before, after = run[0] - 1, run[-1] + 1
        if not (posed[before] and posed[after]):
            continue
        step = np.linalg.inv(T[before]) @ T[after]
        turn, whole_s = cv2.Rodrigues(step[:3, :3])[0], times_s[after] - times_s[before]
        for position in run:
            share = (times_s[position] - times_s[before]) / whole_s if whole_s > 0 else 0.5
            part = np.eye(4)
            part[:3, :3], part[:3, 3] = cv2.Rodrigues(share * turn)[0], share * step[:3, 3]
            T[position], posed[position] = T[before] @ part, True


def _among(rows: Mapping[int, T_], used: Sequence[int]) -> dict[int, T_]:
    """Values of the `used` frames, renumbered from their position to their rank among them."""
    return {place: rows[k] for place, k in enumerate(used) if k in rows}


def _numbers(part: Reconstruction) -> list[int]:
    """`Frame.index` of all frames of a part."""
    between = [] if part.between is None else part.between.frame_indices.tolist()
    return [*part.frame_indices.tolist(), *between]


def _without(part: Reconstruction, elsewhere: Collection[int]) -> Reconstruction:
    """The part without frames, none of them posed, of the numbers `elsewhere`."""
    if not elsewhere:
        return part
    numbers = np.array(sorted(elsewhere), np.int64)
    keep = ~np.isin(part.frame_indices, numbers)
    between = part.between
    if between is not None:
        here = ~np.isin(between.frame_indices, numbers)
        between = PosedOnly(between.frame_indices[here], between.posed[here], between.T_chunk_cam[here])
    return replace(
        part,
        frame_indices=part.frame_indices[keep],
        posed=part.posed[keep],
        T_chunk_cam=part.T_chunk_cam[keep],
        depth=part.depth[keep],
        confidence=part.confidence[keep],
        keyframes=np.searchsorted(np.flatnonzero(keep), part.keyframes),
        movers=None if part.movers is None else part.movers[keep],
        between=between if between is not None and len(between.frame_indices) else None,
    )


def _rim(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _take_out(depth: NDArray[np.float32], movers: NDArray[np.uint8]) -> None:
    """Make depth (F, H, W) unknown, in place, on movers: the rest is the static scene."""
    height, width = depth.shape[1:]
    stride = -(-width // movers.shape[2])
    for position in np.flatnonzero(movers.any(axis=(1, 2))).tolist():
        full = np.kron(_rim(movers[position] > 0), np.ones((stride, stride), bool))
        depth[position][full[:height, :width]] = 0.0
