"""Reconstruction `sfm`: RGB video on a CPU.

Corners are tracked through the chunk (`tracks`), its keyframes mapped by pycolmap (`links`, `mapping`), the frames
between them posed by the map (`frame_poses`), and dense depth swept between the posed frames (`mvs`). The chunk's frame
is the camera of its first posed frame, its unit such that the median of all depths is 2; its scale is relative. With
given poses the structure is triangulated in the source's world. Decision 0066 has the figures.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.core.errors import BaselineError, OptionError, TrackingError
from list3r.models.device import find_gpu
from list3r.reconstruction.base import Around, PosedOnly, Reconstruction
from list3r.reconstruction.features.detectors import make_detector
from list3r.reconstruction.features.learned import LearnedDetector
from list3r.reconstruction.mvs.stereo import PosedFrames, dense_depth, stereo_noise
from list3r.reconstruction.poses import given_poses, select_keyframes
from list3r.reconstruction.registry import ModelOptions
from list3r.reconstruction.sfm.adjustment import agreeing_rows
from list3r.reconstruction.sfm.colmap import pixel_unit
from list3r.reconstruction.sfm.frame_poses import PosedSegment, pose_segments
from list3r.reconstruction.sfm.global_map import with_global_map
from list3r.reconstruction.sfm.keyframe_features import make_finder
from list3r.reconstruction.sfm.links import context_step, corner_problem, keyframe_problem, with_neighbours
from list3r.reconstruction.sfm.mapping import MapProblem, Matches, SparseMap, build_maps, triangulate
from list3r.reconstruction.sfm.settings import MIDDLE_DEPTH, SfmSettings
from list3r.reconstruction.sfm.tracks import CornerTracks, Gray, follow_corners
from list3r.reconstruction.sfm.two_view import verified_rows

Poses = NDArray[np.float64]


def make(options: ModelOptions) -> SfmReconstructor:
    """Return the model; dense depth runs on the GPU where there is one."""
    device = options.device
    if device == "auto":
        device = "cpu" if find_gpu() is None else "cuda"
    detector = None
    if options.local_features != "sift":
        detector = make_detector(options.local_features, Path(options.feature_weights or ""), options.device)
    return SfmReconstructor(options.settings.sfm, options.poses, device, options.camera_known, detector)


@dataclass(frozen=True)
class SfmReconstructor:
    """Poses and depth of RGB frames."""

    settings: SfmSettings = field(default_factory=SfmSettings)
    poses: str = "estimate"
    """given or estimate."""
    device: str = "cpu"
    camera_known: bool = True
    """Otherwise the focal length is estimated from the chunk alone."""
    detector: LearnedDetector | None = None
    """Finds the features of keyframes that tracks do not connect; None for SIFT."""

    def __post_init__(self) -> None:
        if self.poses not in ("given", "estimate"):
            raise OptionError(f"poses {self.poses!r}: choose given or estimate")

    def __call__(self, frames: Sequence[Frame], camera: Camera) -> Reconstruction:
        """Reconstruct the largest connected part of a chunk; the other frames are not posed.

        Raises `TrackingError` when the camera cannot be tracked through any two frames, with the reason.
        """
        grays = [f.gray() for f in frames]
        return self._finish(frames, self._segments(frames, grays, camera)[0])

    def parts(
        self,
        frames: Sequence[Frame],
        camera: Camera,
        around: Around | None = None,
        deep: Collection[int] | None = None,
    ) -> list[Reconstruction]:
        """All connected parts of a chunk, in order of time; frames of none are among the largest's.

        With `around` some frames before and behind the chunk are mapped with it. With `deep` only the frames of these
        numbers get depth, and the others a pose. Raises `TrackingError` as above.
        """
        grays = [f.gray() for f in frames]
        first, *others = self._segments(frames, grays, camera, around)
        others = [s for s in others if len(s.T_map_cam) >= self.settings.least_segment]
        elsewhere = {k for s in others for k in s.T_map_cam}
        groups = [(first, [k for k in range(len(frames)) if k not in elsewhere])]
        groups += [(s, sorted(s.T_map_cam)) for s in others]
        groups.sort(key=lambda group: max(group[0].T_map_cam))
        return [self._finish([frames[k] for k in kept], _renumbered(s, kept), deep) for s, kept in groups]

    def placed(self, frames: Sequence[Frame], camera: Camera, T_map_cam: Mapping[int, Poses]) -> Reconstruction:
        """Reconstruct a chunk of a video that was mapped as a whole, in the map's frame of reference and scale.

        `T_map_cam` is by Frame.index. Raises `TrackingError` where none of the frames is in the map.
        """
        known = {k: T_map_cam[f.index] for k, f in enumerate(frames) if f.index in T_map_cam}
        if not known:
            raise TrackingError(f"{_span(frames)}: the map of the whole video does not hold them")
        tracks = follow_corners([f.gray() for f in frames], self.settings.tracks)
        problem = corner_problem(tracks)
        gate = self.settings.mapping.pose_error_px * pixel_unit(camera)
        verified = agreeing_rows(problem, camera, known, gate)
        return self._finish(frames, self._triangulated(tracks, problem, camera, known, verified), in_place=True)

    def _segments(
        self, frames: Sequence[Frame], grays: Sequence[Gray], camera: Camera, around: Around | None = None
    ) -> list[PosedSegment]:
        """Posed frames with their points, the largest segment first."""
        s = self.settings
        tracks = follow_corners(grays, s.tracks)
        finder = make_finder(grays, [f.color for f in frames], self.detector, s.links.features)
        problem = keyframe_problem(tracks, grays, s.links, finder)
        if self.poses == "given":
            return [self._given(frames, tracks, problem, camera)]
        _check_motion(frames, tracks, s)
        maps = self._maps(frames, grays, tracks, problem, camera, around)
        segments = pose_segments(maps, tracks, grays, s.fill)
        if not segments:
            raise _no_map(frames, tracks)
        return segments

    def _maps(
        self,
        frames: Sequence[Frame],
        grays: Sequence[Gray],
        tracks: CornerTracks,
        problem: MapProblem,
        camera: Camera,
        around: Around | None,
    ) -> list[SparseMap]:
        """Maps of the keyframes, made with the help of frames around the chunk."""
        s = self.settings
        before, behind = ((), ()) if around is None else around(context_step(tracks, s.links), s.links.context)
        context = [*before, *behind]
        early, late = np.split(len(frames) + np.arange(len(context)), [len(before)])
        count = s.links.ahead_features
        few = replace(s.links.features, width=s.links.ahead_width, count=count, learned_count=count)
        seen, colors = [*grays, *(f.gray() for f in context)], [f.color for f in (*frames, *context)]
        finder = make_finder(seen, colors, self.detector, few)
        wider = with_neighbours(problem, early.tolist(), late.tolist(), finder, s.links)
        if not self.camera_known:
            return build_maps(wider, camera, free_camera="focal", settings=s.calibration.mapping)
        verified = verified_rows(wider, camera, s.mapping)
        maps = build_maps(wider, camera, settings=s.mapping, verified=verified)
        return with_global_map(maps, wider, camera, s.mapping, verified)

    def _given(
        self, frames: Sequence[Frame], tracks: CornerTracks, problem: MapProblem, camera: Camera
    ) -> PosedSegment:
        T, posed = given_poses(frames)
        return self._triangulated(tracks, problem, camera, {k: T[k] for k in np.flatnonzero(posed).tolist()})

    def _triangulated(
        self,
        tracks: CornerTracks,
        problem: MapProblem,
        camera: Camera,
        poses: dict[int, Poses],
        verified: Matches | None = None,
    ) -> PosedSegment:
        found = triangulate(problem, camera, poses, self.settings.mapping, verified)
        return _with_given_poses(found or SparseMap({}, {}, camera), poses, tracks)

    def _finish(
        self,
        frames: Sequence[Frame],
        segment: PosedSegment,
        deep: Collection[int] | None = None,
        in_place: bool = False,
    ) -> Reconstruction:
        """Dense depth, units, keyframes; `in_place` keeps frame of reference and scale."""
        T, posed = np.tile(np.eye(4), (len(frames), 1, 1)), np.zeros(len(frames), bool)
        for position, pose in segment.T_map_cam.items():
            T[position], posed[position] = pose, True
        sparse = [segment.depths(k) if k in segment.seen and len(segment.seen[k][0]) else None for k in range(len(T))]
        depths = np.concatenate([np.ones(0), *(s[1] for s in sparse if s is not None)])
        if self.poses == "estimate" and not in_place:
            scale = MIDDLE_DEPTH / float(np.median(depths)) if len(depths) else 1.0
            T[posed] = np.linalg.inv(T[int(np.flatnonzero(posed)[0])]) @ T[posed]
            T[:, :3, 3] *= scale
            sparse = [None if s is None else (s[0], s[1] * scale) for s in sparse]
        camera, indices, between = segment.found.camera, np.array([f.index for f in frames], np.int64), None
        if deep is not None:
            used = np.isin(indices, list(deep))
            between = PosedOnly(indices[~used], posed[~used], T[~used])
            kept = np.flatnonzero(used).tolist()
            frames, sparse = [frames[k] for k in kept], [sparse[k] for k in kept]
            indices, posed, T = indices[used], posed[used], T[used]
        depth, confidence = dense_depth(PosedFrames(frames, posed, T, camera, sparse), self.settings.dense, self.device)
        keyframes = select_keyframes(T, posed, list(depth), self.settings.keyframes)
        return Reconstruction(
            frame_indices=indices,
            posed=posed,
            T_chunk_cam=T,
            camera=camera,
            depth=depth,
            confidence=confidence,
            scale_kind="metric" if self.poses == "given" else "relative",
            keyframes=np.array(keyframes, np.int64),
            depth_noise=stereo_noise(depth, confidence, self.settings.dense.trust),
            between=between,
        )


def _renumbered(segment: PosedSegment, kept: Sequence[int]) -> PosedSegment:
    """Return the segment with its frames numbered by their place in `kept`."""
    place = {k: n for n, k in enumerate(kept)}
    return PosedSegment(
        segment.found,
        {place[k]: T for k, T in segment.T_map_cam.items()},
        {place[k]: seen for k, seen in segment.seen.items()},
    )


def _with_given_poses(found: SparseMap, poses: dict[int, Poses], tracks: CornerTracks) -> PosedSegment:
    numbers = np.array(sorted(found.points), np.int64)
    places = np.array([found.points[int(n)] for n in numbers]).reshape(-1, 3)
    seen = {}
    for position in poses:
        known = np.isin(tracks.ids[position], numbers)
        seen[position] = tracks.xy[position][known], places[np.searchsorted(numbers, tracks.ids[position][known])]
    return PosedSegment(found, poses, seen)


def _check_motion(frames: Sequence[Frame], tracks: CornerTracks, settings: SfmSettings) -> None:
    """Raise `TrackingError` for frames without trackable texture or without motion."""
    if len(frames) < 2:
        raise BaselineError(f"{_span(frames)}: depth from colour needs at least two frames from different places")
    if tracks.run.max(initial=-1) < 0:
        height, width = frames[0].color.shape[:2]
        why = "the pictures are black, blank or out of focus"
        if max(height, width) < settings.least_side_px:
            why = f"pictures of {width}x{height} are too small; give them as they were taken"
        raise TrackingError(f"{_span(frames)}: no texture to follow; {why}")
    if np.nansum(tracks.flow) < settings.least_flow:
        raise BaselineError(f"{_span(frames)}: the camera does not move, and depth from colour needs motion")


def _no_map(frames: Sequence[Frame], tracks: CornerTracks) -> TrackingError:
    """Return the error for frames of which no map could be made."""
    if int(tracks.run.max()) > len(tracks.run) // 4:
        why = "the camera moves too fast to be followed; film slower, or take more frames"
        return TrackingError(f"{_span(frames)}: {why}")
    why = "the camera only turns, or hardly moves; depth from colour needs it to move sideways"
    return BaselineError(f"{_span(frames)}: {why}")


def _span(frames: Sequence[Frame]) -> str:
    first, last = frames[0].index, frames[-1].index
    return f"frame {first}" if first == last else f"frames {first} to {last}"
