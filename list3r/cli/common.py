"""What the commands share: how options are read and how results are shown."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from list3r.cli.terminal import say, tell, write
from list3r.memory.description.printable import shown

if TYPE_CHECKING:
    from list3r.api import SceneMemory

MemoryArgument = Annotated[Path, typer.Argument(metavar="MEMORY", help="The memory file.", show_default=False)]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on standard output.")]


def parse_point(text: str, option: str) -> tuple[float, float, float]:
    """Three numbers with commas. Raises `OptionError` naming the option."""
    from list3r.memory.errors import OptionError

    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise OptionError(f"{option} {text!r}: three numbers with commas are needed, such as 0.5,1.2,0.8") from None
    if not all(math.isfinite(v) for v in (x, y, z)):
        raise OptionError(f"{option} {text!r}: the numbers must be finite")
    return x, y, z


def check_one_way(resume: bool, force: bool) -> None:
    """Raises `OptionError` where `--resume` and `--force`, which say opposite things, are both given."""
    from list3r.memory.errors import OptionError

    if resume and force:
        raise OptionError("--resume goes on with what is there and --force gives it up; give one of them")


_AT: ContextVar[int | None] = ContextVar("at", default=None)
"""The session after which the world is asked about, for the command that runs."""


@contextlib.contextmanager
def open_memory(path: Path) -> Iterator[SceneMemory]:
    """The memory behind a path, for reading: as it is, or as it was after the session of `--at`.

    All that is read belongs to one state, whatever a build or an update commits meanwhile.
    """
    from list3r.api import open as open_scene

    with open_scene(path, at=_AT.get()) as scene, scene.store.snapshot():
        yield scene


def with_at(command: Callable[..., Any]) -> Callable[..., Any]:
    """The same command with `--at SESSION`, which `open_memory` obeys while it runs."""
    signature = inspect.signature(command, eval_str=True)
    option = Annotated[
        int | None, typer.Option("--at", metavar="SESSION", help="The world as it was after this session.")
    ]
    added = inspect.Parameter("at", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=option)

    @functools.wraps(command)
    def asked(*args: Any, at: int | None = None, **words: Any) -> Any:
        before = _AT.set(at)
        try:
            return command(*args, **words)
        finally:
            _AT.reset(before)

    asked.__signature__ = signature.replace(parameters=[*signature.parameters.values(), added])  # type: ignore[attr-defined]
    asked.__annotations__ = {**get_type_hints(command, include_extras=True), "at": option}
    return asked


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """The same command with one option for each field of those of its parameters that are dataclasses of options.

    `words: SourceWords` in its signature stands for all fields of `SourceWords`, in that place and order.
    """
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {n: p.annotation for n, p in signature.parameters.items() if is_dataclass(p.annotation)}
    options: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        if name not in groups:
            options.append(parameter)
            continue
        types = get_type_hints(groups[name], include_extras=True)
        for f in fields(groups[name]):
            kind = inspect.Parameter.KEYWORD_ONLY
            options.append(inspect.Parameter(f.name, kind, default=f.default, annotation=types[f.name]))

    @functools.wraps(command)
    def gathered(**words: Any) -> None:
        made = {n: group(**{f.name: words.pop(f.name) for f in fields(group)}) for n, group in groups.items()}
        command(**words, **made)

    gathered.__signature__ = signature.replace(parameters=options)  # type: ignore[attr-defined]
    gathered.__annotations__ = {p.name: p.annotation for p in options}
    return gathered


def print_json(value: object) -> None:
    """JSON on standard output; NaN becomes null."""
    write(json.dumps(_plain(value), indent=2, allow_nan=False) + "\n")


def print_table(rows: Iterable[Sequence[object]], header: Sequence[str]) -> None:
    """Left-aligned columns under a header; a word where there are no rows."""
    rows = list(rows)
    if not rows:
        say("nothing found")
        return
    cells = [list(header), *[[_cell(v) for v in row] for row in rows]]
    widths = [max(len(row[k]) for row in cells) for k in range(len(header))]
    for row in cells:
        say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def note(*lines: str) -> None:
    """Lines for people, on standard error; work goes on where nobody listens any more."""
    tell(*lines)


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else shown(value)


def _plain(value: Any) -> Any:
    """Arrays to lists, NumPy numbers to Python's, NaN to null, floats to six decimals."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
