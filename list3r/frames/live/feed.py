"""A source that still grows: how many frames are there, where it was interrupted, and whether more will come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True)
class LiveSettings:
    """How a live source is followed."""

    most_waiting: int | None = None
    """Frames of a stream that wait while a chunk is worked on; of more the oldest are dropped. None: two chunks."""
    retry_s: float = 30.0
    """A lost connection is tried again for so long after its last picture; then the session ends."""
    pause_s: float = 0.5
    """Between two tries; doubled up to `most_pause_s`."""
    most_pause_s: float = 4.0
    silence_s: float = 5.0
    """A connection that sends nothing for so long is lost."""
    idle_s: float = 10.0
    """A folder in which nothing new appears for so long is complete."""
    poll_s: float = 0.2
    """How often it is looked for new frames."""


@dataclass(frozen=True)
class FeedState:
    """What has come so far."""

    count: int
    """Frames that can be read."""
    cuts: tuple[int, ...]
    """Positions before which frames are missing: a lost connection, or frames that were dropped."""
    ended: bool
    """Whether no more will come."""
    received: int = 0
    thinned: int = 0
    """Frames that came sooner than is asked for."""
    dropped: int = 0
    """Frames that newer ones took the place of, because too many were waiting."""
    waiting: int = 0
    """Frames that have come and are not let in."""
    reconnects: int = 0
    reason: str = ""
    """Why it ended, for people."""


class Feed(Protocol):
    """A live source."""

    @property
    def folder(self) -> Path:
        """Where its frames can be read."""
        ...

    def state(self) -> FeedState:
        """What has come so far."""
        ...

    def admit(self) -> bool:
        """Let in the frames that wait, because nothing is left to do; whether there were any."""
        ...

    def hold(self, frames: int) -> None:
        """Say how many frames may wait, unless the settings do."""
        ...

    def arrived_s(self, position: int) -> float:
        """When a frame came, seconds of `time.monotonic`."""
        ...

    def close(self) -> None:
        """End it; nothing more comes."""
        ...


Tell = Callable[[str], None]
"""Hears what the user should know, one sentence."""
