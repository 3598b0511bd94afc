"""When the pictures of a video stream are shown, found without decoding any."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from list3r.frames.beside import role_of
from list3r.frames.decoding.mp4_boxes import check_index
from list3r.frames.files import MAX_PIXELS
from list3r.frames.folder import DEFAULT_FPS
from list3r.memory.core.errors import SourceError

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
class VideoTimestamps:
    """The clock of one video stream."""

    stamps: NDArray[np.int64]
    """Stamp of every picture in the order they are shown, ascending, in `unit` seconds; 0, 0, ... without a clock.
    Shape (F,)."""
    keys: NDArray[np.int64]
    """Time stamps of the key frames where decoding can begin, ascending; empty if pictures are counted. Shape (K,)."""
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
    words: dict[str, str] = field(default_factory=dict)
    """Options that the container is to be opened with."""

    def __len__(self) -> int:
        return len(self.stamps)

    def time_s(self, number: int) -> float:
        """Seconds after the first frame; pictures of one stamp share the time up to the next."""
        return float(self.times_s(number, number + 1)[0])

    def times_s(self, start: int, stop: int) -> NDArray[np.float64]:
        """As `time_s`, of frames [start, stop). Shape (stop - start,)."""
        asked = self.stamps[start:stop]
        since_s = self._seconds(asked - self.stamps[0])
        first, behind = (np.searchsorted(self.stamps, asked, side=side) for side in ("left", "right"))
        if not self.clock or np.all(behind - first == 1):
            return since_s
        later = self.stamps[np.minimum(behind, len(self.stamps) - 1)]
        gap_s = np.where(behind < len(self.stamps), self._seconds(later - asked), 1.0 / self.rate)
        return np.asarray(since_s + gap_s * (np.arange(start, start + len(asked)) - first) / (behind - first))

    def _seconds(self, units: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(units * float(self.unit.numerator) / float(self.unit.denominator), np.float64)

    def number(self, image: av.VideoFrame, count: int, last: int = -1) -> int | None:
        """The number of a decoded picture, which is the `count`-th since decoding began and follows number `last`.

        None for one that is not listed.
        """
        if self.counted:
            return count if count < len(self.stamps) else None
        stamp = image.dts if self.decoding else image.pts
        if stamp is None or not self.clock:
            return None
        if 0 <= last < len(self) - 1 and self.stamps[last + 1] == stamp:
            return last + 1
        found = int(np.searchsorted(self.stamps, stamp))
        return found if found < len(self) and self.stamps[found] == stamp else None

    def key_stamps_to(self, number: int, most: int) -> list[int]:
        """VideoTimestamps of up to `most` key frames at or before a frame, the nearest first."""
        if self.counted:
            return []
        at = int(np.searchsorted(self.keys, self.stamps[number], side="right"))
        return [int(stamp) for stamp in self.keys[max(0, at - most) : at][::-1]]


def list_timestamps(path: Path) -> VideoTimestamps:
    """Return the clock of a video file. Raises `SourceError` for what is none."""
    try:
        found, hidden_s = _listed(path, {})
        return _listed(path, _WHOLE)[0] if 0 < hidden_s <= _PRIMING_S else found
    except av.FFmpegError as error:
        headless = isinstance(error, av.InvalidDataError)
        reason = "it is not one, or ends before its index" if headless else error.strerror
        raise SourceError(f"{path} cannot be read as a video ({reason}); is the copy complete?") from None


def _listed(path: Path, words: dict[str, str]) -> tuple[VideoTimestamps, float]:
    """The clock of a file, and for how many seconds before its beginning it has pictures that it does not show."""
    with open_container(path, words) as container:
        if container.format.name in _PLAYLISTS:
            raise SourceError(f"{path} is a playlist, which names other files; give the video file itself")
        stream = picture_stream(container)
        if stream is None or any(sign in container.format.name for sign in _NOT_VIDEO):
            raise SourceError(_no_video(path, container))
        if _said_deep(stream) or (_is_deep(stream) and role_of(path.stem) == "depth"):
            raise SourceError(
                f"{path} holds depth and no colour; give the recording that holds both, or a colour video"
            )
        rows, hidden, trimmed = _counted(container, stream)
        stamps = _stamps(path, rows, container, stream)
        notes = (*stamps.notes, *_breaks_off(rows, trimmed, container, stream))
        earlier = stamps.clock and bool(hidden) and max(hidden) < stamps.stamps[0]
        hidden_s = float(int(stamps.stamps[0] - min(hidden)) * stamps.unit) if earlier else 0.0
        return replace(stamps, words=words, notes=notes), hidden_s


def _counted(container: Any, stream: Any) -> tuple[_Rows, array[int], int]:
    """Rows of the packets that are shown; the stamps of those that are not, and how many these are."""
    numbers, hidden, trimmed = array("q"), array("q"), 0
    for packet in packets(container, stream):  # none is kept: together they are the file
        if packet.size and not packet.is_discard:
            stated = (_NONE if stamp is None else stamp for stamp in (packet.pts, packet.dts))
            numbers.extend((*stated, bool(packet.is_keyframe)))
        elif packet.size:
            trimmed += 1
            hidden.extend(() if packet.pts is None else (packet.pts,))
    return np.frombuffer(numbers, np.int64).reshape(-1, 3), hidden, trimmed


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
    """Return the video stream to read, the largest of colour; None where there is none; a cover of music is none."""
    return next(iter(_picture_streams(container)), None)


def _picture_streams(container: Any) -> list[Any]:
    """Video streams, those of colour first, then the largest, and of those of one size what a player would show."""
    cover = int(getattr(av.stream.Disposition, "attached_pic", 0))
    shown = [s for s in container.streams.video if not int(s.disposition or 0) & cover]
    streams = [s for s in shown if s.codec_context is not None]  # none where FFmpeg lacks the decoder
    best = container.streams.best("video")
    return sorted(streams, key=lambda s: (_is_deep(s), -(s.width or 0) * (s.height or 0), s is not best, s.index))


def _is_deep(stream: Any) -> bool:
    """Whether a stream holds depth or infrared: by its title, or one number of over 8 bits a pixel."""
    parts: Any = getattr(stream.codec_context.format, "components", ())
    return _said_deep(stream) or (len(parts) == 1 and int(parts[0].bits) > 8)


def _said_deep(stream: Any) -> bool:
    return role_of(str(stream.metadata.get("title", ""))) in ("depth", "mask")


def packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets up to the end, or to where the file breaks off."""
    try:
        yield from container.demux(stream)
    except av.FFmpegError:
        return


_NONE = np.iinfo(np.int64).min
"""Of a packet without a stamp, as FFmpeg writes it."""
_Rows = NDArray[np.int64]
"""Time stamps of showing and of decoding, and whether it is a key frame, of every packet as they come. Shape (F, 3)."""


def _stamps(path: Path, rows: _Rows, container: Any, stream: Any) -> VideoTimestamps:
    if not len(rows):
        raise SourceError(f"{path} holds no frames; is the copy complete?")
    unit = stream.time_base or Fraction(1, 1)
    rate = float(stream.average_rate or stream.base_rate or 0) or DEFAULT_FPS
    aspect = Fraction(getattr(stream, "sample_aspect_ratio", None) or 1)
    focal = _positive(container.metadata.get(_FOCAL_KEY) or stream.metadata.get(_FOCAL_KEY))
    notes = _other_streams(container)
    rows, joined = _joined(rows)
    reorders = bool(stream.codec_context.has_b_frames)
    for decoding in (False, True):
        shown = rows[:, int(decoding)]
        if np.any(shown == _NONE):
            continue
        # AVI has no time of showing: FFmpeg makes it up from the place in the file where the codec reorders pictures.
        made_up = container.format.name == "avi" and bool(np.all(np.diff(shown) > 0))
        counted = joined or (reorders and (decoding or made_up))
        known, keys = np.sort(shown), np.sort(shown[rows[:, 2] > 0])
        once = np.searchsorted(known, keys, side="right") - np.searchsorted(known, keys, side="left") == 1
        if joined:
            notes = (
                *notes,
                "its clock restarts in the middle, as in concatenated files; the parts are joined",
            )
        begins = np.zeros(0, np.int64) if counted else keys[once]
        return VideoTimestamps(known, begins, unit, rate, True, decoding, counted, aspect, focal, notes)
    none = np.zeros(0, np.int64)
    return VideoTimestamps(np.zeros(len(rows), np.int64), none, unit, rate, False, False, True, aspect, focal, notes)


def _joined(rows: _Rows) -> tuple[_Rows, bool]:
    """Return the rows with one clock where that of decoding steps back, as in files that were put together."""
    steps = np.diff(rows[:, 1])
    if np.any(rows[:, 1] == _NONE) or np.all(steps >= 0):
        return rows, False
    usual = max(1, int(np.sort(steps)[len(steps) // 2]))
    shift = np.cumsum(np.where(steps < 0, usual - steps, 0), dtype=np.int64)
    out = rows.copy()
    out[1:, :2] += np.where(rows[1:, :2] == _NONE, 0, shift[:, None])
    return out, True


def _other_streams(container: Any) -> tuple[str, ...]:
    """Return what is said of a file with more than one video in it."""
    streams = _picture_streams(container)
    if len(streams) < 2:
        return ()
    taken, *left = streams
    which = f"that of colour, {_size(taken)}," if _is_deep(left[-1]) else f"the largest, {_size(taken)},"
    out = f"the file holds {len(streams)} video streams; {which} is taken"
    deep = ", ".join(f"{s.metadata.get('title', 'one')} ({_size(s)})" for s in left if _is_deep(s))
    how = "convert the recording to images (Open3D's azure_kinect_mkv_reader) and give their folder"
    return (out, *((f"depth and infrared are not read: {deep}; {how}",) if deep else ()))


def _size(stream: Any) -> str:
    return f"{stream.width}x{stream.height}"


def _breaks_off(rows: _Rows, trimmed: int, container: Any, stream: Any) -> tuple[str, ...]:
    """Return what is said of a file that is shorter than it states; `trimmed` of its frames are there but not shown."""
    if stream.frames and len(rows) + trimmed < stream.frames:
        return (f"the file is cut off: {len(rows)} of its {stream.frames} frames are there",)
    stated = float(container.duration or 0) / float(av.time_base)
    shown = rows[rows[:, 0] != _NONE, 0]
    there = float(int(shown.max() - shown.min()) * (stream.time_base or 1)) if len(shown) else stated
    if there < stated * (1 - _MISSING_SHARE) - 1.0:
        return (f"the file is cut off: {there:.1f} of its {stated:.1f} seconds are there",)
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
