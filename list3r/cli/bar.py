"""Progress of long work: shown on a terminal, silent elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from list3r.cli.terminal import draws


class ProgressBar:
    """A bar that draws nothing: work says how far it is whether or not somebody looks."""

    def stage(self, name: str, unit: str = "") -> None:
        """Begin another stage of the work, counted in `unit`; nothing of it is done yet."""

    def show(self, done: int, total: int) -> None:
        """Move the bar to where the work is."""


@contextmanager
def progress_bar(stage: str, unit: str = "", *, quiet: bool = False) -> Iterator[ProgressBar]:
    """Show a bar on standard error while the work goes on, where that is a terminal, and take it away at the end.

    What is written to standard error meanwhile stands above it. Work that tells no numbers shows how long it has taken.
    """
    if quiet or not draws(sys.stderr):
        yield ProgressBar()
        return
    from list3r.cli.drawing import drawn_bar

    with drawn_bar() as bar:
        bar.stage(stage, unit)
        yield bar
