"""A webcam or a network stream: its pictures are kept in a folder as they come, until the chunks have used them.

While a chunk is worked on the newest pictures wait, and those before them are dropped and counted: whole stretches
rather than every other frame, because the camera can be followed through a stretch (decision 0091). A lost connection
is tried again.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit, urlunsplit

import av
import numpy as np
from numpy.typing import NDArray

from list3r.frames.live.feed import FeedState, LiveSettings, Tell
from list3r.frames.readers.spool import LIST
from list3r.frames.writers.pictures import jpeg
from list3r.memory.errors import SourceError

SCHEMES = ("rtsp", "rtsps", "http", "https", "rtmp", "udp", "tcp", "srt")
_DEVICES = "/dev/video"


def is_stream(source: str) -> bool:
    """Return whether a source is a webcam or the address of a stream."""
    return source.startswith(_DEVICES) or urlsplit(source).scheme.lower() in SCHEMES


def without_secrets(source: str) -> str:
    """Return the address without name, password and query, as it may be shown and stored."""
    parts = urlsplit(source)
    if parts.scheme.lower() not in SCHEMES:
        return source
    host = parts.netloc.rpartition("@")[2]
    return urlunsplit((parts.scheme, host, parts.path, "", ""))


_MOST_WAITING = 300
"""Before it is known how long chunks are."""


@dataclass(frozen=True)
class _Waiting:
    """A frame that is not let in."""

    name: str
    came_s: float
    gap: bool
    """Whether frames are missing before it."""


class StreamFeed:
    """A `Feed` of a stream; a thread takes its pictures in."""

    def __init__(self, source: str, folder: Path, settings: LiveSettings, fps: float | None, tell: Tell) -> None:
        """`fps` thins the pictures out to so many a second. `folder` is made, and must not exist."""
        self.folder, self._source, self._settings, self._tell = folder, source, settings, tell
        self._least_gap_s = 0.0 if fps is None else 0.9 / fps
        self._lock = threading.Lock()
        self._state = FeedState(0, (), False)
        self._waiting, self._most = deque[_Waiting](), settings.most_waiting or _MOST_WAITING
        self._gap, self._last_s, self._arrived = False, -math.inf, list[float]()
        self._stop = threading.Event()
        (folder / "rgb").mkdir(parents=True)
        self._thread = threading.Thread(target=self._run, daemon=True, name="stream")
        self._thread.start()

    def state(self) -> FeedState:
        """What has come so far."""
        with self._lock:
            return self._state

    def hold(self, frames: int) -> None:
        """Say how many frames may wait, unless the settings do."""
        with self._lock:
            self._most = self._settings.most_waiting or frames

    def admit(self) -> bool:
        """Let in the frames that wait, because nothing is left to do; whether there were any."""
        with self._lock, (self.folder / LIST).open("a", encoding="ascii") as file:
            before = self._state
            cuts, begun_s = before.cuts, (self._arrived or [w.came_s for w in self._waiting] or [0.0])[0]
            for number, frame in enumerate(self._waiting, start=before.count):
                cuts += (number,) if frame.gap and number else ()
                file.write(f"{frame.came_s - begun_s:.6f} {frame.name}\n")
            self._arrived += [frame.came_s for frame in self._waiting]
            self._waiting.clear()
            self._state = replace(before, count=len(self._arrived), cuts=cuts, waiting=0)
            return self._state.count > before.count

    def arrived_s(self, position: int) -> float:
        """When a frame came, seconds of `time.monotonic`."""
        return self._arrived[position]

    def close(self) -> None:
        """End it; nothing more comes."""
        self._stop.set()
        self._thread.join(2 * self._settings.silence_s)

    def _run(self) -> None:
        reason = "it was ended"
        try:
            reason = self._follow()
        except OSError as error:
            reason = f"pictures cannot be kept in {self.folder}: {error.strerror or error}"
        finally:
            with self._lock:
                self._state = replace(self._state, ended=True, reason=reason)

    def _follow(self) -> str:
        """Take pictures in until the stream is over; why it was."""
        s = self._settings
        last, pause_s = time.monotonic(), s.pause_s
        while not self._stop.is_set():
            came_s, whole, said = self._receive()
            if self._stop.is_set():
                break
            if whole:
                return "the stream is over"
            if came_s is not None:
                last, pause_s = came_s, s.pause_s
            if time.monotonic() - last > s.retry_s:
                return f"the connection was lost ({said}) and did not come back within {s.retry_s:g} s"
            if came_s is not None or not self.state().received:
                self._tell(f"no connection to {without_secrets(self._source)} ({said}); it is tried again")
            with self._lock:
                self._gap = True
                self._state = replace(self._state, reconnects=self._state.reconnects + (came_s is not None))
            self._stop.wait(pause_s)
            pause_s = min(2 * pause_s, s.most_pause_s)
        return "it was ended"

    def _receive(self) -> tuple[float | None, bool, str]:
        """Keep the pictures of one connection: when the last one came, whether the stream is over, how it ended."""
        last, whole = None, False
        try:
            for image, finite in self._pictures():
                last, whole = time.monotonic(), finite
                self._keep(image, last)
                if self._stop.is_set():
                    break
        except av.FFmpegError as error:
            return last, False, error.strerror or str(error)
        return last, whole, "it ended"

    def _pictures(self) -> Iterator[tuple[NDArray[np.uint8], bool]]:
        """Pictures of one connection, RGB, and whether the stream has an end that it states."""
        wait = {"rw_timeout": str(int(1e6 * self._settings.silence_s)), "fflags": "nobuffer"}
        kind = "v4l2" if self._source.startswith(_DEVICES) else None
        words = {} if kind else wait | ({"rtsp_transport": "tcp"} if self._source.startswith("rtsp") else {})
        silence_s = self._settings.silence_s
        with av.open(self._source, format=kind, options=words, timeout=(2 * silence_s, silence_s)) as container:
            if not container.streams.video:
                raise SourceError(f"{without_secrets(self._source)} has no pictures")
            finite = bool(container.duration and container.duration > 0)
            for image in container.decode(video=0):
                yield np.asarray(image.to_ndarray(format="rgb24"), np.uint8), finite

    def _keep(self, image: NDArray[np.uint8], now: float) -> None:
        """Write a picture, unless it comes too soon after the last one; of too many that wait the oldest goes."""
        received, thinned, dropped = self._state.received + 1, self._state.thinned, self._state.dropped
        soon = not self._gap and now - self._last_s < self._least_gap_s
        frame = _Waiting(f"rgb/{received:08d}.jpg", now, self._gap)
        if soon:
            thinned += 1
        else:
            (self.folder / frame.name).write_bytes(jpeg(image))
            self._last_s, self._gap = now, False
        with self._lock:
            if not soon:
                self._waiting.append(frame)
            while len(self._waiting) > self._most:
                (self.folder / self._waiting.popleft().name).unlink(missing_ok=True)
                self._waiting[0] = replace(self._waiting[0], gap=True)
                dropped += 1
            waiting = len(self._waiting)
            self._state = replace(self._state, received=received, thinned=thinned, dropped=dropped, waiting=waiting)
