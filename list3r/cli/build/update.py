"""update, query changes: one more video for a memory, and what it changed."""

from __future__ import annotations

import functools
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.ask.changes import changes
from list3r.cli.build import model_options as mod
from list3r.cli.build import source_options as src
from list3r.cli.build.finishing import finish
from list3r.cli.build.progress import looking, show
from list3r.cli.common import JsonOption, MemoryArgument, check_one_way, note, print_json, spread, with_at
from list3r.cli.edit.scale import ScaleAnchor, check_anchor
from list3r.cli.models.detect import ClassFile, DetectorFile, check_detector
from list3r.cli.terminal import say

if TYPE_CHECKING:
    from list3r.pipeline.update import UpdateReport


def register(app: typer.Typer) -> None:
    """Add the commands to the program, after those of `query`."""
    app.command("update")(update)
    for group in app.registered_groups:
        if group.name == "query" and group.typer_instance is not None:
            group.typer_instance.command("changes")(changes)
            for command in group.typer_instance.registered_commands:
                if command.callback is not None:
                    command.callback = with_at(command.callback)


@spread
def update(
    memory: MemoryArgument,
    source: src.SourceArgument,
    *,
    models: mod.ModelWords,
    poses: Annotated[
        str, typer.Option("--poses", help="estimate, given or auto (given where the source has them).")
    ] = "auto",
    words: src.SourceWords,
    cut: mod.BuildCutWords,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Keep a JPEG of each keyframe.")] = True,
    workers: Annotated[
        int | None, typer.Option("--workers", metavar="N", help="Processes; default: cores, up to 4.")
    ] = None,
    scale_anchor: ScaleAnchor = None,
    detector: DetectorFile = None,
    detector_classes: ClassFile = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an update that was interrupted.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Give up an update that was interrupted.")] = False,
    json: JsonOption = False,
) -> None:
    """Add one more video to a memory: it is placed against what is stored, and what has changed is written down.

    Example: list3r update house.l3r walk-2/
    """
    options = words.options()
    from list3r.frames.source import open_source

    check_one_way(resume, force)
    check_anchor(scale_anchor)
    check_detector(detector, detector_classes)
    info = open_source(source, options).info
    words.check_fits(info)
    resumed = memory if resume else None
    settings, told = mod.build_settings(info, models, cut, poses=poses, pictures=pictures, resumed=resumed)
    if not json:
        for line in told:
            note(line)
    run: dict[str, Any] = {"options": options, "settings": settings, "workers": workers}
    report = _run(memory, source, quiet=json, licence=models.licence, resume=resume, force=force, **run)
    after: dict[str, Any] = {"scale_anchor": scale_anchor, "detector": detector, "classes": detector_classes}
    notes, failure = finish(memory, source, options, quiet=json, **after)
    report = replace(report, notes=(*report.notes, *notes))
    if json:
        print_json({"memory": str(memory), **report.as_dict()})
    else:
        say(*report_lines(memory, report))
    if failure is not None:
        raise failure


def report_lines(memory: Path, report: UpdateReport) -> list[str]:
    """What an update did, for people."""
    events = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in report.events.items())
    lines = [
        f"{memory}  session {report.session}",
        f"frames     {report.posed} of {report.frames} posed, {report.lost} lost, {report.bad} unreadable",
        f"placed     {report.placed} of {report.chunks} chunks, by {report.ties} relations to earlier sessions",
        f"things     {events}; {report.instances} in all",
        f"time       {report.seconds:.1f} s, {report.frames_per_second:.1f} frames/s",
    ]
    return lines + [f"note: {line}" for line in report.notes]


def _run(memory: Path, source: str, *, quiet: bool, **arguments: Any) -> UpdateReport:
    """Update with a progress bar; Ctrl-C says how to go on."""
    from tqdm import tqdm

    from list3r.pipeline.update import update as update_memory

    tqdm.monitor_interval = 0
    with tqdm(unit="frame", desc="updating", disable=quiet or not sys.stderr.isatty(), file=sys.stderr) as bar:
        progress = functools.partial(show, bar)
        try:
            return update_memory(memory, source, progress=progress, look=looking(bar, "updating"), **arguments)
        except KeyboardInterrupt:
            bar.close()
            note("", f"interrupted; {memory} keeps what it knew and the finished chunks: go on with --resume")
            raise typer.Exit(1) from None
