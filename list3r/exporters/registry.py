"""Which formats there are, and which module writes each; a module is imported when its format is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from list3r.exporters.output import check_target
from list3r.memory.errors import OptionError
from list3r.memory.store.store import Store

Writer = Callable[[Store, Path], tuple[Path, ...]]


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
    "usd": Format("usd.stage", "write_usd", (".usda", ".usdc", ".usd"), False, "OpenUSD stage: points, boxes, camera"),
    "ply": Format("ply", "write_ply", (".ply",), False, "points coloured by instance"),
    "glb": Format("glb", "write_glb", (".glb",), False, "boxes and points for any glTF viewer"),
    "tum": Format("tum", "write_tum", (".txt", ".tum"), True, "camera trajectory, one line a frame"),
    "plan": Format("plan.picture", "write_plan", (".png",), False, "plan view of the rooms as a picture"),
}


def export(store: Store, format_name: str, path: str | Path) -> tuple[Path, ...]:
    """Write a memory to `path` in a format; the files written, `path` first.

    A memory of several components gives further files beside `path` in formats that hold one frame of reference.
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
    """The function that writes a format. Raises `OptionError` naming the formats there are."""
    if format_name not in FORMATS:
        raise OptionError(f"unknown format {format_name!r}; there are {', '.join(FORMATS)}")
    form = FORMATS[format_name]
    module = importlib.import_module(f"list3r.exporters.{form.module}")
    return cast(Writer, getattr(module, form.function))
