"""scale: how long a unit of a memory is, and what an operator knows of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli.common import JsonOption, MemoryArgument, open_memory, print_json
from list3r.cli.edit.commands import AuthorOption
from list3r.cli.terminal import say

if TYPE_CHECKING:
    from list3r.memory.maintenance.edits import EditReport

ScaleAnchor = Annotated[
    str | None,
    typer.Option(
        "--scale-anchor",
        metavar="ANCHOR",
        help="A length that you know, for videos without depth: camera_height=1.5m, x,y,z:x,y,z=1.2m or ID=0.095m.",
        show_default=False,
    ),
]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("scale")(scale)


def scale(
    memory: MemoryArgument,
    anchor: Annotated[
        str | None,
        typer.Option(
            "--anchor",
            metavar="ANCHOR",
            help="A length that you know: ID=0.095m (longest edge), ID.height=0.095m, camera_height=1.5m (median over "
            "the floor), or x,y,z:x,y,z=1.2m between two points.",
            show_default=False,
        ),
    ] = None,
    author: AuthorOption = None,
    json: JsonOption = False,
) -> None:
    """Say how long something is, so that lengths are metres; without --anchor, show what is known of the scale.

    Example: list3r scale house.l3r --anchor "12=0.095m"
    """
    if anchor is not None:
        report = anchor_scale(memory, anchor, author)
        if not json:
            say(f"{report.text} (entry {report.entry})")
    with open_memory(memory) as scene:
        kind, source = scene.store.get_value("scale_kind", "relative"), scene.store.get_value("scale_source")
        units = scene.units
    if json:
        told = None if anchor is None else report.as_dict()
        print_json({"scale": kind, "scale_source": source, "units": units, "edit": told})
    elif kind == "relative":
        say('scale relative: lengths are in units that nobody knows; --anchor "ID=0.095m" makes them metres')
    else:
        say(f"scale {kind}: lengths are metres ({source})")


def anchor_scale(memory: Path, anchor: str, author: str | None = None) -> EditReport:
    """ScaleAnchor the scale of a memory file; the `EditReport`."""
    from list3r.api import open as open_scene

    with open_scene(memory, writable=True) as scene:
        return scene.scale(anchor, author=author)


def check_anchor(anchor: str | None) -> None:
    """Raises `OptionError` for an anchor that nothing can be made of, before hours are spent."""
    if anchor is not None:
        from list3r.memory.world.scale import parse_anchor

        parse_anchor(anchor)
