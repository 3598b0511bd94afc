"""A video file: decoded in order, never held, with the clock and the upright side that the file itself states."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, SourceInfo
from list3r.frames.folder import DEFAULT_FPS, fingerprint, selected_frames
from list3r.frames.layout import Optics
from list3r.frames.options import SourceOptions
from list3r.frames.rig import Rig, build_rig
from list3r.memory.errors import FrameError, OptionError, SourceError

_NOT_VIDEO = ("tty", "image2", "_pipe", "gif_pipe")


class VideoSource:
    """A `FrameSource` over one video stream. Every `read` opens the file anew and seeks to its first frame."""

    def __init__(self, path: Path, options: SourceOptions) -> None:
        """Lists the stream's packets without decoding them, then decodes one frame. Raises `SourceError`."""
        if options.depth_intrinsics or options.T_color_depth:
            raise OptionError(f"{path} is a video without depth: leave out --depth-intrinsics and --depth-to-color")
        self._path, self._options = path, options
        self._stamps, self._time_base, rate = _list_stamps(path)
        self._clock = _has_clock(self._stamps)
        self._numbers = selected_frames(len(self._stamps), options, path)
        self._fps = options.fps or rate
        self._number_of = {stamp: k for k, stamp in enumerate(self._stamps)} if self._clock else {}
        self._rig, rotation = self._first()
        self._info = self._describe(rotation)

    @property
    def info(self) -> SourceInfo:
        """What was recognised."""
        return self._info

    def read(self, start: int, stop: int) -> Iterator[Frame | BadFrame]:
        """Frames at positions [start, stop) in order; one that cannot be decoded comes as a `BadFrame`."""
        wanted = iter(self._numbers[start:stop])
        number = next(wanted, None)
        if number is None:
            return
        for found, image in self._decode(number):
            while number is not None and number < found:
                yield BadFrame(number, "the video is damaged here")
                number = next(wanted, None)
            if number is None:
                return
            if found == number:
                yield self._frame(number, image)
                number = next(wanted, None)
                if number is None:
                    return
        while number is not None:
            yield BadFrame(number, "the video is damaged here")
            number = next(wanted, None)

    def _frame(self, number: int, image: av.VideoFrame) -> Frame | BadFrame:
        if image.is_corrupt:
            return BadFrame(number, "the video is damaged here")
        try:
            color = self._rig.color(upright(image))
        except FrameError as error:
            return BadFrame(number, str(error))
        return Frame(number, self._time_s(number), color, None, None)

    def _time_s(self, number: int) -> float:
        if self._options.fps or not self._clock:
            return number / self._fps
        return float((self._stamps[number] - self._stamps[0]) * self._time_base)

    def _decode(self, first: int) -> Iterator[tuple[int, av.VideoFrame]]:
        """Frame numbers and pictures from `first` on, in order; what cannot be decoded is left out."""
        with av.open(str(self._path)) as container:
            stream = container.streams.video[0]
            if self._clock and first > 0:
                container.seek(self._stamps[first], stream=stream, backward=True)
            count = 0
            for image in _pictures(container, stream):
                number = self._number_of.get(image.pts or 0, -1) if self._clock else count
                count += 1
                if number >= first:
                    yield number, image

    def _first(self) -> tuple[Rig, int]:
        optics = Optics(self._options.intrinsics, self._options.distortion or ())
        for _, image in self._decode(self._numbers[0]):
            color = upright(image)
            rig = build_rig(optics, (color.shape[0], color.shape[1]), None, None)
            return rig, _quarter_turns(image) * 90
        raise SourceError(f"{self._path}: no frame of it can be decoded; is the copy complete?")

    def _describe(self, rotation: int) -> SourceInfo:
        notes = []
        if rotation:
            notes.append(f"frames are turned by {rotation} degrees counter-clockwise, as the file says")
        if not self._clock:
            notes.append(f"the file states no time for its frames: {self._fps:g} frames a second are assumed")
        missing = ["depth: this version builds from RGB-D folders (7-Scenes, TUM, Replica) only"]
        if self._rig.camera is None:
            missing.append("the camera's intrinsics are unknown: --intrinsics fx,fy,cx,cy")
        listing = [(self._path.name, self._path.stat().st_size)]
        return SourceInfo(
            kind="video",
            path=str(self._path),
            frame_count=len(self._numbers),
            fps=self._fps,
            camera=self._rig.camera,
            has_depth=False,
            has_poses=False,
            scale_kind="relative",
            fingerprint=fingerprint("video", listing, self._options),
            notes=tuple(notes),
            missing=tuple(missing),
            image_size=self._rig.color_size,
        )


def upright(image: av.VideoFrame) -> NDArray[np.uint8]:
    """RGB, turned as the file's display matrix says. Shape (H, W, 3)."""
    return np.ascontiguousarray(np.rot90(image.to_ndarray(format="rgb24"), _quarter_turns(image)))


def _quarter_turns(image: av.VideoFrame) -> int:
    """Counter-clockwise quarter turns that put the picture upright."""
    return round(getattr(image, "rotation", 0) / 90) % 4


def _list_stamps(path: Path) -> tuple[list[int], Fraction, float]:
    """Presentation stamps of every picture, ascending, their unit in seconds, and the mean frame rate.

    Where stamps are missing or doubled they are 0, 1, 2, ... twice over, see `_has_clock`.
    """
    try:
        with av.open(str(path)) as container:
            if not container.streams.video or any(sign in container.format.name for sign in _NOT_VIDEO):
                raise SourceError(f"{path} is not a video ({container.format.name}); give a video file or a folder")
            stream = container.streams.video[0]
            packets = (p for p in _packets(container, stream) if p.size and not p.is_discard)
            stamps = [p.pts for p in packets]
            time_base = stream.time_base or Fraction(1, 1)
            rate = float(stream.average_rate or stream.base_rate or 0) or DEFAULT_FPS
    except av.FFmpegError as error:
        raise SourceError(f"{path} is not a video that can be read ({error.strerror})") from None
    if not stamps:
        raise SourceError(f"{path} holds no frames; is the copy complete?")
    known = [s for s in stamps if s is not None]
    if len(known) < len(stamps) or len(set(known)) < len(known):
        return [0] * len(stamps), time_base, rate
    return sorted(known), time_base, rate


def _has_clock(stamps: list[int]) -> bool:
    return len(stamps) == 1 or stamps[-1] > stamps[0]


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets up to the end, or to where the file breaks off."""
    try:
        yield from container.demux(stream)
    except av.FFmpegError:
        return


def _pictures(container: Any, stream: Any) -> Iterator[av.VideoFrame]:
    """Decoded pictures in display order; packets that cannot be decoded are passed over."""
    for packet in _packets(container, stream):
        try:
            yield from packet.decode()
        except av.FFmpegError:
            continue
