"""What live pictures come from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


class LostError(Exception):
    """A connection that is lost, or could not be made; what is said of it."""


@dataclass(frozen=True)
class LivePicture:
    """A picture that has come."""

    files: Callable[[], Mapping[str, bytes]]
    """Its files by their ending, made only where it is kept."""
    words: str = ""
    """What follows its name in the list of frames."""
    last_is_end: bool = False
    """Whether the source is over when nothing follows; else its connection is lost."""


class LiveCamera(Protocol):
    """What pictures come from."""

    @property
    def name(self) -> str:
        """How it is called, without secrets."""
        ...

    def pictures(self, folder: Path, silence_s: float) -> Iterator[LivePicture]:
        """The pictures of one connection. What holds for all of them is written to `folder`.

        Raises `LostError`, also after `silence_s` in which nothing comes; `SourceError` where trying again is in vain.
        """
        ...
