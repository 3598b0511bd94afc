"""Boxes as lines: thick ones where they are few, else lines of one pixel, which cost a tenth to draw."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import OrientedBox

MOST_THICK = 400
"""Without a graphics card this many take a tenth of a second to draw."""
_EDGES = np.array([(a, a ^ bit) for a in range(8) for bit in (1, 2, 4) if a < a ^ bit])
"""Pairs of corners of `OrientedBox.corners` that an edge joins."""
_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
"""glTF's numbers for the kinds of values."""


def box_lines(
    scene: Any, name: str, boxes: Sequence[OrientedBox], ink: Sequence[tuple[int, int, int]], *, thick: int = MOST_THICK
) -> Any:
    """Draw the edges of boxes, each in its colour; the node. More than `thick` of them have thin lines."""
    corners = np.array([b.corners() for b in boxes], np.float32)
    shades = np.array(ink, np.uint8)
    if len(boxes) > thick:
        return scene.add_glb(name, thin_lines(corners, shades), cast_shadow=False, receive_shadow=False)
    lines = corners[:, _EDGES].reshape(-1, 2, 3)
    ends = np.repeat(np.repeat(shades, len(_EDGES), axis=0)[:, None], 2, axis=1)
    return scene.add_line_segments(name, lines, ends, thickness=1.5, thickness_units="screen")


def thin_lines(corners: NDArray[np.float32], rgb: NDArray[np.uint8]) -> bytes:
    """Return the edges of boxes as binary glTF with lines of one pixel. Shapes (B, 8, 3), (B, 3)."""
    count = len(corners)
    points = corners.reshape(-1, 3).astype("<f4")
    colors = np.concatenate([np.repeat(rgb, 8, axis=0), np.full((8 * count, 1), 255, np.uint8)], axis=1)
    edges = (_EDGES.reshape(-1) + 8 * np.arange(count)[:, None]).astype("<u4").ravel()
    low, high = (points.min(axis=0), points.max(axis=0)) if count else (np.zeros(3), np.zeros(3))
    parts = [points.tobytes(), colors.tobytes(), edges.tobytes()]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    accessors: list[dict[str, Any]] = [
        {"type": "VEC3", "componentType": _FLOAT, "count": 8 * count, "min": low.tolist(), "max": high.tolist()},
        {"type": "VEC4", "componentType": _BYTE, "count": 8 * count, "normalized": True},
        {"type": "SCALAR", "componentType": _INDEX, "count": len(edges)},
    ]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "mode": 1}]}],
        "accessors": [{"bufferView": k, **a} for k, a in enumerate(accessors)],
        "bufferViews": [
            {"buffer": 0, "byteOffset": s, "byteLength": len(p)} for s, p in zip(starts, parts, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    text, data = json.dumps(document).encode(), b"".join(parts)
    text, data = text + b" " * (-len(text) % 4), data + b"\0" * (-len(data) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(data), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(data), 0x004E4942) + data
