"""detect: names of instances from a box detector."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.bar import progress_bar
from list3r.cli.build import source_options as src
from list3r.cli.common import JsonOption, MemoryArgument, print_table
from list3r.cli.terminal import say
from list3r.memory.core.errors import OptionError
from list3r.pipeline.request import RunOptions


def detect(
    memory: MemoryArgument,
    detector: Annotated[
        Path,
        typer.Option(
            "--detector", metavar="FILE", help="A NanoDet detector for ncnn (.param, with its .bin next to it)."
        ),
    ],
    *,
    run: Annotated[RunOptions, "detector_classes"],
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            metavar="SOURCE",
            help="The video that the memory was built from, for more frames than the kept pictures.",
            show_default=False,
        ),
    ] = None,
    given: src.SourceArguments,
    json: JsonOption = False,
) -> None:
    """Name the instances of a memory with a box detector, whose boxes vote over many frames. Names by an operator stay.

    Example: list3r detect house.l3r --detector nanodet-m.param --source walk.mp4
    """
    if source is None and given != src.SourceArguments():
        raise OptionError("options of a video, such as --every, need the video: --source SOURCE")
    from list3r.pipeline.finishing import load_detector, name_things

    network, options = load_detector(detector, run.detector_classes), given.options()
    with progress_bar("detecting", "chunks", quiet=json) as bar:
        report = name_things(memory, network, source, options, bar.show)
    if json:
        print_answer([{"memory": str(memory), **report.as_dict()}])
        return
    say(f"{report.detector} searched {report.frames} pictures and found {report.boxes} boxes")
    print_table(sorted(report.labels.items()), ["id", "label"])
