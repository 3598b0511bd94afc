"""Maps of ConceptGraphs: `obj_json_*.json`, in which each object has an id, a tag, a caption and a box.

The format is that of `save_obj_json` in conceptgraph/utils/general_utils.py, branch ali-dev. The whole map is a pickle
(`.pkl.gz`), which runs code of its maker when it is read, and is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from list3r.importers.base import ImportedMap, ImportedObject, box_surface, read_json_file, vector
from list3r.memory.core.errors import SourceError
from list3r.memory.core.geometry import OrientedBox

_NO_TAGS = ("", "item", "object", "none", "invalid")


def matches(path: Path) -> bool:
    """Return whether a path is such a file, or a folder with one."""
    return _file(path) is not None or path.name.endswith((".pkl", ".pkl.gz"))


def read(path: Path) -> ImportedMap:
    """Return the objects as boxes. Raises `SourceError`."""
    file = _file(path)
    if file is None:
        raise SourceError(
            f"{path} is a pickle, which runs code when it is read; give obj_json_*.json, which ConceptGraphs writes "
            "next to it (save_obj_json: true)"
        )
    content = read_json_file(file)
    if not isinstance(content, dict) or not content:
        raise SourceError(f"{file} holds no objects; is it of ConceptGraphs?")
    objects = tuple(_object(file, key, entry) for key, entry in content.items())
    return ImportedMap(
        "conceptgraphs",
        objects,
        notes=(
            "objects are boxes along the axes of the map, rounded to centimetres: the file has neither their turn nor "
            "their points",
        ),
    )


def _file(path: Path) -> Path | None:
    if path.is_dir():
        return next(iter(sorted(path.glob("obj_json_*.json"))), None)
    return path if path.name.startswith("obj_json") and path.suffix == ".json" else None


def _object(file: Path, key: str, entry: object) -> ImportedObject:
    if not isinstance(entry, Mapping):
        raise SourceError(f"{file}: {key} is not an object; fix or remove it")
    center = vector(entry.get("bbox_center"), f"{file}: bbox_center of {key}")
    size = vector(entry.get("bbox_extent"), f"{file}: bbox_extent of {key}")
    points = box_surface(OrientedBox(center, np.maximum(np.abs(size), 0.01), np.eye(3)))
    return ImportedObject(str(entry.get("id", key)), _tag(entry), points)


def _tag(entry: Mapping[str, Any]) -> str | None:
    tag = entry.get("object_tag")
    tag = tag[0] if isinstance(tag, list) and tag else tag
    return tag if isinstance(tag, str) and tag.lower() not in _NO_TAGS else None
