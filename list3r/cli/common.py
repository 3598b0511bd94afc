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
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer

from list3r.cli.terminal import draws, say, write
from list3r.memory.core.description.printable import shown

if TYPE_CHECKING:
    from list3r.api import SceneMemory

MemoryArgument = Annotated[Path, typer.Argument(metavar="MEMORY", help="The memory file.", show_default=False)]
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
    from list3r.memory.core.errors import OptionError

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


def only(*names: str) -> tuple[str, ...]:
    """Return the fields of a dataclass that a command takes: `request: Annotated[RunOptions, only(...)]`."""
    return names


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with parameters that are dataclasses of options expanded to one option for each field.
    `source: SourceArguments` in its signature becomes all fields of `SourceArguments`, in that place and order. A field
    that is such a dataclass itself is expanded too.
    """
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, tuple[Any, list[inspect.Parameter]]] = {}
    options: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        group, *markers = get_args(parameter.annotation) or (parameter.annotation,)
        if not is_dataclass(group):
            options.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
            continue
        groups[name] = group, [o for o in _options_of(group) if not markers or o.name in markers[0]]
        options += groups[name][1]

    @functools.wraps(command)
    def gathered(**values: Any) -> None:
        given = {n: {p.name: values.pop(p.name) for p in parameters} for n, (_, parameters) in groups.items()}
        command(**values, **{n: _gathered(group, given[n]) for n, (group, _) in groups.items()})

    gathered.__signature__ = signature.replace(parameters=options)  # type: ignore[attr-defined]
    gathered.__annotations__ = {p.name: p.annotation for p in options}
    return gathered


def _options_of(group: Any) -> list[inspect.Parameter]:
    """Return the options that a dataclass represents."""
    types = get_type_hints(group, include_extras=True)
    inner = [
        _options_of(types[f.name]) if is_dataclass(types[f.name]) else [_as_option(f, types[f.name])]
        for f in fields(group)
    ]
    return [option for options in inner for option in options]


def _gathered(group: Any, given: dict[str, Any]) -> Any:
    """Return the dataclass made of the values of its options."""
    types = get_type_hints(group)
    inner = {f.name: _gathered(types[f.name], given) for f in fields(group) if is_dataclass(types[f.name])}
    own = {f.name: _given(group, f.name, given[f.name]) for f in fields(group) if f.name in given}
    return group(**inner, **own)


def _as_option(f: Field[Any], kind: Any) -> inspect.Parameter:
    """Return the parameter that typer makes an option of."""
    help_ = f.metadata.get("help")
    if help_ is None:
        return inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=kind)
    default = f.default
    if get_origin(kind) is tuple:
        kind, default = list[str] | None, None
    option = typer.Option(
        help_.flag or f"--{f.name.replace('_', '-')}",
        metavar=help_.metavar,
        help=help_.text,
        show_default=default is not None and default is not False,
        autocompletion=_choices(help_.metavar or ""),
    )
    return inspect.Parameter(
        f.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
    )


def _choices(metavar: str) -> Callable[[], list[str]] | None:
    """Return the completions of an option that is one of several words."""
    return metavar.split("|").copy if "|" in metavar and metavar.islower() else None


def _given(group: Any, name: str, value: Any) -> Any:
    """Return the value of an option as the dataclass has it: several words are a tuple."""
    declared = any(f.name == name and "help" in f.metadata for f in fields(group))
    several = declared and (value is None or isinstance(value, list))
    default = next(f.default for f in fields(group) if f.name == name)
    return tuple(value or ()) if several and isinstance(default, tuple) else value


_DRAWN_ROWS = 200
"""Rows of a table that is drawn: half a millisecond of processor time each (research/speed 0004)."""


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
