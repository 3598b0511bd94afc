"""Progress of a build, and its report."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import typer

from list3r.cli.answer import print_answer
from list3r.cli.bar import progress_bar
from list3r.cli.terminal import ProgressBar, note, say
from list3r.pipeline.request import Watch

if TYPE_CHECKING:
    from list3r.pipeline.reports import BuildReport, UpdateReport

Report = TypeVar("Report", "BuildReport", "UpdateReport")


@contextmanager
def watching(
    title: str, interrupted: Callable[[bool], str], *, quiet: bool, notes: bool = True, debug: Path | None = None
) -> Iterator[Watch]:
    """Show progress in a bar, and notes above it unless they are not wanted.

    Ctrl-C ends the command with the message of `interrupted`, called with whether a chunk was finished.
    """
    begun = False
    try:
        with progress_bar(title, "frames", quiet=quiet) as bar:

            def progress(done: int, total: int) -> None:
                nonlocal begun
                begun = begun or done > 0
                bar.show(done, total)

            on_note = (lambda line: note(f"note: {line}")) if notes and not quiet else None
            yield Watch(progress, looking(bar, title), on_note, debug)
    except KeyboardInterrupt:
        note("", interrupted(begun))
        raise typer.Exit(1) from None


def looking(bar: ProgressBar, then: str) -> Callable[[str, int, int], None]:
    """Return the callback of a progress bar while a video is scanned before its chunks; then it restarts as `then`."""
    now = then

    def scan(what: str, done: int, total: int) -> None:
        nonlocal now
        if now != what:
            bar.stage(f"looking for {what}")
            now = what
        bar.show(done, total)
        if done == total and what != "names":
            bar.stage(then, "frames")
            now = then

    return scan


def say_result(
    memory: Path, work: Callable[[], Report], lines: Callable[[Path, Report], list[str]], json: bool
) -> None:
    """Do the work and print its report. Errors after the memory was written are raised after the report."""
    from list3r.pipeline.finishing import FinishingError

    failure = None
    try:
        report = work()
    except FinishingError as error:
        report, failure = cast(Report, error.report), error
    if json:
        result = {"memory": str(memory), **report.as_dict()}
        del result["notes"]
        failed: dict[str, Any] = {}
        if failure is not None:
            failed["error"] = {"kind": type(failure).__name__, "message": str(failure), "status": 2}
        print_answer([result], notes=report.notes, **failed)
    else:
        say(*lines(memory, report))
    if failure is not None and json:
        note(f"error: {failure}")
        raise typer.Exit(2)
    if failure is not None:
        raise failure


def report_lines(memory: Path, report: BuildReport) -> list[str]:
    """Return the report of a build as text."""
    size = memory.stat().st_size / 1e6
    lines = [
        f"{memory}  {size:.1f} MB",
        f"frames     {report.posed} of {report.frames} posed, {report.lost} lost, {report.bad} unreadable",
        f"chunks     {report.chunks} in {report.components} part{'s' * (report.components > 1)}, {report.loops} loops",
        f"instances  {report.instances} objects, {report.structure} pieces of structure, {report.relations} relations",
        f"time       {report.seconds:.1f} s, {report.frames_per_second:.1f} frames/s",
    ]
    lines += [f"note: {line}" for line in report.notes]
    return lines if report.film is None else [*lines, report.film]


def build_interrupted(memory: Path, resumed: bool) -> Callable[[bool], str]:
    """Return what is said when a build that is about to begin is interrupted."""
    before = _inode(memory)

    def said(begun: bool) -> str:
        if (begun or resumed) and memory.exists():
            return f"interrupted; {memory} keeps the finished chunks: continue with the same command and --resume"
        early = "interrupted before a chunk was finished"
        if _inode(memory) == before:
            return f"{early}; nothing was changed"
        aside = f"{memory}.replaced"
        kept = f"; what was there before is {aside}" if before is not None and _inode(Path(aside)) == before else ""
        return f"{early}; {memory} is left and holds nothing yet: remove it, or give --resume to go on{kept}"

    return said


def _inode(path: Path) -> int | None:
    return path.stat().st_ino if path.exists() else None
