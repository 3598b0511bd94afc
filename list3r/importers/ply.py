"""Read the vertices of a PLY file with all that is said of them, text or binary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import read_file
from list3r.importers.base import MOST_BYTES
from list3r.memory.core.errors import SourceError

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_MOST_HEADER = 65536


def read_vertices(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the properties of the vertices by name, each of shape (N,). Raises `SourceError`."""
    try:
        data = read_file(path, MOST_BYTES)
    except OSError as error:
        raise SourceError(f"{path} cannot be read ({error.strerror}); check the file") from None
    head, found, _ = data[:_MOST_HEADER].partition(b"end_header")
    if not data.startswith(b"ply") or not found:
        raise SourceError(f"{path} is not a PLY file; is the copy complete?")
    start = len(head) + len(found) + (2 if data[len(head) + len(found) :][:2] == b"\r\n" else 1)
    order, count, fields = _header(path, head.decode("ascii", "replace"))
    kind = np.dtype([(name, order + code) for name, code in fields])
    text = b"format ascii" in head
    if text:
        return _text_rows(path, data[start:], count, [name for name, _ in fields])
    if len(data) - start < count * kind.itemsize:
        raise SourceError(f"{path} ends before its {count} vertices; is the copy complete?")
    rows = np.frombuffer(data, kind, count, start)
    return {name: rows[name].astype(np.float64) for name, _ in fields}


def points_of(path: Path, rows: dict[str, NDArray[np.float64]]) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
    """Return places and colours of vertices. Shapes (N, 3). Raises `SourceError` where a file has no places."""
    if not {"x", "y", "z"} <= rows.keys():
        raise SourceError(f"{path} has no x, y, z; it is not a point cloud")
    points = np.stack([rows[k] for k in "xyz"], axis=1).astype(np.float32)
    names = next((n for n in (("red", "green", "blue"), ("r", "g", "b")) if set(n) <= rows.keys()), None)
    if names is None:
        return points, None
    return points, np.stack([np.clip(rows[k], 0, 255) for k in names], axis=1).astype(np.uint8)


def _header(path: Path, head: str) -> tuple[str, int, list[tuple[str, str]]]:
    order, count, fields, element = "", 0, list[tuple[str, str]](), ""
    for line in head.splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1], "")
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1] if not fields or words[1] == "vertex" else "later"
            count = int(words[2]) if words[1] == "vertex" and words[2].isdigit() else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise SourceError(f"{path}: its vertices have lists, which no point cloud has")
            fields.append((words[2], _TYPES[words[1]]))
    if not order or not fields or not 0 < count <= MOST_BYTES or len({n for n, _ in fields}) < len(fields):
        raise SourceError(f"{path}: its head states no vertices; is it a point cloud?")
    return order, count, fields


def _text_rows(path: Path, body: bytes, count: int, names: list[str]) -> dict[str, NDArray[np.float64]]:
    try:
        lines = body.split(b"\n", count)[:count]
        table = np.array([[float(v) for v in line.split()[: len(names)]] for line in lines])
    except ValueError:
        table = np.zeros((0, 0))
    if table.shape != (count, len(names)):
        raise SourceError(f"{path} ends before its {count} vertices, or has lines that are not numbers")
    return dict(zip(names, table.T, strict=True))
