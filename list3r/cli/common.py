"""Shared parts of the commands: reading of options and output of results."""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from list3r.cli.terminal import draws, note, say, write
from list3r.memory.core.description.printable import shown
from list3r.memory.core.errors import OptionError

if TYPE_CHECKING:
    from list3r.api import SceneMemory

MemoryArgument = Annotated[Path, typer.Argument(metavar="MEMORY", help="The memory file.", show_default=False)]
IdArgument = Annotated[
    int, typer.Argument(metavar="ID", help="The instance, by any id it ever had.", show_default=False)
]
MIN_CONFIDENCE = "Everything with at least this confidence, also low-confidence segments (default: not listed)."
MinConfidence = Annotated[float | None, typer.Option("--min-confidence", help=MIN_CONFIDENCE)]
AtOption = Annotated[
    int | None, typer.Option("--at", metavar="SESSION", help="Show the world as it was after this session.")
]
LicenceOption = Annotated[
    str,
    typer.Option(
        "--licence",
        metavar="permissive|research|any",
        help="Licences that weights may have. permissive: none that is non-commercial, gated, copyleft or custom.",
        autocompletion=lambda: ["permissive", "research", "any"],
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on standard output.")]


def parse_point(text: str, option: str) -> tuple[float, float, float]:
    """Three numbers with commas. Raises `OptionError` naming the option."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise OptionError(f"{option} {text!r}: give three numbers separated by commas, such as 0.5,1.2,0.8") from None
    if not all(math.isfinite(v) for v in (x, y, z)):
        raise OptionError(f"{option} {text!r}: give finite numbers")
    return x, y, z


@contextlib.contextmanager
def open_memory(path: Path, min_confidence: float | None = None, at: int | None = None) -> Iterator[SceneMemory]:
    """The memory of a path, for reading: now, after the session `at`, or with all segments of a least confidence.
    All reads see one state, also while a build or an update commits.
    """
    from list3r.api import open as open_scene

    with open_scene(path, at=at, min_confidence=min_confidence) as scene, scene.store.snapshot():
        yield scene


def expanded(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command as typer takes it: a parameter that is a dataclass becomes an option for each of its fields, or
    for those that its annotation names: `run: Annotated[RunOptions, "licence"]`.
    """
    groups: dict[str, tuple[Any, list[Field[Any]]]] = {}
    options: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        group, *named = get_args(parameter.annotation) or (parameter.annotation,)
        if not is_dataclass(group):
            options.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        hints, kept = get_type_hints(group), [f for f in fields(group) if not named or f.name in named]
        groups[name] = group, kept
        options += [_as_option(f, hints[f.name]) for f in kept]
    if not groups:
        return command

    @functools.wraps(command)
    def gathered(**values: Any) -> None:
        given = {n: {f.name: _given(f, values.pop(f.name)) for f in kept} for n, (_, kept) in groups.items()}
        command(**values, **{n: group(**given[n]) for n, (group, _) in groups.items()})

    gathered.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    gathered.__annotations__ = {p.name: p.annotation for p in options}
    return gathered


def _as_option(f: Field[Any], kind: Any) -> inspect.Parameter:
    """Return the parameter that typer makes an option of: what `pipeline.request.option` says of a field."""
    said, default, choices = f.metadata["help"], f.default, None
    if isinstance(default, tuple):
        kind, default = list[str] | None, None
    if "|" in (said.metavar or "") and said.metavar.islower():
        choices = said.metavar.split("|").copy
    option = typer.Option(
        said.flag or f"--{f.name.replace('_', '-')}",
        metavar=said.metavar,
        help=said.text,
        show_default=default is not None and default is not False,
        autocompletion=choices,
    )
    return inspect.Parameter(
        f.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
    )


def _given(f: Field[Any], value: Any) -> Any:
    """Return the value of an option as the dataclass has it: several words are a tuple."""
    return tuple(value or ()) if isinstance(f.default, tuple) else value


_DRAWN_ROWS = 200
"""Rows of a table that is drawn: half a millisecond of processor time each (research/speed 0004)."""


def say_fusing(scene: SceneMemory) -> None:
    """Say that depth is fused first, where it is."""
    from list3r.queries.views.dense import must_fuse

    if must_fuse(scene.store):
        note("fusing stored depth into surfaces, from seconds to a few minutes; they are kept for the next time")


def print_table(rows: Iterable[Sequence[object]], header: Sequence[str]) -> None:
    """Left-aligned columns under a header; a word where there are no rows. A short table on a terminal is drawn."""
    shown_rows = [[f"{v:.3f}" if isinstance(v, float) else shown(v) for v in row] for row in rows]
    if not shown_rows:
        say("nothing found")
        return
    if len(shown_rows) <= _DRAWN_ROWS and draws(sys.stdout):
        from list3r.cli.drawing import drawn_table

        table = drawn_table(header, shown_rows)
        if table is not None:
            write(table)
            return
    cells = [list(header), *shown_rows]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    for row in cells:
        say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def in_column(name: str) -> str:
    """Return a name for a table: repeated blanks, which look like a gap between columns, are escaped."""
    return re.sub(r"(?<= ) +", lambda blanks: r"\x20" * len(blanks[0]), name)
