"""A video file: decoded in order, never held, with the clock and the upright side that the file itself states."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource, SourceInfo
from list3r.frames.decoding.exif import believable, film_focal
from list3r.frames.decoding.picture import Upright, small_gray
from list3r.frames.decoding.shown import LOOKED_AT, check_no_panorama, shown_note, shown_part
from list3r.frames.decoding.timestamps import list_timestamps, open_container, packets, picture_stream
from list3r.frames.folder import centred_camera, fingerprint, reduced_note
from list3r.frames.layout import Optics
from list3r.frames.options import SourceOptions
from list3r.frames.registration.rig import Rig, build_rig
from list3r.frames.selection import select, sharpness
from list3r.memory.core.errors import FrameError, OptionError, SourceError

_MEASURED_PX, _THUMBNAIL_PX, _LOOKED_AT_PX = 320, 160, 640
_LOOKED = 360
"""Pictures that are decoded to see whether a video is damaged."""
_DAMAGED = "the video is damaged here"
_EARLIER = 4
"""Key frames that are tried, back from the nearest, before a frame counts as damaged."""


class VideoSource(FrameSource):
    """A `FrameSource` over one video stream. Every `read` opens the file again and seeks to its first frame."""

    def __init__(
        self,
        path: Path,
        options: SourceOptions,
        *,
        by_user: bool = True,
        whole: bool = False,
        like: VideoSource | None = None,
    ) -> None:
        """Lists the stream's packets without decoding them, then decodes one frame. Raises `SourceError`.

        `by_user`: the intrinsics of the options are the user's word, not that of a file beside the video. Black bars
        are cut off, but for the `whole` picture, or where they are of a video that this one is `like`.
        """
        if options.depth_intrinsics or options.T_color_depth:
            raise OptionError(f"{path} is a video without depth: leave out --depth-intrinsics and --depth-to-color")
        self._path, self._options, self._by_user = path, options, by_user
        self._stamps = list_timestamps(path)
        self._fps = self._stamps.rate if self._stamps.clock else options.fps or self._stamps.rate
        count = len(self._stamps)
        times_s = self._stamps.times_s(0, count) if self._stamps.clock else np.arange(count) / self._fps
        self._chosen = select(times_s, options, path, clock=self._stamps.clock, video=True)
        self._upright, self._rig = self._first(whole, like)
        self._info = self._describe()

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        for number, image in islice(self.pictures(start, stop), 0, None, step):
            if image is None:
                yield BadFrame(number, _DAMAGED)
                continue
            try:
                color = self._rig.straight(self._rig.cut(self._upright.color(image, self._rig.whole_size)))
            except FrameError as error:
                yield BadFrame(number, str(error))
            else:
                yield Frame(number, self._time_s(number), color, None, None)

    @property
    def stored_size(self) -> tuple[int, int]:
        """(height, width) of the pictures as stored, upright."""
        return self._rig.stored_size

    @property
    def stored_count(self) -> int:
        """Frames of the file, before any is left out."""
        return len(self._stamps)

    def number(self, position: int) -> int:
        """The number of the first frame of a position's window."""
        return int(self._chosen.starts[position])

    def time_s(self, number: int) -> float:
        """Seconds of a frame."""
        return self._time_s(number)

    def look(self, spots: int) -> Iterator[tuple[int, str]]:
        stamps, count = self._stamps, len(self._chosen)
        keys = np.searchsorted(stamps.stamps, stamps.keys) if not stamps.counted else np.zeros(0, int)
        starts = np.unique([0, *(self._chosen.position(int(k)) for k in keys)])
        starts = starts[np.unique(np.linspace(0, len(starts) - 1, spots).round().astype(int))]
        each = max(1, _LOOKED * count // (len(starts) * len(stamps)))
        for start, stop in pairwise([*starts.tolist(), count]):
            for number, image in self.pictures(start, min(stop, start + each)):
                yield number, _DAMAGED if image is None else ""

    def thumbnails(self) -> Iterator[NDArray[np.uint8] | None]:
        for _, image in self.pictures(0, len(self._chosen), threads=True):
            yield None if image is None else small_gray(image, _THUMBNAIL_PX)

    def read_grays(self, start: int, stop: int) -> Iterator[NDArray[np.uint8] | None]:
        for _, image in self.pictures(start, stop):
            yield None if image is None else small_gray(image, _LOOKED_AT_PX)

    def pictures(self, start: int, stop: int, *, threads: bool = False) -> Iterator[tuple[int, av.VideoFrame | None]]:
        """Number and picture of the frame handed out of each window at positions [start, stop); None where damaged."""
        windows = range(len(self._chosen))[start:stop]
        starts, stops = self._chosen.starts[windows.start :], self._chosen.stops[windows.start :]
        at, best, score = 0, _nothing(starts), -1.0
        decoded = self._decode(int(starts[0]), threads=threads) if windows else iter(())
        for number, image in decoded:
            while at < len(windows) and number >= stops[at]:
                yield best
                at, best, score = at + 1, _nothing(starts[at + 1 :]), -1.0
            if at == len(windows):
                return
            if number < starts[at] or image.is_corrupt:
                continue
            found = sharpness(small_gray(image, _MEASURED_PX)) if self._chosen.sharpest else 0.0
            if found > score:
                best, score = (number, image), found
            if number == stops[at] - 1:
                yield best
                at, best, score = at + 1, _nothing(starts[at + 1 :]), -1.0
                if at == len(windows):
                    return
        while at < len(windows):
            yield best
            at, best = at + 1, _nothing(starts[at + 1 :])

    def _decode(self, first: int, *, threads: bool = False) -> Iterator[tuple[int, av.VideoFrame]]:
        """Frame numbers and pictures from `first` on, in order; what cannot be decoded is left out.

        Decoding begins at the key frame before it. A container may land later than asked, or begin with pictures
        that lean on what lies before: then it is sent to the key frame before that one.
        """
        keys: list[int | None] = [*self._stamps.key_stamps_to(first, _EARLIER)] if first > 0 else []
        tries = keys if len(keys) == _EARLIER else [*keys, None]
        for stamp in tries:
            pictures = self._decode_from(stamp, threads=threads)
            opening = next(pictures, None)
            if opening is None or (opening[0] > first and stamp != tries[-1]):
                continue
            yield from (found for found in chain([opening], pictures) if found[0] >= first)
            return

    def _decode_from(self, stamp: int | None, *, threads: bool) -> Iterator[tuple[int, av.VideoFrame]]:
        """Frame numbers and pictures from the key frame at a stamp, or from the beginning."""
        with open_container(self._path, self._stamps.words) as container:
            stream = picture_stream(container)
            assert stream is not None
            if threads:
                stream.thread_type = "AUTO"
            if stamp is not None and not _sought(container, stream, stamp):
                return
            last = -1
            for count, image in enumerate(_decodable(container, stream)):
                number = self._stamps.number(image, count, last)
                if number is not None:
                    last = number
                    yield number, image

    def _time_s(self, number: int) -> float:
        return self._stamps.time_s(number) if self._stamps.clock else number / self._fps

    def _first(self, whole: bool, like: VideoSource | None) -> tuple[Upright, Rig]:
        optics = Optics(self._options.intrinsics, self._options.distortion or (), by_user=self._by_user)
        for _, image in self._decode(int(self._chosen.starts[0])):
            turned = Upright.of(image, self._stamps.aspect)
            shown = like._rig.shown if like is not None else None
            if like is None and not whole:
                if self._options.intrinsics is None:
                    check_no_panorama([turned.color(image, turned.size)], str(self._path))
                shown = shown_part(self._spread(turned, image))
            return turned, build_rig(optics, turned.size, None, None, self._options.max_side, shown)
        raise SourceError(f"{self._path}: no frame of it can be decoded; is the copy complete?")

    def _spread(self, turned: Upright, first: av.VideoFrame) -> Iterator[NDArray[np.uint8]]:
        """Yield whole pictures of places all over the video."""
        yield turned.color(first, turned.size)
        for position in np.unique(np.linspace(0, len(self._chosen) - 1, LOOKED_AT).astype(int))[1:].tolist():
            for _, image in self._decode(self.number(position)):
                with contextlib.suppress(FrameError):
                    yield turned.color(image, turned.size)
                break

    def _describe(self) -> SourceInfo:
        rig, notes = self._rig, [*self._upright.notes(), *self._stamps.notes]
        if rig.shown is not None:
            notes.append(shown_note(rig.shown, rig.stored_size))
        if rig.color_size != rig.shown_size:
            notes.append(reduced_note(rig))
        if not self._stamps.clock:
            notes.append(f"the file states no time for its frames: {self._fps:g} frames a second are assumed")
        if self._chosen.sharpest:
            notes.append("of each group of frames the sharpest is taken; --no-sharpest takes the first")
        focal = None if rig.camera is not None else self._stamps.focal_35mm
        height, width = rig.shown_size
        guess = believable(None if focal is None else film_focal(focal, width, height), width, height)
        listing = [(self._path.name, self._path.stat().st_size)]
        return SourceInfo(
            kind="video",
            path=str(self._path),
            frame_count=len(self._chosen),
            fps=self._fps,
            camera=rig.camera,
            has_depth=False,
            has_poses=False,
            fingerprint=fingerprint("video", listing, self._options),
            notes=tuple(notes),
            image_size=rig.color_size,
            stored_size=rig.shown_size,
            corner=(0, 0) if rig.shown is None else (rig.shown.top, rig.shown.left),
            camera_guess=None if guess is None else centred_camera(guess, rig),
        )


def _decodable(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.VideoFrame]:
    """Yield the pictures of a stream from where it stands; what cannot be decoded is left out."""
    for packet in packets(container, stream):
        try:
            images = packet.decode()
        except av.FFmpegError:
            continue
        yield from images


def _sought(container: Any, stream: Any, stamp: int) -> bool:
    """Whether a file could be sent to a key frame."""
    try:
        container.seek(stamp, stream=stream, backward=True)
    except av.FFmpegError:
        return False
    return True


def _nothing(starts: NDArray[np.int64]) -> tuple[int, av.VideoFrame | None]:
    """A window, the first of these, of which nothing was decoded."""
    return (int(starts[0]) if len(starts) else 0, None)
