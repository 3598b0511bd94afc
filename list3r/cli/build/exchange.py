"""convert, import: to the layouts of other programs, and from their maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.build import source_options as src
from list3r.cli.common import JsonOption
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.reconstruction.outputs.base import OutputOptions


def convert(
    source: src.SourceArgument,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to write; it must not exist.")],
    *,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="LAYOUT",
            help="tum, transforms, colmap, replica or r3d; for predictions of networks: precomputed.",
        ),
    ],
    frame_size: Annotated[
        str | None,
        typer.Option(
            "--frame-size",
            metavar="WxH",
            help="For predictions: size of the video's frames, if the network cropped them.",
        ),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option("--masks", metavar="DIR", help="For predictions: folder of masks that EntitySAM saved."),
    ] = None,
    given: src.SourceArguments,
    json: JsonOption = False,
) -> None:
    """Write the frames of any source in a layout that other programs read.

    Example: list3r convert walk.r3d walk-tum --to tum
    """
    if to == "precomputed":
        from list3r.reconstruction.outputs.base import OutputOptions

        options = OutputOptions(given.every, None if frame_size is None else read_size(frame_size), masks)
        _convert_predictions(Path(source), folder, options, json)
        return
    from list3r.frames.convert import convert as write

    report = write(source, to, folder, given.options())
    if json:
        print_answer([report.as_dict()])
        return
    say(f"{report.path}  {report.frames} frames, {report.with_depth} with depth, {report.posed} with a pose")
    if report.bad:
        say(f"note: {report.bad} frames could not be decoded")
    say(*(f"note: {line}" for line in report.notes))


def read_size(text: str) -> tuple[int, int]:
    """Return height and width of `WxH`. Raises `OptionError`."""
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise OptionError(f"--frame-size {text}: give width and height in pixels, such as 1920x1080")
    return int(height), int(width)


def _convert_predictions(source: Path, folder: Path, options: OutputOptions, json: bool) -> None:
    """Convert the output of a network's own program to the layout that `--reconstruction precomputed` reads."""
    from list3r.reconstruction.outputs.registry import convert_predictions

    frames = convert_predictions(source, folder, options)
    if json:
        print_answer([{"layout": "precomputed", "path": str(folder), "frames": frames}])
    else:
        say(f"{folder}  {frames} frames; build with --reconstruction precomputed --weights {folder}")


def import_map(
    source: Annotated[str, typer.Argument(metavar="MAP", help="The map: a file or folder of another program.")],
    memory: Annotated[Path, typer.Option("-m", "--memory", metavar="MEMORY", help="The memory file to write.")],
    kind: Annotated[
        str, typer.Option("--format", metavar="FORMAT", help="conceptgraphs, hovsg, hydra, colmap, ply or auto.")
    ] = "auto",
    up: Annotated[str, typer.Option("--up", metavar="AXIS", help="The axis of the map that points up.")] = "z",
    json: JsonOption = False,
) -> None:
    """Make a memory from a map of another program. Relations, search and exports work as for any memory.

    Example: list3r import dsg.json -m house.l3r
    """
    from list3r.importers.importing import import_map as read

    report = read(source, memory, kind=kind, up=up)
    if json:
        print_answer([{"memory": str(memory), **report.as_dict()}])
        return
    say(f"{memory}  {report.format}: {report.objects} objects became {report.instances} instances")
    say(f"structure  {report.structure} pieces, {report.relations} relations")
    say(*(f"note: {line}" for line in report.notes))
