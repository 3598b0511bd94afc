"""Scene graphs of Hydra and Khronos: the JSON of spark-dsg (`dsg.json`).

Nodes have `attributes` of a `type`; objects have `ObjectNodeAttributes` or a kind of it, with `name`, `semantic_label`,
`bounding_box` and the numbers of the mesh's vertices. Boxes have `dimensions` since version 1.0.3 and `min`, `max`
before; where the file holds the mesh, objects get its points.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.importers.base import ImportedMap, ImportedObject, box_surface, read_json_file, vector
from list3r.memory.core.errors import SourceError
from list3r.memory.core.geometry import OrientedBox

_OBJECTS = ("ObjectNodeAttributes", "KhronosObjectAttributes")
_LEAST_POINTS = 30
_NO_LABEL = 2**32 - 1


def matches(path: Path) -> bool:
    """Return whether a path is a JSON file with such a graph."""
    if path.suffix != ".json" or not path.is_file():
        return False
    content = read_json_file(path)
    nodes = content.get("nodes") if isinstance(content, dict) else None
    return isinstance(nodes, list) and any(key in content for key in ("layer_ids", "layer_keys", "mesh_layer_id"))


def read(path: Path) -> ImportedMap:
    """Return the objects of the graph. Raises `SourceError`."""
    content = read_json_file(path)
    labels, mesh = _labels(content), _mesh(content)
    nodes = [n for n in content["nodes"] if _kind(n) in _OBJECTS]
    found = [_object(path, node, labels, mesh) for node in nodes]
    objects = tuple(t for t in found if t is not None)
    notes = []
    if len(objects) < len(found):
        notes.append(f"{len(found) - len(objects)} objects without a valid box were left out")
    if mesh is None:
        notes.append("the file holds no mesh: objects are boxes")
    others = len(content["nodes"]) - len(nodes)
    if others:
        notes.append(f"{others} nodes that are not objects (places, rooms, agents) were not read")
    return ImportedMap("hydra", objects, notes=tuple(notes))


def _kind(node: object) -> object:
    attributes = node.get("attributes") if isinstance(node, dict) else None
    return attributes.get("type") if isinstance(attributes, dict) else None


def _labels(content: Mapping[str, Any]) -> dict[int, str]:
    """Names of semantic labels, where the file's metadata states them."""
    metadata = content.get("metadata")
    rows = metadata.get("labelspace") or metadata.get("label_names") if isinstance(metadata, dict) else None
    if isinstance(rows, dict):
        return {int(k): str(v) for k, v in rows.items() if str(k).isdigit()}
    out = {}
    for row in rows if isinstance(rows, list) else []:
        if isinstance(row, list) and len(row) == 2 and isinstance(row[0], int):
            out[row[0]] = str(row[1])
    return out


def _mesh(content: Mapping[str, Any]) -> NDArray[np.float32] | None:
    """Points of the mesh, shape (N, 3); None where the file has none."""
    mesh = content.get("mesh")
    try:
        points = np.asarray(mesh["points"] if isinstance(mesh, dict) else (), np.float32)
    except (KeyError, TypeError, ValueError):
        return None
    return points if points.ndim == 2 and points.shape[1] == 3 and len(points) else None


def _object(
    path: Path, node: Mapping[str, Any], labels: Mapping[int, str], mesh: NDArray[np.float32] | None
) -> ImportedObject | None:
    attributes, number = node["attributes"], node.get("id")
    where = f"{path}: node {number}"
    label = _label(attributes, labels)
    box = _box(attributes.get("bounding_box"), where)
    points = _points(attributes, mesh)
    if points is None and box is None:
        return None
    return ImportedObject(symbol(number), label, box_surface(box) if points is None else points)  # type: ignore[arg-type]


def _label(attributes: Mapping[str, Any], labels: Mapping[int, str]) -> str | None:
    """Return the name of an object or of its class; "class 7" where only the number is said."""
    name, number = attributes.get("name"), attributes.get("semantic_label")
    if isinstance(name, str) and name and not name.endswith(")"):
        return name
    known = isinstance(number, int) and 0 < number < _NO_LABEL
    return labels.get(number, f"class {number}") if known and isinstance(number, int) else None


def _points(attributes: Mapping[str, Any], mesh: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    rows = attributes.get("mesh_connections")
    if mesh is None or not isinstance(rows, list):
        return None
    known = [r for r in rows if isinstance(r, int) and 0 <= r < len(mesh)]
    return mesh[known] if len(known) >= _LEAST_POINTS else None


def _box(box: object, where: str) -> OrientedBox | None:
    """Return the bounding box, None for one that the graph calls invalid. Raises `SourceError`."""
    if not isinstance(box, dict) or box.get("type") in (None, "INVALID"):
        return None
    center = vector(box.get("world_P_center"), f"{where}: world_P_center")
    if "dimensions" in box:
        size = vector(box["dimensions"], f"{where}: dimensions")
    else:
        low, high = (vector(box.get(k), f"{where}: {k}") for k in ("min", "max"))
        size = high - low
    turn = box.get("world_R_center")
    rotation = np.eye(3)
    if box["type"] != "AABB" and isinstance(turn, dict):
        try:
            rotation = Rotation.from_quat([float(turn[k]) for k in "xyzw"]).as_matrix()
        except (KeyError, TypeError, ValueError):
            raise SourceError(f"{where}: world_R_center is not a rotation; fix or remove it") from None
    return OrientedBox(center, np.maximum(np.abs(size), 0.01), rotation)


def symbol(number: object) -> str:
    """Return a node's name as spark-dsg shows it: O(12) for a category in the upper byte and an index."""
    if not isinstance(number, int) or not 0 <= number < 2**64:
        return str(number)
    category = chr(number >> 56)
    return f"{category}({number & (2**56 - 1)})" if category.isalpha() and category.isascii() else str(number)
