"""inspect, build, demo: from a source to a memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from list3r.cli.build import model_options as mod
from list3r.cli.build import source_options as src
from list3r.cli.build.finishing import finish
from list3r.cli.build.progress import report_lines, run_build
from list3r.cli.common import JsonOption, check_one_way, note, print_json, spread
from list3r.cli.edit.scale import ScaleAnchor, check_anchor
from list3r.cli.models.detect import ClassFile, DetectorFile, check_detector
from list3r.cli.terminal import say


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command("inspect")(inspect)
    app.command("build")(build)
    app.command("demo")(demo)


@spread
def inspect(
    source: src.SourceArgument,
    *,
    words: src.SourceWords,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Estimate the colour camera and the depth-to-colour transform.")
    ] = False,
    overlay: Annotated[
        Path | None, typer.Option("--overlay", metavar="FILE", help="Write a picture of depth edges over colour.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Say what a source holds: kind, frames, size, depth, intrinsics, poses, and what is missing.

    Example: list3r inspect walk.mp4 --json
    """
    from list3r.exporters.output import replacing
    from list3r.frames.inspection import describe, draw_registration, lines
    from list3r.frames.source import open_source

    options = words.options()
    if overlay is not None:
        _check_overlay(overlay, Path(source))
    opened = open_source(source, options)
    words.check_fits(opened.info)
    report = describe(opened.info)
    if calibrate:
        from list3r.frames.registration.calibrate import calibrate as estimate

        report["calibration"] = estimate(source, options).as_dict()
    if overlay is not None:
        with replacing(overlay) as temporary:
            draw_registration(opened, temporary)
        report["overlay"] = str(overlay)
    if json:
        print_json(report)
    else:
        say(*lines(report))


def _check_overlay(overlay: Path, source: Path) -> None:
    """Raises `OptionError` or `ExportError` before any work where the picture cannot or must not be written."""
    from list3r.exporters.output import check_target
    from list3r.memory.errors import OptionError

    if overlay.suffix.lower() != ".png":
        raise OptionError(f"--overlay {overlay}: the picture must end in .png")
    check_target(overlay)
    if overlay.exists() and overlay.resolve().is_relative_to(source.resolve()):
        raise OptionError(f"--overlay {overlay} is a picture of the source; name another file")


@spread
def build(
    source: src.SourceArgument,
    memory: Annotated[Path, typer.Option("-m", "--memory", metavar="MEMORY", help="The memory file to write.")],
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
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a build that was interrupted.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing memory.")] = False,
    debug: Annotated[
        Path | None, typer.Option("--debug", metavar="DIR", help="Write overlays of masks and tracks there.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Build a memory from a video or a folder of frames.

    Example: list3r build walk/ -m house.l3r
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
        for line in (*(f"note: {n}" for n in info.notes), *told):
            note(line)
    run = {"options": options, "settings": settings, "workers": workers, "resume": resume, "force": force}
    report = run_build(source, memory, quiet=json, debug_dir=debug, licence=models.licence, **run)
    after: dict[str, Any] = {"scale_anchor": scale_anchor, "detector": detector, "classes": detector_classes}
    notes, failure = finish(memory, source, options, quiet=json, **after)
    report = replace(report, notes=(*report.notes, *notes))
    if json:
        print_json({"memory": str(memory), **report.as_dict()})
    else:
        say(*report_lines(memory, report))
    if failure is not None:
        raise failure


def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the walk, the memory and the exports.")
    ] = Path("list3r-demo"),
    seed: Annotated[int, typer.Option("--seed", help="Another seed furnishes other rooms.")] = 1,
    frames: Annotated[int, typer.Option("--frames", help="Length of the walk.")] = 300,
    workers: Annotated[int | None, typer.Option("--workers", metavar="N", help="Processes.")] = None,
    json: JsonOption = False,
) -> None:
    """Simulate a walk through two furnished rooms, build its memory, ask it, export it. Nothing is downloaded.

    Example: list3r demo --out /tmp/demo
    """
    from list3r.cli.build.demo import run_demo

    report = run_demo(out, seed=seed, frames=frames, workers=workers, quiet=json)
    if json:
        print_json(report)
