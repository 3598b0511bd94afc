"""Overlapping runs of frames (paper, section 3.1 and A.1)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from list3r.memory.core.errors import OptionError


@dataclass(frozen=True)
class ChunkSettings:
    """How a video is cut."""

    length: int = 100
    """Frames in a chunk (paper: 100)."""
    overlap: int = 30
    """Frames that neighbouring chunks share (paper: 30)."""

    def __post_init__(self) -> None:
        if self.length < 2 or not 1 <= self.overlap < self.length:
            raise OptionError(
                f"chunk length {self.length} with overlap {self.overlap}: the length must be at least 2 and the "
                "overlap at least 1 and less than the length"
            )

    def times(self, step: int) -> ChunkSettings:
        """Chunks of this many times as many frames."""
        return ChunkSettings(self.length * step, self.overlap * step)


@dataclass(frozen=True)
class ChunkSpan:
    """Positions [start, stop) of a source that make one chunk."""

    index: int
    start: int
    stop: int


def plan_chunks(frame_count: int, settings: ChunkSettings, cuts: Sequence[int] = ()) -> list[ChunkSpan]:
    """Return the spans that cover `frame_count` frames; the last one may be shorter, never only overlap.

    `cuts` are positions before which the video jumps (`frames.cuts`): no span holds frames of both sides, and spans on
    either side of a cut do not overlap. A shot shorter than a chunk is one chunk.
    """
    inside = sorted({int(cut) for cut in cuts if 0 < cut < frame_count})
    spans: list[ChunkSpan] = []
    for start, stop in pairwise([0, *inside, frame_count]):
        spans += _plan_shot(start, stop, settings, len(spans))
    return spans


def even_chunks(frame_count: int, settings: ChunkSettings) -> list[ChunkSpan]:
    """Return as many spans as `plan_chunks` of a video without a jump, of about equal length."""
    shared = (len(plan_chunks(frame_count, settings)) - 1) * settings.overlap
    length = -(-(frame_count + shared) // (1 + shared // settings.overlap))
    return plan_chunks(frame_count, ChunkSettings(max(length, settings.overlap + 1), settings.overlap))


def shot_of(span: ChunkSpan, cuts: Sequence[int], frame_count: int) -> tuple[int, int]:
    """Positions [start, stop) of the shot between two cuts that a span lies in; `cuts` ascend."""
    shots = [0, *cuts, frame_count]
    at = bisect_right(shots, span.start)
    return shots[at - 1], shots[at]


def _plan_shot(start: int, stop: int, settings: ChunkSettings, first: int) -> list[ChunkSpan]:
    """Return the spans of frames [start, stop) without a jump, numbered from `first`."""
    step = settings.length - settings.overlap
    count = max(1, -(-(stop - start - settings.overlap) // step))
    begins = [start + k * step for k in range(count)]
    return [ChunkSpan(first + k, a, min(a + settings.length, stop)) for k, a in enumerate(begins)]
