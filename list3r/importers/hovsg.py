"""Maps of HOV-SG: a folder `objects/` with a JSON and a PLY file for each object, as `Graph.save_graph` writes them.

`object_id` is floor_room_object; `name` is a class; `embedding` is CLIP's. Habitat's worlds have y up, which
`--up y` says.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import natural_key
from list3r.importers.base import ImportedMap, ImportedObject, read_json_file
from list3r.importers.ply import points_of, read_vertices
from list3r.memory.core.errors import SourceError


def matches(path: Path) -> bool:
    """Return whether a folder is such a map."""
    return (path / "objects").is_dir() and any((path / "objects").glob("*.json"))


def read(path: Path) -> ImportedMap:
    """Return the objects with their points. Raises `SourceError`."""
    files = sorted((path / "objects").glob("*.json"), key=lambda p: natural_key(p.name))
    objects = [_object(file) for file in files]
    left = sum(t is None for t in objects)
    notes = [f"{left} objects without points were left out"] if left else []
    notes += ["floors and rooms were not read"] if (path / "rooms").is_dir() else []
    return ImportedMap("hovsg", tuple(t for t in objects if t is not None), notes=tuple(notes))


def _object(file: Path) -> ImportedObject | None:
    content = read_json_file(file)
    if not isinstance(content, dict):
        raise SourceError(f"{file} is not an object of HOV-SG; fix or remove it")
    cloud = file.with_suffix(".ply")
    if not cloud.is_file():
        return None
    points, rgb = points_of(cloud, read_vertices(cloud))
    name = content.get("name")
    label = name if isinstance(name, str) and name and not name.startswith("object_") else None
    return ImportedObject(str(content.get("object_id", file.stem)), label, points, rgb, _embedding(content))


def _embedding(content: dict[str, Any]) -> NDArray[np.float32] | None:
    try:
        values = np.asarray(content.get("embedding"), np.float32).ravel()
    except (TypeError, ValueError):
        return None
    return values if len(values) > 1 and np.isfinite(values).all() and values.any() else None
