"""Several video files of one recording, one after the other: a camera that begins a new file every few minutes."""

from __future__ import annotations

import hashlib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource
from list3r.frames.options import SourceOptions
from list3r.frames.readers.video import VideoSource
from list3r.memory.core.errors import OptionError, SourceError


class JoinedVideos(FrameSource):
    """A `FrameSource` over files in the order given; frames are numbered and timed as if they were one file."""

    def __init__(self, paths: Sequence[Path], options: SourceOptions) -> None:
        """Raises `SourceError` for a file that is no video or of another size, `OptionError` for a range."""
        if any(v is not None for v in (options.start, options.stop, options.start_s, options.end_s)):
            raise OptionError("--frames, --start and --end work on one file; cut the files, or give one")
        self._parts = [VideoSource(paths[0], replace(options, more=None))]
        self._parts += [VideoSource(p, replace(options, more=None), like=self._parts[0]) for p in paths[1:]]
        first = self._parts[0].info
        for path, part in zip(paths, self._parts, strict=True):
            if part.stored_size != self._parts[0].stored_size:
                (h, w), (height, width) = part.stored_size, self._parts[0].stored_size
                raise SourceError(
                    f"{path} has pictures of {w}x{h}, {paths[0]} of {width}x{height}; give files of one recording"
                )
        self._positions = np.cumsum([0, *(p.info.frame_count for p in self._parts)]).tolist()
        self._numbers = np.cumsum([0, *(p.stored_count for p in self._parts)]).tolist()
        lengths = [p.time_s(p.stored_count - 1) - p.time_s(0) + 1.0 / p.info.fps for p in self._parts]
        self._begins_s = np.cumsum([0.0, *lengths]).tolist()
        prints = "".join(p.info.fingerprint for p in self._parts)
        self._info = replace(
            first,
            frame_count=self._positions[-1],
            fingerprint=hashlib.sha256(prints.encode()).hexdigest()[:32],
            notes=(*first.notes, f"{len(paths)} files, one after the other"),
        )

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        for k, first, last in self._within(start, stop):
            begin = first + -(first + self._positions[k] - start) % step
            for frame in self._parts[k].read_every(begin, last, step):
                yield self._of_all(k, frame)

    def position(self, index: int) -> int:
        k = min(max(0, bisect_right(self._numbers, index) - 1), len(self._parts) - 1)
        return int(self._positions[k]) + self._parts[k].position(index - self._numbers[k])

    def look(self, spots: int) -> Iterator[tuple[int, str]]:
        for part, before in zip(self._parts, self._numbers, strict=False):
            for number, reason in part.look(-(-spots // len(self._parts))):
                yield number + before, reason

    def thumbnails(self) -> Iterator[NDArray[np.uint8] | None]:
        for part in self._parts:
            yield from part.thumbnails()

    def read_grays(self, start: int, stop: int) -> Iterator[NDArray[np.uint8] | None]:
        for k, first, last in self._within(start, stop):
            yield from self._parts[k].read_grays(first, last)

    def _within(self, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
        """Parts that hold positions [start, stop), with the positions in each."""
        start, stop, _ = slice(start, stop).indices(self._positions[-1])
        for k, offset in enumerate(self._positions[:-1]):
            first, last = max(start, offset), min(stop, self._positions[k + 1])
            if first < last:
                yield k, first - offset, last - offset

    def _of_all(self, k: int, frame: Frame | BadFrame) -> Frame | BadFrame:
        index = frame.index + self._numbers[k]
        if isinstance(frame, BadFrame):
            return replace(frame, index=index)
        begun = frame.time_s - self._parts[k].time_s(0) if k else frame.time_s
        return replace(frame, index=index, time_s=begun + self._begins_s[k] + (self._parts[0].time_s(0) if k else 0.0))
