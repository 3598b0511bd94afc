"""Write a point cloud with the instance id of every point."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.components import Component, component_files, thinned_support
from list3r.exporters.output import units, write_together
from list3r.exporters.palette import instance_color, structure_color
from list3r.memory.core.errors import check_choice
from list3r.memory.store.store import Store

_VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("confidence", "<f4"),
        ("instance", "<i4"),
    ]
)
_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}


@dataclass(frozen=True)
class PlySettings:
    """Content of the point cloud."""

    color: str = "instance"
    """instance: one colour an instance, the same in every export; rgb: the colours that were seen."""
    structure: bool = True
    """Whether floor, walls and the like are written too."""
    points_per_instance: int | None = None
    """At most this many points of each instance, all of them for None."""

    def __post_init__(self) -> None:
        check_choice("color", self.color, ("instance", "rgb"))


def write_ply(store: Store, path: str | Path, settings: PlySettings | None = None) -> tuple[Path, ...]:
    """Write all support points in world coordinates as binary PLY with a property `instance`, the id of each point.

    Comments name the instances, other signs than ASCII escaped as in JSON.
    Each component is a file of its own, the main one at `path`. Returns the files written.
    """
    chosen = settings or PlySettings()

    def write(component: Component, to: Path) -> None:
        vertices = _vertices(store, component, chosen)
        with to.open("wb") as file:
            file.write(_header(store, component, len(vertices)).encode("ascii"))
            file.write(vertices.tobytes())

    return write_together(component_files(store, path), write)


def _vertices(store: Store, component: Component, settings: PlySettings) -> NDArray[Any]:
    parts = []
    for instance in component.instances:
        if instance.structure and not settings.structure:
            continue
        support = thinned_support(store, instance, settings.points_per_instance)
        part = np.zeros(len(support.points), _VERTEX)
        part["x"], part["y"], part["z"] = support.points.T
        color = structure_color(instance.id) if instance.structure else instance_color(instance.id)
        rgb = support.rgb if settings.color == "rgb" else np.broadcast_to(np.array(color), (len(part), 3))
        part["red"], part["green"], part["blue"] = rgb.T
        part["confidence"], part["instance"] = support.confidence, instance.id
        parts.append(part)
    return np.concatenate(parts) if parts else np.zeros(0, _VERTEX)


def _header(store: Store, component: Component, count: int) -> str:
    scale, gravity = (store.facts.scale_kind or "relative"), store.facts.gravity
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment list3r: lengths in {units(store)}, scale {scale}, gravity {gravity}, component {component.id}",
    ]
    if not component.main:
        lines.append("comment list3r: this component was not placed against the main one; do not overlay them")
    for instance in component.instances:
        name = instance.label or instance.structure or instance.description
        lines.append(f"comment instance {instance.id} {json.dumps(name)[1:-1]}")
    lines.append(f"element vertex {count}")
    lines += [f"property {_PLY_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    return "\n".join([*lines, "end_header"]) + "\n"
