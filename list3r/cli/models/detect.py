"""detect: names of things from a box detector."""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from list3r.cli.build import source_options as src
from list3r.cli.build.progress import show
from list3r.cli.common import JsonOption, MemoryArgument, print_json, print_table, spread
from list3r.cli.terminal import say

if TYPE_CHECKING:
    from list3r.frames.options import SourceOptions
    from list3r.semantics.detection import DetectReport
    from list3r.semantics.nanodet import NanoDet

DetectorFile = Annotated[
    Path | None,
    typer.Option(
        "--detector",
        metavar="FILE",
        help="A NanoDet box detector for ncnn (.param, with its .bin beside it) that names things.",
        show_default=False,
    ),
]
ClassFile = Annotated[
    Path | None,
    typer.Option(
        "--detector-classes",
        metavar="FILE",
        help="Its classes, one name a line; default: the 80 of COCO.",
        show_default=False,
    ),
]


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("detect")(detect)


@spread
def detect(
    memory: MemoryArgument,
    detector: Annotated[
        Path,
        typer.Option("--detector", metavar="FILE", help="A NanoDet detector for ncnn: .param, its .bin beside."),
    ],
    *,
    detector_classes: ClassFile = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            metavar="SOURCE",
            help="The video that the memory was built from, to look at more frames than the kept pictures.",
            show_default=False,
        ),
    ] = None,
    words: src.SourceWords,
    json: JsonOption = False,
) -> None:
    """Name the things of a memory: boxes of a detector vote over many frames. What an operator named keeps its name.

    Example: list3r detect house.l3r --detector nanodet-m.param --source walk.mp4
    """
    from list3r.memory.errors import OptionError

    if source is None and words != src.SourceWords():
        raise OptionError("options that say how a video is read, such as --every, need the video: --source SOURCE")
    report = run_detector(memory, detector, detector_classes, source, words.options(), quiet=json)
    if json:
        print_json({"memory": str(memory), **report.as_dict()})
        return
    say(f"{report.detector} looked at {report.frames} pictures and found {report.boxes} boxes")
    print_table(sorted(report.labels.items()), ["id", "label"])


def check_detector(detector: Path | None, classes: Path | None) -> None:
    """Raises `OptionError` for a detector that cannot be used, before hours are spent."""
    if detector is not None:
        _load(detector, classes)
    elif classes is not None:
        from list3r.memory.errors import OptionError

        raise OptionError(f"--detector-classes {classes} are those of a detector; give it with --detector FILE")


def run_detector(
    memory: Path,
    detector: Path,
    classes: Path | None,
    source: str | None,
    options: SourceOptions | None,
    *,
    quiet: bool,
) -> DetectReport:
    """Look at a memory with a progress bar: at frames of the source's session where one is named, else at all pictures.

    Of a memory with several sessions, those that the source is not of keep their votes.
    """
    from tqdm import tqdm

    from list3r.memory.store.store import Store
    from list3r.semantics.detection import detect as name_things
    from list3r.semantics.detection import open_sources

    network = _load(detector, classes)
    tqdm.monitor_interval = 0
    with (
        Store.open(memory, writable=True) as store,
        tqdm(unit="chunk", desc="detecting", disable=quiet or not sys.stderr.isatty(), file=sys.stderr) as bar,
    ):
        progress = functools.partial(show, bar)
        opened = None if source is None else open_sources(store, source, options)
        chunks = None if opened is None else [c.chunk_id for c in store.chunks() if c.session_id in opened]
        return name_things(store, network, opened, chunks=chunks, progress=progress)


def _load(detector: Path, classes: Path | None) -> NanoDet:
    from list3r.semantics.coco import COCO_80
    from list3r.semantics.nanodet import NanoDet, read_class_names

    return NanoDet(detector, COCO_80 if classes is None else read_class_names(classes))
