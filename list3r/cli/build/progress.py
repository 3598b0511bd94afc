"""A build with a progress bar, and what it says at the end."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from list3r.cli.common import note

if TYPE_CHECKING:
    from list3r.pipeline.build import BuildReport


def run_build(source: str | Path, memory: Path, *, quiet: bool, **arguments: Any) -> BuildReport:
    """Build with a progress bar; Ctrl-C says how to go on."""
    from tqdm import tqdm

    from list3r.pipeline.build import build as build_memory

    tqdm.monitor_interval = 0
    with tqdm(unit="frame", desc="building", disable=quiet or not sys.stderr.isatty(), file=sys.stderr) as bar:
        kept = bool(arguments.get("resume"))

        def progress(done: int, total: int) -> None:
            nonlocal kept
            kept = kept or done > 0
            show(bar, done, total)

        try:
            return build_memory(source, memory, progress=progress, look=looking(bar, "building"), **arguments)
        except KeyboardInterrupt:
            bar.close()
            if kept and memory.exists():
                note("", f"interrupted; {memory} keeps the finished chunks: go on with the same command and --resume")
            else:
                note("", "interrupted before a chunk was finished; nothing was changed")
            raise typer.Exit(1) from None


def show(bar: Any, done: int, total: int) -> None:
    """Move a progress bar to where the work is."""
    bar.total = total
    bar.update(done - bar.n)
    bar.refresh()


def looking(bar: Any, then: str) -> Callable[[str, int, int], None]:
    """What moves a progress bar while a video is looked at before its chunks; afterwards it begins anew as `then`."""

    def look(what: str, done: int, total: int) -> None:
        bar.set_description(f"looking for {what}", refresh=False)
        show(bar, done, total)
        if done == total:
            bar.set_description(then, refresh=False)
            bar.reset(total)

    return look


def report_lines(memory: Path, report: BuildReport) -> list[str]:
    """What a build did, for people."""
    size = memory.stat().st_size / 1e6
    lines = [
        f"{memory}  {size:.1f} MB",
        f"frames     {report.posed} of {report.frames} posed, {report.lost} lost, {report.bad} unreadable",
        f"chunks     {report.chunks} in {report.components} part{'s' * (report.components > 1)}, {report.loops} loops",
        f"instances  {report.instances} things, {report.structure} pieces of structure, {report.relations} relations",
        f"time       {report.seconds:.1f} s, {report.frames_per_second:.1f} frames/s",
    ]
    return lines + [f"note: {line}" for line in report.notes]
