"""inspect, build, demo: from a source to a memory."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.build import source_options as src
from list3r.cli.build.progress import build_interrupted, report_lines, say_result, watching
from list3r.cli.common import JsonOption
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError
from list3r.pipeline.request import BuildRequest, RunOptions

if TYPE_CHECKING:
    from list3r.pipeline.reports import BuildReport


def inspect(
    source: src.SourceArgument,
    more: src.MoreArgument = None,
    *,
    given: src.SourceArguments,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Estimate the colour camera and the depth-to-colour transform.")
    ] = False,
    overlay: Annotated[
        Path | None, typer.Option("--overlay", metavar="FILE", help="Write a picture of depth edges over colour.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Report what a source contains: format, frames, size, depth, intrinsics, poses, and missing parts.

    Example: list3r inspect walk.mp4 --json
    """
    from list3r.exporters.output import replacing
    from list3r.frames.inspection import SourceReport, draw_registration
    from list3r.frames.pose_agreement import disagreements
    from list3r.frames.quick_look import unusable
    from list3r.frames.registration.edge_look import depth_doubts
    from list3r.frames.source import open_source

    options = given.options(more)
    if overlay is not None:
        _check_overlay(overlay, Path(source))
    opened = open_source(source, options)
    options.check_fits(opened.info)
    found = None
    if calibrate:
        from list3r.frames.registration.calibrate import calibrate as estimate

        found = estimate(source, options)
    if overlay is not None:
        with replacing(overlay) as temporary:
            draw_registration(opened, temporary)
    report = SourceReport(opened.info, found, overlay, unusable(opened), depth_doubts(opened), disagreements(opened))
    if json:
        print_answer([report.as_dict()])
    else:
        say(*report.lines())


def _check_overlay(overlay: Path, source: Path) -> None:
    """Raises `OptionError` or `ExportError` before any work where the picture cannot or must not be written."""
    from list3r.exporters.output import check_target

    if overlay.suffix.lower() != ".png":
        raise OptionError(f"--overlay {overlay}: the picture must end in .png")
    check_target(overlay)
    if overlay.exists() and overlay.resolve().is_relative_to(source.resolve()):
        raise OptionError(f"--overlay {overlay} is a picture of the source itself; name another file")


def build(
    source: src.SourceArgument,
    more: src.MoreArgument = None,
    *,
    memory: Annotated[Path, typer.Option("-m", "--memory", metavar="MEMORY", help="The memory file to write.")],
    request: BuildRequest,
    given: src.SourceArguments,
    run: RunOptions,
    debug: Annotated[
        Path | None,
        typer.Option("--debug", metavar="DIR", help="Write pictures of masks, tracks and loops to this folder."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Build a memory from a video, a folder of frames, a webcam or a stream.

    Example: list3r build walk/ -m house.l3r
    """
    options = given.options(more)
    from list3r.pipeline.live import build_any

    def work() -> BuildReport:
        with watching("building", build_interrupted(memory, run.resume), quiet=json, debug=debug) as watch:
            return build_any(source, memory, options=options, settings=request, run=run, watch=watch)

    say_result(memory, work, report_lines, json)


def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the walk, the memory and the exports.")
    ] = Path("list3r-demo"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random rooms.")] = 1,
    frames: Annotated[int, typer.Option("--frames", min=2, help="Length of the walk, frames.")] = 300,
    workers: Annotated[int | None, typer.Option("--workers", min=1, metavar="N", help="Worker processes.")] = None,
    json: JsonOption = False,
) -> None:
    """Simulate a walk through two furnished rooms, build its memory, ask it, export it. Nothing is downloaded.

    Example: list3r demo --out /tmp/demo
    """
    from list3r.cli.build.demo import run_demo

    with contextlib.redirect_stdout(io.StringIO()) if json else contextlib.nullcontext():
        report = run_demo(out, seed=seed, frames=frames, workers=workers, quiet=json)
    if json:
        print_answer([report])
