"""Overlapping runs of frames (paper, section 3.1 and A.1)."""

from __future__ import annotations

from dataclasses import dataclass

from list3r.memory.errors import OptionError


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


@dataclass(frozen=True)
class ChunkSpan:
    """Positions [start, stop) of a source that make one chunk."""

    index: int
    start: int
    stop: int


def plan_chunks(frame_count: int, settings: ChunkSettings) -> list[ChunkSpan]:
    """The spans that cover `frame_count` frames; the last one may be shorter, never only overlap."""
    step = settings.length - settings.overlap
    count = max(1, -(-(frame_count - settings.overlap) // step))
    return [ChunkSpan(k, k * step, min(k * step + settings.length, frame_count)) for k in range(count)]
