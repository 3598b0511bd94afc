"""When the pictures of a video stream are shown, found without decoding any."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av

from list3r.frames.decoding.boxes import check_index
from list3r.frames.files import MAX_PIXELS
from list3r.frames.folder import DEFAULT_FPS
from list3r.memory.errors import SourceError

_NOT_VIDEO = ("tty", "image2", "_pipe", "gif_pipe")
_PLAYLISTS = ("hls", "concat", "dash", "sdp", "rtsp", "imf")
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
    """Stamp of every picture in the order they are shown, ascending, in `unit` seconds; 0, 0, ... without a clock."""
    keys: tuple[int, ...]
    """Stamps of the key frames that decoding can begin at, ascending; empty where pictures are counted."""
    unit: Fraction
    rate: float
    """Mean frame rate that the file states."""
    clock: bool
    """Whether the file says when its pictures are shown."""
    decoding: bool
    """The stamps are those of decoding: the file has no others, and shows its pictures as they come."""
    counted: bool = False
    """Pictures are known by their place alone: their stamps do not name them, so decoding begins at the first."""
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
        """Seconds after the first frame; pictures of one stamp share the time up to the next."""
        since = float((self.stamps[number] - self.stamps[0]) * self.unit)
        if len(self._numbers) in (0, len(self.stamps)):
            return since
        stamp = self.stamps[number]
        first, behind = bisect.bisect_left(self.stamps, stamp), bisect.bisect_right(self.stamps, stamp)
        gap = (
            (self.stamps[behind] - stamp) * self.unit
            if behind < len(self.stamps)
            else Fraction(1) / Fraction(self.rate)
        )
        return since + float(gap) * (number - first) / (behind - first)

    def number(self, image: av.VideoFrame, count: int, last: int = -1) -> int | None:
        """The number of a decoded picture, which is the `count`-th since decoding began and follows number `last`.

        None for one that is not listed.
        """
        if self.counted:
            return count if count < len(self.stamps) else None
        stamp = image.dts if self.decoding else image.pts
        found = None if stamp is None else self._numbers.get(stamp)
        again = found is not None and found <= last and self.stamps[last + 1 : last + 2] == (stamp,)
        return last + 1 if again else found

    def key_stamps_to(self, number: int, most: int) -> list[int]:
        """Stamps of up to `most` key frames at or before a frame, the nearest first."""
        if self.counted:
            return []
        at = bisect.bisect_right(self.keys, self.stamps[number])
        return list(self.keys[max(0, at - most) : at][::-1])


def list_stamps(path: Path) -> Stamps:
    """Return the clock of a video file. Raises `SourceError` for what is none."""
    try:
        found, hidden_s = _listed(path, {})
        return _listed(path, _WHOLE)[0] if 0 < hidden_s <= _PRIMING_S else found
    except av.FFmpegError as error:
        headless = isinstance(error, av.InvalidDataError)
        reason = "it is none, or breaks off before its index" if headless else error.strerror
        raise SourceError(f"{path} is not a video that can be read ({reason}); is the copy complete?") from None


def _listed(path: Path, words: dict[str, str]) -> tuple[Stamps, float]:
    """The clock of a file, and for how many seconds before its beginning it has pictures that it does not show."""
    with open_container(path, words) as container:
        if container.format.name in _PLAYLISTS:
            raise SourceError(f"{path} is a playlist, which names other files; give the video file itself")
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


def open_container(path: Path, words: dict[str, str]) -> Any:
    """Return the opened file.

    Its name is made absolute, because FFmpeg takes what stands before a colon for a protocol.
    """
    check_index(path)
    container = av.open(str(path.absolute()), options=words)
    for stream in container.streams.video:
        if stream.codec_context is not None:
            stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
    return container


def picture_stream(container: Any) -> Any | None:
    """Return the video stream to read, the largest; None where there is none; the cover of a piece of music is none."""
    return next(iter(_picture_streams(container)), None)


def _picture_streams(container: Any) -> list[Any]:
    """Video streams, the largest pictures first, and of those of one size the one that a player would show."""
    cover = int(getattr(av.stream.Disposition, "attached_pic", 0))
    shown = [s for s in container.streams.video if not int(s.disposition or 0) & cover]
    streams = [s for s in shown if s.codec_context is not None]  # none where FFmpeg lacks the decoder
    best = container.streams.best("video")
    return sorted(streams, key=lambda s: (-(s.width or 0) * (s.height or 0), s is not best, s.index))


def packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets up to the end, or to where the file breaks off."""
    try:
        yield from container.demux(stream)
    except av.FFmpegError:
        return


_Rows = list[tuple[int | None, int | None, bool]]
"""Stamps of showing and of decoding, and whether it is a key frame, of every packet as they come."""


def _stamps(path: Path, rows: _Rows, container: Any, stream: Any) -> Stamps:
    if not rows:
        raise SourceError(f"{path} holds no frames; is the copy complete?")
    unit = stream.time_base or Fraction(1, 1)
    rate = float(stream.average_rate or stream.base_rate or 0) or DEFAULT_FPS
    aspect = Fraction(getattr(stream, "sample_aspect_ratio", None) or 1)
    focal = _positive(container.metadata.get(_FOCAL_KEY) or stream.metadata.get(_FOCAL_KEY))
    notes = (*_other_streams(container), *_breaks_off(rows, container, stream, unit))
    rows, joined = _joined(rows)
    reorders = bool(stream.codec_context.has_b_frames)
    for decoding in (False, True):
        shown = [row[int(decoding)] for row in rows]
        if any(stamp is None for stamp in shown):
            continue
        # AVI has no time of showing: FFmpeg makes it up from the place in the file where the codec reorders pictures.
        counted = joined or (reorders and (decoding or (container.format.name == "avi" and _ascend(shown))))
        known = sorted(stamp for stamp in shown if stamp is not None)
        numbers = {stamp: k for k, stamp in reversed(list(enumerate(known)))}
        times = Counter(known)
        keys = sorted(row[int(decoding)] or 0 for row in rows if row[2] and times[row[int(decoding)] or 0] == 1)
        if joined:
            notes = (*notes, "its clock begins anew on the way and is joined, as where files were put together")
        return Stamps(
            tuple(known),
            () if counted else tuple(keys),
            unit,
            rate,
            True,
            decoding,
            counted,
            aspect,
            focal,
            notes,
            numbers,
        )
    return Stamps((0,) * len(rows), (), unit, rate, False, False, True, aspect, focal, notes)


def _ascend(stamps: Sequence[int | None]) -> bool:
    return all(a is not None and b is not None and a < b for a, b in pairwise(stamps))


def _joined(rows: _Rows) -> tuple[_Rows, bool]:
    """Return the rows with one clock where that of decoding steps back, as in files that were put together."""
    steps = [b - a for (_, a, _), (_, b, _) in pairwise(rows) if a is not None and b is not None]
    if len(steps) + 1 < len(rows) or all(step >= 0 for step in steps):
        return rows, False
    usual = max(1, sorted(steps)[len(steps) // 2])
    out, shift = [rows[0]], 0
    for (pts, dts, key), step in zip(rows[1:], steps, strict=True):
        shift += usual - step if step < 0 else 0
        out.append((None if pts is None else pts + shift, None if dts is None else dts + shift, key))
    return out, True


def _other_streams(container: Any) -> tuple[str, ...]:
    """Return what is said of a file with more than one video in it."""
    streams = _picture_streams(container)
    if len(streams) < 2:
        return ()
    return (
        f"the file holds {len(streams)} video streams; the largest, {streams[0].width}x{streams[0].height}, is taken",
    )


def _breaks_off(rows: _Rows, container: Any, stream: Any, unit: Fraction) -> tuple[str, ...]:
    """Return what is said of a file that is shorter than it states."""
    if stream.frames and len(rows) < stream.frames:
        return (f"the file breaks off: {len(rows)} of its {stream.frames} frames are there",)
    stated = float(container.duration or 0) / float(av.time_base)
    shown = [row[0] for row in rows if row[0] is not None]
    there = float((max(shown) - min(shown)) * unit) if shown else stated
    if there < stated * (1 - _MISSING_SHARE) - 1.0:
        return (f"the file breaks off: {there:.1f} of its {stated:.1f} seconds are there",)
    return ()


def _no_video(path: Path, container: Any) -> str:
    if any(sign in container.format.name for sign in _NOT_VIDEO):
        return f"{path} is not a video ({container.format.name}); give a video file or a folder"
    if any(s.codec_context is None for s in container.streams.video):
        return f"{path}: FFmpeg here lacks the decoder of this video; convert it (ffmpeg -i {path.name} video.mp4)"
    if container.streams.audio:
        return f"{path} holds sound and no video; give a video file or a folder"
    return f"{path} is not a video ({container.format.name}); give a video file or a folder"


def _positive(text: Any) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) and value > 0 else None
