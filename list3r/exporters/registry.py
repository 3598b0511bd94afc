"""The table of export formats and the module that writes each; a module is imported when its format is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from list3r.exporters.output import check_target
from list3r.memory.core.address_space import USD_MB, check_address_space
from list3r.memory.core.errors import OptionError, check_choice

if TYPE_CHECKING:  # the command line reads the names of the formats before anything heavy is needed
    from list3r.api import SceneMemory

Writer = Callable[..., tuple[Path, ...]]
"""Takes the store (or the memory, see `Format.of_memory`), the path and, where options are given, the settings."""


class ExportOptions(TypedDict, total=False):
    """Options of formats; each has some of them, None is its default."""

    color: str | None
    tokens: int | None
    question: str | None
    mesh: bool | None
    colliders: bool | None
    density: float | None
    ids: tuple[int, ...] | None
    guessed_metre: bool | None
    workers: int | None
    progress: Callable[[int, int], None] | None


@dataclass(frozen=True)
class Format:
    """One export format."""

    module: str
    function: str
    suffixes: tuple[str, ...]
    """File names that fit it, the usual one first; none for a folder."""
    summary: str
    """One line for `--help`."""
    any_suffix: bool = False
    """Whether other names are accepted too."""
    of_memory: bool = False
    """Whether it is written through the face for Python."""
    package: str = ""
    """The package that it needs besides the extra `export`, by its import name."""
    settings: str = ""
    """The dataclass of its options."""
    address_space_mb: int = 0
    """Address space that its libraries take, MiB; 0 where it is negligible."""
    options: tuple[str, ...] = ()
    """Fields of the settings that can be asked for, see `ExportOptions`."""

    @property
    def folder(self) -> bool:
        """Whether it is a folder."""
        return not self.suffixes


FORMATS: dict[str, Format] = {
    "json": Format("scene_json", "write_scene_json", (".json",), "instances and relations, fixed schema", True),
    "usd": Format(
        "usd.stage",
        "write_usd",
        (".usdc", ".usd", ".usda", ".usdz"),
        "OpenUSD: points, boxes, meshes, camera",
        settings="UsdSettings",
        options=("mesh", "colliders", "progress"),
        address_space_mb=USD_MB,
    ),
    "ply": Format("ply", "write_ply", (".ply",), "coloured points", settings="PlySettings", options=("color",)),
    "glb": Format(
        "glb",
        "write_glb",
        (".glb",),
        "surfaces or points, and boxes, for any glTF viewer",
        settings="GlbSettings",
        options=("color",),
    ),
    "tum": Format("tum", "write_tum", (".txt", ".tum"), "camera trajectory, one line a frame", True),
    "csv": Format("csv_tables", "write_csv", (".csv",), "tables of instances and of relations"),
    "parquet": Format("parquet", "write_parquet", (".parquet",), "tables with frames too", package="pyarrow"),
    "graphml": Format("graphs", "write_graphml", (".graphml",), "graphs of relations and of merges"),
    "node-link": Format("graphs", "write_node_link", (".json",), "the same graphs as JSON", True),
    "rerun": Format("rerun_log", "write_rerun", (".rrd",), "recording for the Rerun viewer", package="rerun"),
    "plan": Format("plan.drawing", "write_plan", (".png", ".svg"), "plan view of the rooms as a picture"),
    "report": Format("report.page", "write_report", (".html",), "a page to read and search", of_memory=True),
    "web": Format(
        "web.page", "write_web", (".html",), "a page to look at: the scene, its things, a search", of_memory=True
    ),
    "simready": Format(
        "simready.assembly",
        "write_simready",
        (),
        "a prop for each instance and a scene of them, for simulators",
        settings="SimreadySettings",
        options=("density", "ids", "guessed_metre", "workers", "progress"),
        address_space_mb=USD_MB,
    ),
    "mjcf": Format(
        "mjcf",
        "write_mjcf",
        (),
        "a model for MuJoCo: things as bodies on fixed structure",
        settings="MjcfSettings",
        options=("density", "ids", "guessed_metre", "progress"),
    ),
    "colmap": Format("cameras.colmap", "write_colmap", (), "text model of COLMAP with pictures"),
    "nerfstudio": Format("cameras.nerfstudio", "write_nerfstudio", (), "transforms.json with pictures"),
    "prompt": Format(
        "prompt.pack",
        "write_prompt",
        (),
        "a pack for a language model",
        of_memory=True,
        settings="PackSettings",
        options=("tokens", "question"),
    ),
}
"""Formats by name. A format with one coordinate frame writes a further file for each further component."""


def export(
    memory: SceneMemory, format_name: str, path: str | Path, **options: Unpack[ExportOptions]
) -> tuple[Path, ...]:
    """Write a memory to `path` in a format. Returns the files written, `path` first where it is a file.

    Raises `OptionError` for an unknown format, an option that it does not have or a file name that does not fit it,
    `ExportError` when it cannot be written.
    """
    path, form = Path(path), find_format(format_name)
    if form.suffixes and not form.any_suffix and path.suffix.lower() not in form.suffixes:
        raise OptionError(f"the format {format_name} is written to a {' or '.join(form.suffixes)} file, not to {path}")
    if not form.folder:
        check_target(path)
    check_address_space(form.address_space_mb, f"the format {format_name}")
    module = importlib.import_module(f"list3r.exporters.{form.module}")
    given = _given(format_name, form, dict(options))
    settings = [getattr(module, form.settings)(**given)] if given else []
    written: tuple[Path, ...] = getattr(module, form.function)(
        memory if form.of_memory else memory.store, path, *settings
    )
    return written


def format_of(path: str | Path) -> str:
    """Return the name of the format that a file's suffix stands for. Raises `OptionError` for any other."""
    suffix = Path(path).suffix.lower()
    for name, form in FORMATS.items():
        if suffix and suffix in form.suffixes:
            return name
    known = ", ".join(dict.fromkeys(s for form in FORMATS.values() for s in form.suffixes))
    folders = ", ".join(name for name, form in FORMATS.items() if form.folder)
    raise OptionError(
        f"{path} has no suffix of a format; end it with one of {known}, or name the format and the path"
        f" (folders: {folders})"
    )


def find_format(name: str) -> Format:
    """Return a format. Raises `OptionError` that names the known ones."""
    check_choice("format", name, FORMATS)
    return FORMATS[name]


def _given(name: str, form: Format, options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that are given. Raises `OptionError` for one that the format does not have."""
    given = {k: v for k, v in options.items() if v is not None}
    for option in given:
        if option not in form.options:
            others = [n for n, f in FORMATS.items() if option in f.options]
            raise OptionError(f"{option} belongs to {' and '.join(others) or 'no format'}, not to {name}; leave it out")
    return given
