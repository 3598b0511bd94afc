"""Which frames of a source are handed out: from when to when, every N-th, and which one of each group."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.options import SourceOptions
from list3r.memory.core.errors import OptionError

_MEASURED_PX = 320
"""Long side of the picture whose sharpness is measured: small enough to be blind to noise and compression."""


@dataclass(frozen=True)
class FrameSelection:
    """One window of frame numbers for each frame handed out; windows ascend and do not overlap."""

    starts: NDArray[np.int64]
    """First frame number of each window. Shape (N,)."""
    stops: NDArray[np.int64]
    """Frame number before which it ends. Shape (N,)."""
    sharpest: bool
    """Hand out the sharpest frame of a window; the first one where this is False (windows hold one frame then)."""

    def __len__(self) -> int:
        return len(self.starts)

    def position(self, number: int) -> int:
        """Return where a frame number is, or would be, among the frames handed out."""
        return max(0, int(np.searchsorted(self.starts, number, side="right")) - 1)


def select(
    times_s: NDArray[np.float64], options: SourceOptions, root: Path, *, clock: bool, video: bool
) -> FrameSelection:
    """Return the frames that the options leave of a source.

    `times_s` (F,) are the frames' times, ascending, from the source's `clock` or made up from a frame rate. With a
    clock, `fps` thins the frames out to this many a second. Of a thinned video the sharpest frames are taken unless the
    options say otherwise. Raises `OptionError` when no frame is left.
    """
    count = len(times_s)
    first, last = options.start or 0, count if options.stop is None else min(options.stop, count)
    since = times_s - times_s[0]
    if options.start_s is not None:
        first = max(first, int(np.searchsorted(since, options.start_s - 1e-6)))
    if options.end_s is not None:
        last = min(last, int(np.searchsorted(since, options.end_s - 1e-6)))
    if first >= last:
        raise OptionError(
            f"{_range_text(options)} leave nothing of {root}, which has {count} frames in {since[-1]:.1f} seconds"
        )
    if clock and options.fps is not None:
        if options.every > 1:
            raise OptionError("--every and --fps both thin out a source that has a clock; give one of them")
        window = np.floor((since[first:last] - since[first]) * options.fps + 1e-6)
        starts = first + np.flatnonzero(np.diff(window, prepend=-1.0) > 0)
    else:
        starts = np.arange(first, last, options.every)
    stops = np.append(starts[1:], last)
    thinned = bool((stops - starts > 1).any())
    sharpest = thinned and (video if options.sharpest is None else options.sharpest)
    return FrameSelection(starts, stops if sharpest else starts + 1, sharpest)


def _range_text(options: SourceOptions) -> str:
    """Return the options that say from where to where, in the user's words."""
    parts = []
    if options.start is not None or options.stop is not None:
        parts.append(f"frames {'' if options.start is None else options.start}:{options.stop or ''}")
    if options.start_s is not None or options.end_s is not None:
        parts.append(f"seconds {options.start_s or 0:g} to {'the end' if options.end_s is None else options.end_s}")
    return " and ".join(parts) or "the options"


def sharpness(gray: NDArray[np.uint8]) -> float:
    """Return how sharp a grey picture is beside others of the same place: the variance of its Laplacian at 320 px.

    Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000. Shape (H, W).
    """
    side = max(gray.shape)
    if side > _MEASURED_PX:
        width, height = (max(1, round(n * _MEASURED_PX / side)) for n in gray.shape[::-1])
        gray = np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def working_size(size: tuple[int, int], limit: int) -> tuple[int, int]:
    """(height, width) with the aspect kept and no side longer than `limit`, which is 0 for none."""
    side = max(size)
    if limit == 0 or side <= limit:
        return size
    return (max(1, round(size[0] * limit / side)), max(1, round(size[1] * limit / side)))
