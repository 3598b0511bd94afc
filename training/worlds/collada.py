"""Meshes with textures out of COLLADA files, as far as exporters of game furniture use the format."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_NS = {"c": "http://www.collada.org/2005/11/COLLADASchema"}


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with texture coordinates."""

    vertices: NDArray[np.float64]
    """Metres, z up. Shape (V, 3)."""
    triangles: NDArray[np.int64]
    """Shape (T, 3)."""
    uv: NDArray[np.float32]
    """Texture coordinates of the corners of each triangle, v up. Shape (T, 3, 2)."""
    image: Path | None
    """Picture of the texture, None where there is none."""
    color: tuple[float, float, float] = (150.0, 150.0, 150.0)
    """RGB in [0, 255] where there is no picture."""


def read_collada(path: Path) -> list[TexturedMesh]:
    """Return the meshes of a file, one for each material, in metres."""
    root = ET.parse(path).getroot()
    unit = root.find("c:asset/c:unit", _NS)
    scale = float(unit.get("meter", "1")) if unit is not None else 1.0
    images = _images(root, path)
    out = []
    for scene in root.iterfind(".//c:visual_scene", _NS):
        for node, T in _nodes(root, scene, np.eye(4)):
            for instance in node.iterfind("c:instance_geometry", _NS):
                uses = instance.iterfind(".//c:instance_material", _NS)
                bound = {m.get("symbol"): (m.get("target") or "")[1:] for m in uses}
                mesh = root.find(f".//c:geometry[@id='{(instance.get('url') or '')[1:]}']/c:mesh", _NS)
                for group in list(mesh) if mesh is not None else []:
                    if mesh is not None and group.tag.rpartition("}")[2] in ("triangles", "polylist"):
                        out.append(_group(mesh, group, T, scale, images.get(bound.get(group.get("material"), ""))))
    return out


def _nodes(
    root: ET.Element, parent: ET.Element, T: NDArray[np.float64]
) -> Iterator[tuple[ET.Element, NDArray[np.float64]]]:
    """Yield the nodes below one with their poses, those that instances name among them."""
    for node in parent.iterfind("c:node", _NS):
        matrix = node.find("c:matrix", _NS)
        own = np.array(matrix.text.split(), float).reshape(4, 4) if matrix is not None and matrix.text else np.eye(4)
        if not np.isfinite(own).all():
            continue
        yield node, T @ own
        yield from _nodes(root, node, T @ own)
        for instance in node.iterfind("c:instance_node", _NS):
            named = root.find(f".//c:library_nodes//c:node[@id='{(instance.get('url') or '')[1:]}']", _NS)
            if named is not None:
                holder = ET.Element("holder")
                holder.append(named)
                yield from _nodes(root, holder, T @ own)


def _images(root: ET.Element, path: Path) -> dict[str, Path]:
    """The picture of each material, by its id."""
    files = {
        i.get("id"): (i.findtext("c:init_from", "", _NS)).strip()
        for i in root.iterfind(".//c:library_images/c:image", _NS)
    }
    out = {}
    for material in root.iterfind(".//c:material", _NS):
        effect = material.find("c:instance_effect", _NS)
        name = (effect.get("url") or "")[1:] if effect is not None else ""
        texture = root.find(f".//c:effect[@id='{name}']//c:diffuse/c:texture", _NS)
        file = files.get(texture.get("texture")) if texture is not None else None
        if file:
            out[str(material.get("id"))] = (path.parent / file.replace("file://", "")).resolve()
    return out


def _group(
    mesh: ET.Element, group: ET.Element, T: NDArray[np.float64], scale: float, image: Path | None
) -> TexturedMesh:
    inputs = [
        (i.get("semantic"), int(i.get("offset", "0")), (i.get("source") or "")[1:])
        for i in group.iterfind("c:input", _NS)
    ]
    width = max(offset for _, offset, _ in inputs) + 1
    rows = np.array((group.findtext("c:p", "", _NS)).split(), np.int64).reshape(-1, width)
    counts = group.findtext("c:vcount", "", _NS).split()
    sizes = np.array(counts, np.int64) if counts else np.full(len(rows) // 3, 3)
    corners = _fans(sizes)
    vertex = next(offset for semantic, offset, _ in inputs if semantic == "VERTEX")
    source = next((s for semantic, _, s in inputs if semantic == "VERTEX"), "")
    place = mesh.find(f"c:vertices[@id='{source}']/c:input[@semantic='POSITION']", _NS)
    points = _floats(mesh, (place.get("source") or "")[1:] if place is not None else "")[:, :3]
    points = (points @ T[:3, :3].T + T[:3, 3]) * scale
    uv = np.zeros((len(corners), 3, 2), np.float32)
    textures = [(offset, s) for semantic, offset, s in inputs if semantic == "TEXCOORD"]
    if textures:
        uv = _floats(mesh, textures[0][1])[:, :2].astype(np.float32)[rows[corners, textures[0][0]]]
    return TexturedMesh(points, rows[corners, vertex], uv, image)


def _fans(sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the corners of triangles that polygons of these sizes are cut into. Shape (T, 3)."""
    starts = np.cumsum(sizes) - sizes
    out = []
    for k in range(1, int(sizes.max(initial=2)) - 1):
        mine = starts[sizes > k + 1]
        out.append(np.stack([mine, mine + k, mine + k + 1], 1))
    return np.concatenate(out) if out else np.zeros((0, 3), np.int64)


def _floats(mesh: ET.Element, name: str) -> NDArray[np.float64]:
    source = mesh.find(f"c:source[@id='{name}']", _NS)
    assert source is not None, f"no source {name}"
    accessor = source.find(".//c:accessor", _NS)
    stride = int(accessor.get("stride", "1")) if accessor is not None else 3
    return np.array(source.findtext("c:float_array", "", _NS).split(), float).reshape(-1, stride)
