"""All output to the terminal: one line each, with control characters shown instead of obeyed.

Labels, reasons and names of files may come from anybody. Those, line ends and marks that turn the direction
of text are shown escaped, so that nothing forges a row, moves the cursor or hides.
"""

from __future__ import annotations

import contextlib
import os
import sys

from list3r.memory.core.description.printable import shown
from list3r.memory.core.errors import List3rError

_FULL = "standard output cannot be written"


class OutputError(List3rError):
    """Standard output that takes no more; the command itself is done."""


def say(*lines: object) -> None:
    """Print lines on standard output. Raises `OutputError` where they cannot be written."""
    write("".join(f"{shown(line)}\n" for line in lines))


def write(text: str) -> None:
    """Print text unchanged, such as JSON. Raises `OutputError`."""
    try:
        sys.stdout.write(text)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"{_FULL} ({error.strerror}); the command itself is done") from error


def flush() -> None:
    """Flush standard output. Raises `OutputError`."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"{_FULL} ({error.strerror}); the command itself is done") from error


def note(*lines: object) -> None:
    """Print lines on standard error; failures are ignored."""
    with contextlib.suppress(OSError):
        sys.stderr.write("".join(f"{shown(line)}\n" for line in lines))
        sys.stderr.flush()


def draws(stream: object) -> bool:
    """Whether a stream is a terminal that can be drawn on."""
    isatty = getattr(stream, "isatty", None)
    return isatty is not None and isatty() and os.environ.get("TERM", "").lower() not in ("dumb", "unknown")


def mute() -> None:
    """Discard standard output, so that its buffer cannot fail later."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def prepare_streams() -> None:
    """Give closed streams a place to go, so that no file is opened in theirs; letters they cannot show are escaped."""
    for descriptor, mode in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(descriptor)
        except OSError:
            os.dup2(os.open(os.devnull, mode), descriptor)
    if sys.stdin is None:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


class ProgressBar:
    """A bar that draws nothing, so that work reports progress in any case."""

    def stage(self, name: str, unit: str = "") -> None:
        """Begin another stage of the work, counted in `unit`; nothing of it is done yet."""

    def show(self, done: int, total: int) -> None:
        """Move the bar to where the work is."""
