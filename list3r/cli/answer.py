"""The envelope of every JSON answer: `{"schema", "units", "matches", "notes"}`, of errors too."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from list3r.cli.terminal import write

if TYPE_CHECKING:
    from list3r.memory.library.world.scale import Lengths

SCHEMA = "list3r/answer/1"
"""Name and version of the envelope; the number goes up when a reader of the old one would misread the new one."""


def print_answer(
    matches: Iterable[object], units: Lengths | str | None = None, notes: Iterable[str] = (), **facts: Any
) -> None:
    """Print an answer as JSON on standard output; NaN becomes null.

    `matches` are the entries that were asked for, one for a report. `units` is the unit of lengths, None where there
    are none; of a memory also who knows it. `notes` are sentences for people. `facts` are said of the answer as a
    whole, such as `total`.
    """
    if units is not None and not isinstance(units, str):
        facts = {"metric": units.metric, "metre_deviation": units.deviation, **facts}
        units = units.units
    answer = {"schema": SCHEMA, "units": units, "matches": list(matches), "notes": list(notes), **facts}
    write(json.dumps(_plain(answer), indent=2, allow_nan=False) + "\n")


def print_error(kind: str, message: str, status: int) -> None:
    """Print the envelope of a command that failed: no match, and the error with the exit status."""
    print_answer([], error={"kind": kind, "message": message, "status": status})


def wants_json(arguments: list[str]) -> bool:
    """Return whether a command line asks for JSON."""
    return "--json" in (arguments[: arguments.index("--")] if "--" in arguments else arguments)


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
