"""Tables and bars as `rich` draws them; imported only for a terminal.

Cells are `Text`, never markup, and come from `shown`: text from a memory or a file is drawn and not obeyed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column, Table
from rich.text import Text

from list3r.cli.terminal import ProgressBar

_NUMBERS = re.compile(r"[\d\s.,:+-]*|nan|-?inf")
_GAP = 2
"""Letters between two columns."""
_LEAST = 12
"""Letters that a column of words, or a bar, keeps where room is short."""
_BAR, _WORDS = 40, 62
"""Letters of a bar at most, and of its text."""


def drawn_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str | None:
    """Return a table that is at most as wide as the terminal, or None where it cannot be.

    Numbers, and so ids, stay whole; words are folded. Columns that are empty in every row are left out.
    """
    console = Console(highlight=False)
    if console.legacy_windows or not console.encoding.startswith("utf"):
        return None
    columns = [(title, _without_margin(cells)) for title, *cells in zip(header, *rows, strict=True)]
    columns = [(title, cells) for title, cells in columns if any(cells)]
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, _GAP - 1, 0, 0))
    narrowest = -_GAP
    for title, cells in columns:
        whole = all(_NUMBERS.fullmatch(cell) for cell in cells)
        width = max(map(cell_len, (title, *cells)))
        narrowest += _GAP + (width if whole else min(width, _LEAST))
        table.add_column(Text(title), no_wrap=whole, justify="right" if whole else "left", overflow="fold")
    if narrowest > console.width:
        return None
    for row in zip(*(cells for _, cells in columns), strict=True):
        table.add_row(*map(Text, row))
    with console.capture() as drawn:
        console.print(table)
    return drawn.get()


def _without_margin(cells: Sequence[str]) -> list[str]:
    """Return cells without the blanks that all of them begin with."""
    margin = min((len(cell) - len(cell.lstrip()) for cell in cells if cell.strip()), default=0)
    return [cell[margin:].rstrip() for cell in cells]


@contextmanager
def drawn_bar() -> Iterator[ProgressBar]:
    """Draw a bar on standard error, below other output there; gone at the end."""
    console = Console(stderr=True, highlight=False)
    width = max(_LEAST, min(_BAR, console.width - _WORDS))
    columns = (TextColumn("{task.description}", markup=False), BarColumn(width), _Numbers(Column(no_wrap=True)))
    with Progress(*columns, console=console, refresh_per_second=4, transient=True, redirect_stdout=False) as progress:
        # A process that is killed cannot bring the cursor back.
        console.show_cursor(True)
        yield _DrawnBar(progress)


class _DrawnBar(ProgressBar):
    """A bar with the numbers of one stage."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def stage(self, name: str, unit: str = "") -> None:
        for task in self._progress.task_ids:
            self._progress.remove_task(task)
        self._progress.add_task(name, total=None, unit=unit)

    def show(self, done: int, total: int) -> None:
        task = self._progress.tasks[0]
        first = task.fields.get("first") or (task.get_time(), done)
        self._progress.update(task.id, completed=done, total=total, first=first, at=task.get_time())


class _Numbers(ProgressColumn):
    """Count done, the rate since the stage began and the time left; or the time so far."""

    def render(self, task: Task) -> Text:
        unit = task.fields["unit"]
        if task.total is None:
            return Text(_clock(task.elapsed or 0.0))
        words = [f"{task.completed:.0f}/{task.total:.0f} {unit}".rstrip()]
        since, before = task.fields["first"]
        spent, done = task.fields["at"] - since, task.completed - before
        if done > 0 and spent > 0:
            left = (task.total - task.completed) * spent / done - (task.get_time() - task.fields["at"])
            words += [f"{done / spent:.1f} {unit}/s" if unit else "", f"{_clock(max(left, 0.0))} left"]
        return Text("  ".join(word for word in words if word))


def _clock(seconds: float) -> str:
    """Return seconds as hours, minutes and seconds."""
    return str(timedelta(seconds=round(seconds)))
