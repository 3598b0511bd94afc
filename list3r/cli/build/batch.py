"""batch: many videos, a memory each."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.build import source_options as src
from list3r.cli.common import JsonOption, print_table
from list3r.cli.terminal import note, write
from list3r.memory.core.errors import OptionError
from list3r.pipeline.request import BuildRequest, RunOptions, option

if TYPE_CHECKING:
    from list3r.batch.runner import BatchReport
    from list3r.batch.tasks import BatchTask
    from list3r.batch.work import Outcome


@dataclass(frozen=True)
class BatchPlace:
    """Where the tasks of a batch run, as options."""

    engine: str = option("local", "Engine that runs the tasks.", "local|ray")
    address: str | None = option(None, "Address of the Ray cluster; default: RAY_ADDRESS.", "ADDRESS")
    jobs: int | None = option(None, "Tasks at the same time; default: as many as fit.", "N")
    cpus: int = option(1, "Cores of one task.", "N")
    task_memory: float | None = option(None, "Memory of one task; default: not counted.", "GIB")
    gpus: float = option(0.0, "GPUs of one task, or a share of one.", "N")
    retries: int = option(3, "How often a task is repeated after its process was killed.", "N")
    scratch: Path | None = option(None, "Folder on each machine's own disk for unfinished memories.", "DIR")
    state: Path | None = option(None, "File with the state of every task; default: batch.sqlite in --out.", "FILE")


@dataclass(frozen=True)
class BatchTasks:
    """Options of the tasks."""

    element: int | None = option(None, "Only the N-th memory, from 0, in this process.", "N", flag="--only")
    script: str | None = option(
        None, "Print a script instead of building: slurm, an array job.", "WHAT", flag="--print"
    )
    onto: bool = option(False, "Add videos to memories that no batch made.")
    force: bool = option(False, "Replace memories of other videos or settings.")


def batch(
    videos: Annotated[
        str,
        typer.Argument(
            metavar="MANIFEST|FOLDER", help="A list with one video per line, or a folder of videos.", show_default=False
        ),
    ],
    out: Annotated[str, typer.Option("--out", metavar="DIR", help="Folder or URL of the memories.")],
    *,
    place: BatchPlace,
    tasks: BatchTasks,
    request: BuildRequest,
    given: src.SourceArguments,
    run: Annotated[RunOptions, "licence", "scale_anchor", "detector", "detector_classes"],
    json: JsonOption = False,
) -> None:
    """Build the memories of many videos, one task per video. Running it again does only what is not done yet.

    Example: list3r batch walks/ --out memories/
    """
    groups = _read(videos, given, request, run)
    from list3r.batch.engines.base import TaskResources  # after a list that may be refused
    from list3r.batch.engines.choice import make_engine
    from list3r.batch.runner import BatchSettings, run_batch, run_here
    from list3r.batch.slurm import slurm_script
    from list3r.pipeline.finishing import check_run

    check_run(run)
    resources = TaskResources(place.cpus, place.task_memory, place.gpus)
    settings = BatchSettings(
        out, place.scratch, place.state, place.retries, 0 if place.cpus == 1 else place.cpus, tasks.onto, tasks.force
    )
    if tasks.script is not None:
        if tasks.script != "slurm":
            raise OptionError(f"--print {tasks.script} is not known; give slurm")
        write(slurm_script(_without_print(sys.argv[1:]), len(groups), resources, place.jobs))
        return
    try:
        if tasks.element is not None:
            if not 0 <= tasks.element < len(groups):
                raise OptionError(f"--only {tasks.element}: the memories are numbered 0 to {len(groups) - 1}")
            report = run_here(groups[tasks.element], settings, _outcome_printer(json))
        else:
            report = run_batch(
                groups,
                make_engine(place.engine, resources, place.jobs, place.address),
                settings,
                _outcome_printer(json),
            )
    except KeyboardInterrupt:
        note("", "interrupted; finished memories are kept: run the same command again to continue")
        raise typer.Exit(1) from None
    _print_report(report, json)
    if report.failed:
        raise typer.Exit(1)


def _read(videos: str, given: src.SourceArguments, request: BuildRequest, run: RunOptions) -> list[list[BatchTask]]:
    """Return the videos of each memory, before the builder is loaded."""
    from list3r.batch.tasks import Asked, read_tasks

    return read_tasks(videos, Asked(lambda fields: replace(given, **fields).options(), request, run))


def _outcome_printer(quiet: bool) -> Any:
    """Return a callback that prints the outcome of each task, one line on standard error."""

    def print_outcome(outcome: Outcome, finished: int, total: int) -> None:
        o = outcome
        result = f"{o.frames} frames, {o.instances} instances" if o.built else o.reason
        note(f"[{finished}/{total}] {o.task.memory}: {o.state}, {result} ({o.seconds:.1f} s)")

    return (lambda outcome, finished, total: None) if quiet else print_outcome


def _print_report(report: BatchReport, json: bool) -> None:
    if json:
        print_answer([report.as_dict()])
        return
    failed = [
        [r.memory, PurePosixPath(r.source).name, r.attempts, r.reason] for r in report.tasks if r.state == "failed"
    ]
    note(f"{report.done} done, {report.built} of them now; {report.failed} failed")
    if failed:
        print_table(failed, ["memory", "video", "attempts", "why"])


def _without_print(words: list[str]) -> list[str]:
    """Return the words of the command that is to be run by the script."""
    out, skip = [], False
    for word in words:
        if skip or word.startswith("--print="):
            skip = False
        elif word == "--print":
            skip = True
        else:
            out.append(word)
    return out
