"""scale: the length of a memory's unit, and lengths known to an operator."""

from __future__ import annotations

from typing import Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.common import JsonOption, MemoryArgument, open_memory
from list3r.cli.edit.commands import AuthorOption
from list3r.cli.terminal import say


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
    """Give one known length, so that all lengths become metres. Without --anchor, show the scale and its source.

    Example: list3r scale house.l3r --anchor "12=0.095m"
    """
    if anchor is not None:
        from list3r.pipeline.finishing import anchor_scale

        report = anchor_scale(memory, anchor, author)
        if not json:
            say(f"{report.text} (entry {report.entry})")
    with open_memory(memory) as scene:
        kind, source = (scene.store.facts.scale_kind or "relative"), scene.store.facts.scale_source
        units = scene.lengths
    if json:
        result = None if anchor is None else report.as_dict()
        print_answer([{"scale": kind, "scale_source": source, "edit": result}], units)
    elif kind == "guessed":
        say(f'scale guessed: lengths are about metres ({source}); --anchor "ID=0.095m" makes them metres')
    elif kind == "relative":
        say('scale relative: the length of a unit is unknown; --anchor "ID=0.095m" turns units into metres')
    else:
        say(f"scale {kind}: lengths are metres ({source})")
