"""A folder of any layout in which another program still writes frames."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from list3r.frames.live.feed import FeedState, LiveSettings
from list3r.frames.options import SourceOptions
from list3r.frames.source import open_source
from list3r.memory.core.errors import OptionError, SourceError


class FolderFeed:
    """A `Feed` of a folder. The newest frame counts only when another one has come, for it may be half
    written.
    """

    def __init__(self, folder: Path, options: SourceOptions, settings: LiveSettings) -> None:
        self.folder, self._options, self._settings = folder, options, settings
        self._state = FeedState(0, (), False)
        self._found, self._idle_s = 0, 0.0
        self._arrived: list[float] = []
        self._looked = 0.0

    def state(self) -> FeedState:
        now = time.monotonic()
        if self._state.ended or now - self._looked < self._settings.poll_s:
            return self._state
        # nobody looks while a chunk is worked on: only what is looked through counts as idle
        self._idle_s += min(now - self._looked, 2 * self._settings.poll_s) if self._looked else 0.0
        self._looked = now
        try:
            found = open_source(self.folder, self._options).info.frame_count
        except (SourceError, OptionError, OSError):  # not there yet, or half written; what stays so is idle
            found = self._found
        if found > self._found:
            self._arrived += [now] * (found - self._found)
            self._found, self._idle_s = found, 0.0
        ended = self._idle_s > self._settings.idle_s
        count = self._found if ended else max(0, self._found - 1)
        reason = f"nothing new came for {self._settings.idle_s:g} s" if ended else ""
        self._state = replace(self._state, count=count, ended=ended, received=self._found, reason=reason)
        return self._state

    def admit(self) -> bool:
        return False

    def hold(self, frames: int) -> None:
        """Nothing is dropped from a folder."""

    def arrived_s(self, position: int) -> float:
        return self._arrived[position]

    def close(self) -> None:
        self._state = replace(self._state, ended=True, reason="stopped here")
