"""The table of export formats and the module that writes each; a module is imported when its format is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from list3r.exporters.output import check_target
from list3r.memory.errors import OptionError

if TYPE_CHECKING:  # the command line reads the names of the formats before anything heavy is needed
    from list3r.memory.store.store import Store

Writer = Callable[["Store", Path], tuple[Path, ...]]


@dataclass(frozen=True)
class Format:
    """One export format."""

    module: str
    function: str
    suffixes: tuple[str, ...]
    """File names that fit it, the usual one first."""
    any_suffix: bool
    """Whether other names are accepted too."""
    summary: str
    """One line for `--help`."""


FORMATS: dict[str, Format] = {
    "json": Format("scene_json", "write_scene_json", (".json",), True, "instances and relations, fixed schema"),
    "usd": Format(
        "usd.stage", "write_usd", (".usdc", ".usd", ".usda", ".usdz"), False, "OpenUSD: points, boxes, camera"
    ),
    "ply": Format("ply", "write_ply", (".ply",), False, "points coloured by instance"),
    "glb": Format("glb", "write_glb", (".glb",), False, "boxes and points for any glTF viewer"),
    "tum": Format("tum", "write_tum", (".txt", ".tum"), True, "camera trajectory, one line a frame"),
    "csv": Format("csv_tables", "write_csv", (".csv",), False, "tables of instances and of relations"),
    "plan": Format("plan.picture", "write_plan", (".png",), False, "plan view of the rooms as a picture"),
}


FOLDERS = ("prompt",)
"""Formats that are a folder, written through the face for Python."""


def export(store: Store, format_name: str, path: str | Path) -> tuple[Path, ...]:
    """Write a memory to `path` in a format. Returns the files written, `path` first.

    Formats that hold one coordinate frame write a further file beside `path` for each further connected component.
    Raises `OptionError` for an unknown format or a file name that does not fit it, `ExportError` when it cannot be
    written.
    """
    path = Path(path)
    writer = find_writer(format_name)
    form = FORMATS[format_name]
    if not form.any_suffix and path.suffix.lower() not in form.suffixes:
        raise OptionError(f"the format {format_name} is written to a {' or '.join(form.suffixes)} file, not to {path}")
    check_target(path)
    return writer(store, path)


def find_writer(format_name: str) -> Writer:
    """Return the function that writes a format. Raises `OptionError` that names the known formats."""
    if format_name not in FORMATS:
        raise OptionError(f"unknown format {format_name!r}; there are {', '.join((*FORMATS, *FOLDERS))}")
    form = FORMATS[format_name]
    module = importlib.import_module(f"list3r.exporters.{form.module}")
    return cast(Writer, getattr(module, form.function))
