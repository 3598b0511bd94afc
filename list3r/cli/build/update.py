"""update: a later video for a memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from list3r.cli.build import source_options as src
from list3r.cli.build.progress import say_result, watching
from list3r.cli.common import JsonOption, MemoryArgument
from list3r.pipeline.request import BuildRequest, RunOptions

if TYPE_CHECKING:
    from list3r.pipeline.reports import UpdateReport


def update(
    memory: MemoryArgument,
    source: src.SourceArgument,
    more: src.MoreArgument = None,
    *,
    request: BuildRequest,
    given: src.SourceArguments,
    run: RunOptions,
    json: JsonOption = False,
) -> None:
    """Add a later video to a memory: place it in the same world, and record changes.

    Example: list3r update house.l3r walk-2/
    """
    options = given.options(more)
    from list3r.pipeline.update import update as update_memory

    def interrupted(begun: bool) -> str:
        return f"interrupted; {memory} is unchanged but for the finished chunks; continue with --resume"

    def work() -> UpdateReport:
        with watching("updating", interrupted, quiet=json) as watch:
            return update_memory(memory, source, options=options, settings=request, run=run, watch=watch)

    say_result(memory, work, report_lines, json)


def report_lines(memory: Path, report: UpdateReport) -> list[str]:
    """Return the report of an update as text."""
    events = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in report.events.items())
    lines = [
        f"{memory}  session {report.session}",
        f"frames     {report.posed} of {report.frames} posed, {report.lost} lost, {report.bad} unreadable",
        f"placed     {report.placed} of {report.chunks} chunks, by {report.ties} relations to earlier sessions",
        f"objects    {events}; {report.instances} in all",
        f"time       {report.seconds:.1f} s, {report.frames_per_second:.1f} frames/s",
    ]
    return lines + [f"note: {line}" for line in report.notes]
