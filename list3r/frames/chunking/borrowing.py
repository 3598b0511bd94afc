"""Frames from before and behind a stretch of a video.

`frames_around` gives some of them at even steps. `borrow` is for a stretch through which the camera stands still or
hardly moves, and gives those around it that do move: of frames that show the same one is enough, and of those around
the stretch the nearest, so that what is held does not grow with how long the camera stands.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, FrameSource

Gray = NDArray[np.uint8]


@dataclass(frozen=True)
class BorrowSettings:
    """What is borrowed."""

    frames: int = 50
    """Frames on either side at most."""
    reach: int = 1000
    """How far they may lie from the stretch, frames (1 to 2 ms of decoding each)."""
    least_motion: float = 0.0008
    """Frames show the same when half of their corners moved less than this, by the longer side (half a pixel of 640,
    which turns a camera by 0.05 degrees)."""
    width: int = 320
    """Size at which they are compared, px."""
    corners: int = 200
    least_followed: float = 0.6
    """Share of the corners without which they are different."""
    most_difference: float = 2.0
    """Largest mean difference of grey values of pictures without corners that are the same."""


@dataclass(frozen=True)
class Repeat:
    """A frame that shows what another one shows."""

    index: int
    """Frame.index."""
    time_s: float
    shown: int
    """Frame.index of the other one."""


@dataclass(frozen=True)
class Borrowed:
    """What stands for a stretch in which too little moves."""

    frames: tuple[Frame, ...]
    """Frames that differ from each other, in order of time, those borrowed included."""
    repeats: tuple[Repeat, ...]
    """Frames of the stretch that are none of these."""
    own: frozenset[int]
    """Frame.index of what stands for the frames of the stretch."""
    followed: int
    """Frames of the stretch in which most corners of one before were found again: a camera that stands, trembles or
    turns slowly, not one that shows a wall, darkness or blur."""


def borrow(
    source: FrameSource,
    span: tuple[int, int],
    shot: tuple[int, int],
    frames: Sequence[Frame],
    settings: BorrowSettings | None = None,
) -> Borrowed:
    """Return the frames of positions `span` = [start, stop) with those around it, from within `shot`, that show it from
    elsewhere."""
    s = settings or BorrowSettings()
    sieve = _Sieve(s)
    before: deque[Frame] = deque(maxlen=s.frames)
    for frame in source.read(max(shot[0], span[0] - s.reach), span[0]):
        if not isinstance(frame, BadFrame) and sieve.is_new(frame):
            before.append(frame)
    kept, repeats, followed = [], [], 0
    for frame in frames:
        if sieve.is_new(frame):
            kept.append(frame)
        else:
            repeats.append(Repeat(frame.index, frame.time_s, sieve.last))
        followed += sieve.followed
    own = frozenset([f.index for f in kept] + [r.shown for r in repeats])
    behind: list[Frame] = []
    for frame in source.read(span[1], min(shot[1], span[1] + s.reach)):
        if not isinstance(frame, BadFrame) and sieve.is_new(frame):
            behind.append(frame)
            if len(behind) == s.frames:
                break
    return Borrowed((*before, *kept, *behind), tuple(repeats), own, followed)


def frames_around(
    source: FrameSource, span: tuple[int, int], shot: tuple[int, int], step: int, count: int
) -> tuple[list[Frame], list[Frame]]:
    """Up to `count` frames before and behind positions `span` = [start, stop), `step` apart, from within `shot`."""
    start, stop = span
    first = start - step * min(count, (start - shot[0]) // step)
    before = _thinned(source, first, start, step)
    behind = _thinned(source, stop - 1 + step, min(shot[1], stop + step * count), step)
    return before, behind


def _thinned(source: FrameSource, start: int, stop: int, step: int) -> list[Frame]:
    """Return the frames at positions start, start + step, ... before `stop` that can be decoded."""
    found = source.read_every(start, stop, step) if start < stop else ()
    return [frame for frame in found if not isinstance(frame, BadFrame)]


@dataclass
class _Sieve:
    """Tells frames that show something new from those that show what the last new one showed."""

    settings: BorrowSettings
    last: int = -1
    """Frame.index of the last new one."""
    followed: bool = False
    """Whether most corners of the last new one were found in the frame that was asked about."""
    _gray: Gray | None = None
    _corners: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 1, 2), np.float32))

    def is_new(self, frame: Frame) -> bool:
        gray = frame.gray(self.settings.width)
        if self._gray is not None and not self._moved(self._gray, gray):
            return False
        found = cv2.goodFeaturesToTrack(gray, self.settings.corners, 0.01, 6)
        self._corners = np.zeros((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)
        self._gray, self.last = gray, frame.index
        return True

    def _moved(self, before: Gray, gray: Gray) -> bool:
        s = self.settings
        self.followed = False
        if len(self._corners) < 8:
            return bool(np.abs(before.astype(np.float32) - gray).mean() > s.most_difference)
        place, found, _ = cv2.calcOpticalFlowPyrLK(before, gray, self._corners, np.zeros_like(self._corners))
        good = found.ravel() > 0
        self.followed = bool(good.mean() >= s.least_followed)
        if not self.followed:
            return True
        moved = np.linalg.norm((place - self._corners)[good, 0], axis=1)
        return bool(np.median(moved) > s.least_motion * max(gray.shape))
