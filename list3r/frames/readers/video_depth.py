"""A recording whose pictures are a video and whose depth and poses lie beside it, by the number of the frame."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Camera, Frame, FrameSource, SourceInfo
from list3r.frames.beside import refuse_left
from list3r.frames.decoding.decode import read_raw_depth, sure_depth
from list3r.frames.folder import NOT_STANDING, NOWHERE_SURE, without_depth, without_pose
from list3r.frames.layout import Optics
from list3r.frames.options import Intrinsics, SourceOptions
from list3r.frames.readers.video import VideoSource
from list3r.frames.recordings.axes import lying_note, turns_in_gravity
from list3r.frames.recordings.stored import CodedArray, Stored
from list3r.frames.registration.rig import WORKING_SIDES, build_rig
from list3r.frames.unread import not_read, not_read_note
from list3r.memory.core.errors import FrameError

_FRAMES_TRIED = 12


@dataclass(frozen=True)
class RecordingParts:
    """What lies beside the video."""

    kind: str
    video: Path
    intrinsics: Intrinsics
    """Of the pictures as stored; depth shares the view."""
    depth: Mapping[int, Stored | CodedArray]
    poses: Mapping[int, NDArray[np.float64]]
    """T_source_cam (4, 4), OpenCV's axes."""
    units_per_m: float
    note: str
    z_up: bool = False
    poses_drift: bool = False
    confidence: Callable[[int], Path] | None = None
    """The file of a frame's confidence, which need not exist."""
    least_confidence: int = 0
    lenses: Mapping[int, Intrinsics] = field(default_factory=dict)
    """Frames' own cameras, of the pictures as stored, where they differ from `intrinsics`."""


class VideoWithDepth(FrameSource):
    """A `FrameSource`: the pictures of the video, each with depth and pose of its number."""

    def __init__(self, root: Path, parts: RecordingParts, options: SourceOptions) -> None:
        """Raises `SourceError` and `OptionError` where the files do not fit together."""
        side = WORKING_SIDES[True] if options.max_side is None else options.max_side
        words = replace(options, kind="auto", intrinsics=parts.intrinsics, max_side=side, depth_scale=None)
        given = options.intrinsics is not None
        self._video, self._parts = VideoSource(parts.video, words, by_user=given, whole=True), parts
        stored = self._video.stored_size
        scale = options.depth_scale or parts.units_per_m
        lens = options.distortion or ()
        optics = Optics(
            parts.intrinsics, lens, depth_scale=scale, intrinsics_size=stored, shares_view=True, by_user=given
        )
        size = read_raw_depth(next(iter(parts.depth.values()))).shape if parts.depth else None
        self._rig = build_rig(optics, stored, (size[0], size[1]) if size else None, options.max_depth_m, side)
        self._info = self._describe(root, options.kind)

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        for frame in self._video.read_every(start, stop, step):
            try:
                yield frame if isinstance(frame, BadFrame) else self._with_depth(frame)
            except FrameError as error:
                yield BadFrame(frame.index, str(error))

    def position(self, index: int) -> int:
        return self._video.position(index)

    def read_poses(self) -> list[tuple[int, float, NDArray[np.float64]]]:
        numbers = (self._video.number(k) for k in range(self._info.frame_count))
        found = ((k, self._video.time_s(k), self._parts.poses.get(k)) for k in numbers)
        return [(k, time_s, T) for k, time_s, T in found if T is not None]

    def _with_depth(self, frame: Frame) -> Frame:
        depth, lens, color = None, None, frame.color
        if frame.index in self._parts.lenses:
            height, width = self._rig.stored_size
            lens = Camera(width, height, *self._parts.lenses[frame.index]).resized(*color.shape[:2])
            color = self._rig.color(color, lens)
        if self._parts.depth:
            if frame.index not in self._parts.depth:
                raise FrameError(f"frame {frame.index} has no depth image")
            depth = self._rig.depth(self._sure(frame.index), lens)
        return replace(frame, color=color, depth=depth, T_source_cam=self._parts.poses.get(frame.index))

    def _sure(self, number: int) -> NDArray[np.generic]:
        raw = read_raw_depth(self._parts.depth[number])
        path = None if self._parts.confidence is None else self._parts.confidence(number)
        if path is None or not path.is_file():
            return raw
        return sure_depth(raw, read_raw_depth(path), self._parts.least_confidence)

    def _doubts(self) -> tuple[str, ...]:
        """Return what looks wrong with depth, of some frames spread over the recording."""
        numbers = sorted(self._parts.depth)
        some = numbers[:: max(1, len(numbers) // _FRAMES_TRIED)]
        with contextlib.suppress(FrameError):
            sure = not some or any(self._sure(k).any() for k in some)
            return (*self._count_doubts(), *(() if sure else (NOWHERE_SURE,)))
        return self._count_doubts()

    def _count_doubts(self) -> tuple[str, ...]:
        """Return how many frames of the video lack a pose or a depth image that others have."""
        total, parts = self._video.stored_count, self._parts
        posed = sum(k < total for k in parts.poses)
        deep = sorted(k for k in parts.depth if k < total)
        return (
            *((without_pose(total - posed, total),) if 0 < posed < total else ()),
            *((without_depth(deep, total),) if 0 < len(deep) < total else ()),
        )

    def _some_files(self) -> list[Stored | CodedArray | None]:
        """Return the video, and depth and confidence of the first frame."""
        parts, first = self._parts, min(self._parts.depth, default=0)
        return [parts.video, parts.depth.get(first), parts.confidence(first) if parts.confidence else None]

    def _describe(self, root: Path, asked: str) -> SourceInfo:
        info, parts, registration = self._video.info, self._parts, self._rig.registration
        left = not_read(root, parts.kind, self._some_files())
        if asked == "auto":
            refuse_left(root, parts.kind, left, depth=bool(parts.depth), poses=bool(parts.poses), camera=True)
        turns = turns_in_gravity(list(parts.poses.values())) if parts.z_up else None
        return replace(
            info,
            kind=parts.kind,
            path=str(root),
            has_depth=bool(parts.depth),
            has_poses=bool(parts.poses),
            depth_camera=registration.depth_camera if registration else None,
            T_color_depth=registration.T_color_depth if registration else None,
            depth_scale=self._rig.depth_scale if parts.depth else None,
            notes=(
                *info.notes,
                parts.note,
                *self._doubts(),
                *((NOT_STANDING,) if parts.z_up and parts.poses and turns is None else ()),
                *lying_note(turns or 0),
                *not_read_note(left),
            ),
            z_up=turns is not None,
            poses_drift=parts.poses_drift,
        )
