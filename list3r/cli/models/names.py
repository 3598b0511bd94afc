"""names: what instances are called, by a detector that is fetched where it is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.bar import progress_bar
from list3r.cli.common import JsonOption, MemoryArgument, print_table
from list3r.cli.terminal import note, say


def names(
    memory: MemoryArgument,
    *,
    by: Annotated[
        str, typer.Option("--by", metavar="detector|open", help="A small network of 80 kinds, or one of all our nouns.")
    ] = "detector",
    detector: Annotated[
        Path | None,
        typer.Option("--detector", metavar="PATH", help="Its own file or folder of weights.", show_default=False),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source", metavar="SOURCE", help="The video, for more than the kept pictures.", show_default=False
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Name the instances of a memory; weights that are not there are fetched. Names by an operator stay.

    Example: list3r names house.l3r --by detector
    """
    from list3r.pipeline.finishing import guess_anew, load_naming, name_things

    network = load_naming(by, detector, None, note)
    with progress_bar("naming", "chunks", quiet=json) as bar:
        report = name_things(memory, network, source, None, bar.show)
    guess_anew(memory)
    if json:
        print_answer([{"memory": str(memory), **report.as_dict()}])
        return
    say(f"{report.detector} searched {report.frames} pictures and found {report.boxes} boxes")
    print_table(sorted(report.labels.items()), ["id", "label"])
