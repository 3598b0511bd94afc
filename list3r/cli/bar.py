"""Progress of long work: shown on a terminal, silent elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from list3r.cli.terminal import ProgressBar, draws


@contextmanager
def progress_bar(stage: str, unit: str = "", *, quiet: bool = False) -> Iterator[ProgressBar]:
    """Show a bar on standard error while the work goes on, where that is a terminal, and take it away at the end.

    Other output on standard error appears above it. Work without numbers shows its duration.
    """
    if quiet or not draws(sys.stderr):
        yield ProgressBar()
        return
    from list3r.cli.drawing import drawn_bar

    with drawn_bar() as bar:
        bar.stage(stage, unit)
        yield bar
