"""When the pictures of a video stream are shown, found without decoding any."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av

from list3r.frames.folder import DEFAULT_FPS
from list3r.memory.errors import SourceError

_NOT_VIDEO = ("tty", "image2", "_pipe", "gif_pipe")
_FOCAL_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
_MISSING_SHARE = 0.02
_PRIMING_S = 0.5
"""Pictures hidden before the beginning that are no longer than this were not cut away by anyone: the clock of a phone's
recording began later than its camera."""
_WHOLE = {"ignore_editlist": "1"}
"""Opens an MP4 with all of its pictures."""


@dataclass(frozen=True)
class Stamps:
    """The clock of one video stream."""

    stamps: tuple[int, ...]
    """Stamp of every picture in the order they are shown, in `unit` seconds; 0, 0, ... without a clock."""
    keys: tuple[int, ...]
    """Stamps of the key frames, ascending; empty without a clock."""
    unit: Fraction
    rate: float
    """Mean frame rate that the file states."""
    clock: bool
    """Whether every picture has a time of its own."""
    decoding: bool
    """The stamps are those of decoding: the file has no others, and shows its pictures as they come."""
    aspect: Fraction = Fraction(1)
    """Width of a pixel by its height."""
    focal_35mm: float | None = None
    """The lens's 35 mm equivalent that phones write beside the video."""
    notes: tuple[str, ...] = ()
    _numbers: dict[int, int] = field(default_factory=dict, repr=False)
    words: dict[str, str] = field(default_factory=dict)
    """Options that the container is to be opened with."""

    def __len__(self) -> int:
        return len(self.stamps)

    def time_s(self, number: int) -> float:
        """Seconds after the first frame."""
        return float((self.stamps[number] - self.stamps[0]) * self.unit)

    def number(self, image: av.VideoFrame, count: int) -> int | None:
        """The number of a decoded picture, which is the `count`-th since decoding began; None for one not listed."""
        if not self.clock:
            return count
        stamp = image.dts if self.decoding else image.pts
        return None if stamp is None else self._numbers.get(stamp)

    def key_stamps_to(self, number: int, most: int) -> list[int]:
        """Stamps of up to `most` key frames at or before a frame, the nearest first."""
        if not self.clock:
            return []
        at = bisect.bisect_right(self.keys, self.stamps[number])
        return list(self.keys[max(0, at - most) : at][::-1])


def list_stamps(path: Path) -> Stamps:
    """The clock of a video file. Raises `SourceError` for what is none."""
    try:
        found, hidden_s = _listed(path, {})
        return _listed(path, _WHOLE)[0] if 0 < hidden_s <= _PRIMING_S else found
    except av.FFmpegError as error:
        headless = isinstance(error, av.InvalidDataError)
        reason = "it is none, or breaks off before its index" if headless else error.strerror
        raise SourceError(f"{path} is not a video that can be read ({reason}); is the copy complete?") from None


def _listed(path: Path, words: dict[str, str]) -> tuple[Stamps, float]:
    """The clock of a file, and for how many seconds before its beginning it has pictures that it does not show."""
    with av.open(str(path), options=words) as container:
        stream = picture_stream(container)
        if stream is None or any(sign in container.format.name for sign in _NOT_VIDEO):
            raise SourceError(_no_video(path, container))
        rows, hidden = [], []
        for packet in packets(container, stream):  # none is kept: together they are the file
            if packet.size and not packet.is_discard:
                rows.append((packet.pts, packet.dts, bool(packet.is_keyframe)))
            elif packet.size and packet.pts is not None:
                hidden.append(packet.pts)
        stamps = _stamps(path, rows, container, stream)
        earlier = stamps.clock and bool(hidden) and max(hidden) < stamps.stamps[0]
        hidden_s = float((stamps.stamps[0] - min(hidden)) * stamps.unit) if earlier else 0.0
        return replace(stamps, words=words), hidden_s


def picture_stream(container: Any) -> Any | None:
    """The video stream to read, None where there is none; the cover of a piece of music is none."""
    cover = int(getattr(av.stream.Disposition, "attached_pic", 0))
    streams = [s for s in container.streams.video if not int(s.disposition or 0) & cover]
    best = container.streams.best("video")
    return best if best in streams else next(iter(streams), None)


def packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets up to the end, or to where the file breaks off."""
    try:
        yield from container.demux(stream)
    except av.FFmpegError:
        return


def _stamps(path: Path, rows: list[tuple[int | None, int | None, bool]], container: Any, stream: Any) -> Stamps:
    if not rows:
        raise SourceError(f"{path} holds no frames; is the copy complete?")
    unit = stream.time_base or Fraction(1, 1)
    rate = float(stream.average_rate or stream.base_rate or 0) or DEFAULT_FPS
    aspect = Fraction(getattr(stream, "sample_aspect_ratio", None) or 1)
    focal = _positive(container.metadata.get(_FOCAL_KEY) or stream.metadata.get(_FOCAL_KEY))
    notes = _breaks_off(rows, container, stream, unit)
    for decoding in (False, True):
        shown = [row[int(decoding)] for row in rows]
        known = sorted({s for s in shown if s is not None})
        if len(known) == len(rows) and not (decoding and stream.codec_context.has_b_frames):
            keys = sorted(row[int(decoding)] or 0 for row in rows if row[2])
            numbers = {stamp: k for k, stamp in enumerate(known)}
            return Stamps(tuple(known), tuple(keys), unit, rate, True, decoding, aspect, focal, notes, numbers)
    return Stamps((0,) * len(rows), (), unit, rate, False, False, aspect, focal, notes)


def _breaks_off(
    rows: list[tuple[int | None, int | None, bool]], container: Any, stream: Any, unit: Fraction
) -> tuple[str, ...]:
    """What is said of a file that is shorter than it states."""
    if stream.frames and len(rows) < stream.frames:
        return (f"the file breaks off: {len(rows)} of its {stream.frames} frames are there",)
    stated = float(container.duration or 0) / float(av.time_base)
    shown = [row[0] for row in rows if row[0] is not None]
    there = float((max(shown) - min(shown)) * unit) if shown else stated
    if there < stated * (1 - _MISSING_SHARE) - 1.0:
        return (f"the file breaks off: {there:.1f} of its {stated:.1f} seconds are there",)
    return ()


def _no_video(path: Path, container: Any) -> str:
    if container.streams.audio and not any(sign in container.format.name for sign in _NOT_VIDEO):
        return f"{path} holds sound and no video; give a video file or a folder"
    return f"{path} is not a video ({container.format.name}); give a video file or a folder"


def _positive(text: Any) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) and value > 0 else None
