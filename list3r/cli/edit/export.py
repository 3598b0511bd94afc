"""export: a memory in other formats."""

from __future__ import annotations

import contextlib
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from list3r.cli.answer import print_answer
from list3r.cli.bar import progress_bar
from list3r.cli.common import JsonOption, MemoryArgument, MinConfidence, open_memory, say_fusing
from list3r.cli.terminal import note, say
from list3r.exporters.registry import FORMATS, find_format
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.api import SceneMemory


_FORMAT_OPTION = typer.Option(
    "--to", metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.", autocompletion=lambda: list(FORMATS)
)


def _ids(text: str) -> tuple[int, ...]:
    if not all(word.strip().isdecimal() for word in text.split(",")):
        raise OptionError(f"--ids {text}: give numbers separated by commas, such as 3,7,12")
    return tuple(map(int, text.split(",")))


def export(
    memory: MemoryArgument,
    to: Annotated[str, _FORMAT_OPTION],
    out: Annotated[
        Path, typer.Option("--out", metavar="PATH", help="The file or folder to write; - for standard output.")
    ],
    color: Annotated[
        str | None,
        typer.Option(
            "--color",
            metavar="rgb|instance",
            help="ply, glb: rgb (as seen) or instance.",
            autocompletion=lambda: ["rgb", "instance"],
        ),
    ] = None,
    tokens: Annotated[
        int | None, typer.Option("--tokens", metavar="N", help="prompt: most tokens of the text; default: 2000.")
    ] = None,
    question: Annotated[
        str | None,
        typer.Option("--question", metavar="TEXT", help="prompt: a question; instances it asks about come first."),
    ] = None,
    mesh: Annotated[
        bool, typer.Option("--mesh", help="usd: write a closed mesh of each instance instead of its points.")
    ] = False,
    colliders: Annotated[bool, typer.Option("--colliders", help="usd: write meshes with colliders.")] = False,
    density: Annotated[
        float | None,
        typer.Option(
            "--density", metavar="KG/M3", help="simready, mjcf: kg per cubic metre of the hull, for an estimated mass."
        ),
    ] = None,
    ids: Annotated[
        str | None,
        typer.Option("--ids", metavar="ID,...", help="simready, mjcf: only these instances, such as 3,7,12."),
    ] = None,
    guessed_metre: Annotated[
        bool,
        typer.Option(
            "--guessed-metre",
            help="simready, mjcf: take a guessed metre for one; lengths and masses are as wrong as it.",
        ),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option("--workers", metavar="N", help="simready: worker processes; 0: work in this process."),
    ] = None,
    min_confidence: MinConfidence = None,
    json: JsonOption = False,
) -> None:
    """Write a memory in another format: scene JSON, USD, points, boxes, trajectory, tables, graphs, plan, an HTML
    report, a page with the scene (web), or a folder: models of COLMAP and nerfstudio, a pack for a language model.

    Example: list3r export house.l3r --to usd --out house.usdc
    """
    asked: dict[str, Any] = {
        "color": color,
        "tokens": tokens,
        "question": question,
        "mesh": mesh,
        "colliders": colliders,
        "density": density,
        "ids": None if ids is None else _ids(ids),
        "guessed_metre": guessed_metre,
        "workers": workers,
    }
    options = {name: value for name, value in asked.items() if value is not None and value is not False}
    if out == Path("-"):
        if json:
            raise OptionError("--out - and --json both write to standard output; leave one out")
        with open_memory(memory, min_confidence) as scene:
            _pipe(scene, to, options)
        return
    with open_memory(memory, min_confidence) as scene, _watched(to, quiet=json) as watch:
        if to in ("glb", "web") or (mesh and not colliders):
            say_fusing(scene)
        written = scene.export(to, out, **options, **watch)
    sizes = {str(path): path.stat().st_size for path in written}
    if json:
        print_answer({"format": to, "path": path, "bytes": size} for path, size in sizes.items())
    elif find_format(to).folder:
        say(f"{out}  {len(sizes)} file{'s' * (len(sizes) != 1)}, {_size_text(sum(sizes.values()))}")
    else:
        say(*(f"{path}  {_size_text(size)}" for path, size in sizes.items()))


@contextlib.contextmanager
def _watched(to: str, *, quiet: bool) -> Iterator[dict[str, Any]]:
    """Show the progress of an export: the option of the formats that report it."""
    with progress_bar(f"writing {to}", "instances", quiet=quiet) as bar:
        yield {"progress": bar.show} if "progress" in find_format(to).options else {}


def _size_text(size: int) -> str:
    return f"{size / 1e6:.2f} MB" if size >= 1e4 else f"{size / 1e3:.1f} kB"


def _pipe(scene: SceneMemory, to: str, options: dict[str, Any]) -> None:
    """Write the first file of a format to standard output, once it is whole. Raises `OptionError` for a folder."""
    form = find_format(to)
    if form.folder:
        raise OptionError(f"{to} writes a folder, which cannot go to standard output; name one with --out")
    with tempfile.TemporaryDirectory() as folder:
        first, *others = scene.export(to, Path(folder) / f"{scene.path.stem}{form.suffixes[0]}", **options)
        with first.open("rb") as file:
            shutil.copyfileobj(file, sys.stdout.buffer)
    for other in others:
        note(f"note: {other.name} is left out; --out FILE writes it next to the file")
