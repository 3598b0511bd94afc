"""A live camera: its pictures are kept in a folder as they come, until the chunks have used them.

While a chunk is worked on the newest pictures wait, and those before them are dropped and counted: whole stretches
rather than every other frame, because the camera can be followed through a stretch (research/depth-odometry 0091). A
lost connection is tried again.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

from list3r.frames.live.camera import LiveCamera, LivePicture, LostError
from list3r.frames.live.feed import FeedState, LiveSettings, Tell
from list3r.frames.readers.spool import FOLDER, LIST
from list3r.memory.core.errors import SourceError

_MOST_WAITING = 300
"""Before it is known how long chunks are."""


@dataclass(frozen=True)
class _Waiting:
    """A frame that is not let in."""

    name: str
    words: str
    files: tuple[str, ...]
    came_s: float
    gap: bool
    """Whether frames are missing before it."""


class StreamFeed:
    """A `Feed` of a live camera; a thread takes its pictures in."""

    def __init__(self, camera: LiveCamera, folder: Path, settings: LiveSettings, fps: float | None, tell: Tell) -> None:
        """`fps` thins the pictures out to this many a second. `folder` is made, and must not exist."""
        self.folder, self._camera, self._settings, self._tell = folder, camera, settings, tell
        self._least_gap_s = 0.0 if fps is None else 0.9 / fps
        self._lock = threading.Lock()
        self._state = FeedState(0, (), False)
        self._waiting, self._most = deque[_Waiting](), settings.most_waiting or _MOST_WAITING
        self._gap, self._last_s, self._arrived = False, -math.inf, list[float]()
        self._stop = threading.Event()
        (folder / FOLDER).mkdir(parents=True)
        self._thread = threading.Thread(target=self._run, daemon=True, name="stream")
        self._thread.start()

    def state(self) -> FeedState:
        with self._lock:
            return self._state

    def hold(self, frames: int) -> None:
        with self._lock:
            self._most = self._settings.most_waiting or frames

    def admit(self) -> bool:
        with self._lock, (self.folder / LIST).open("a", encoding="ascii") as file:
            before = self._state
            cuts, begun_s = before.cuts, (self._arrived or [w.came_s for w in self._waiting] or [0.0])[0]
            for number, frame in enumerate(self._waiting, start=before.count):
                cuts += (number,) if frame.gap and number else ()
                file.write(f"{frame.came_s - begun_s:.6f} {frame.name} {frame.words}".rstrip() + "\n")
            self._arrived += [frame.came_s for frame in self._waiting]
            self._waiting.clear()
            self._state = replace(before, count=len(self._arrived), cuts=cuts, waiting=0)
            return self._state.count > before.count

    def arrived_s(self, position: int) -> float:
        return self._arrived[position]

    def close(self) -> None:
        self._stop.set()
        self._thread.join(2 * self._settings.silence_s)

    def _run(self) -> None:
        reason = "stopped here"
        try:
            reason = self._follow()
        except SourceError as error:
            reason = str(error)
        except OSError as error:
            reason = f"pictures cannot be kept in {self.folder}: {error.strerror or error}"
        finally:
            with self._lock:
                self._state = replace(self._state, ended=True, reason=reason)

    def _follow(self) -> str:
        """Take pictures in until the stream is over; why it was."""
        s = self._settings
        last, pause_s, shown = time.monotonic(), s.pause_s, ""
        while not self._stop.is_set():
            came_s, whole, reason = self._receive()
            if self._stop.is_set():
                break
            if whole:
                return "the stream is over"
            if came_s is not None:
                last, pause_s = came_s, s.pause_s
            if time.monotonic() - last > s.retry_s:
                return f"the connection was lost ({reason}) and did not come back within {s.retry_s:g} s"
            if came_s is not None or reason != shown:
                shown = reason
                self._tell(f"no connection to {self._camera.name} ({reason}); trying again")
            with self._lock:
                self._gap = True
                self._state = replace(self._state, reconnects=self._state.reconnects + (came_s is not None))
            self._stop.wait(pause_s)
            pause_s = min(2 * pause_s, s.most_pause_s)
        return "stopped here"

    def _receive(self) -> tuple[float | None, bool, str]:
        """Keep the pictures of one connection: when the last one came, whether the source is over, how it ended."""
        last, whole = None, False
        try:
            for picture in self._camera.pictures(self.folder, self._settings.silence_s):
                last, whole = time.monotonic(), picture.last_is_end
                self._keep(picture, last)
                if self._stop.is_set():
                    break
        except LostError as error:
            return last, False, str(error)
        return last, whole, "it ended"

    def _keep(self, picture: LivePicture, now: float) -> None:
        """Write a picture, unless it comes too soon after the last one; of too many that wait the oldest goes."""
        received, thinned, dropped = self._state.received + 1, self._state.thinned, self._state.dropped
        soon = not self._gap and now - self._last_s < self._least_gap_s
        if soon:
            thinned += 1
        else:
            frame = self._write(picture, received, now)
            self._last_s, self._gap = now, False
        with self._lock:
            if not soon:
                self._waiting.append(frame)
            while len(self._waiting) > self._most:
                for name in self._waiting.popleft().files:
                    (self.folder / name).unlink(missing_ok=True)
                self._waiting[0] = replace(self._waiting[0], gap=True)
                dropped += 1
            waiting = len(self._waiting)
            self._state = replace(self._state, received=received, thinned=thinned, dropped=dropped, waiting=waiting)

    def _write(self, picture: LivePicture, number: int, now: float) -> _Waiting:
        """Write the files of a picture, of which the first is its colour."""
        files = {f"{FOLDER}/{number:08d}{ending}": data for ending, data in picture.files().items()}
        for name, data in files.items():
            (self.folder / name).write_bytes(data)
        return _Waiting(next(iter(files)), picture.words, tuple(files), now, self._gap)
