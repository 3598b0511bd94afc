"""Write surfaces and boxes as binary glTF, for any 3D viewer."""

# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from list3r.exporters.components import Component, component_files, has_box, thinned_support
from list3r.exporters.output import units, write_together
from list3r.exporters.palette import Color, instance_color, linear_from_srgb, structure_color
from list3r.memory.core.errors import check_choice
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.views.dense import fused_surfaces
from list3r.queries.views.depth_frames import REST
from list3r.queries.views.fused import Surface

T_GLTF_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""glTF has y up: its x, y, z are the world's x, z, -y."""

_ARRAY_BUFFER, _TRIANGLES = 34962, 4
"""Buffer targets of vertex attributes and the mode of triangles, by the numbers of OpenGL."""
_UNLIT = "KHR_materials_unlit"
_EDGES = ((0, 1), (0, 2), (0, 4), (3, 1), (3, 2), (3, 7), (5, 1), (5, 4), (5, 7), (6, 2), (6, 4), (6, 7))
"""Pairs of `OrientedBox.corners` that differ along one axis."""


@dataclass(frozen=True)
class GlbSettings:
    """Content of the file."""

    color: str = "rgb"
    """Of surfaces. rgb: the colours that were seen; instance: one colour an instance, the same in every export."""
    points_per_instance: int = 5000
    """At most this many points of an instance that has no triangles."""
    points_per_structure: int = 20000
    """At most this many points of a floor, a wall and the like."""

    def __post_init__(self) -> None:
        check_choice("color", self.color, ("instance", "rgb"))


def write_glb(store: Store, path: str | Path, settings: GlbSettings | None = None) -> tuple[Path, ...]:
    """Write node `instance_12 mug` with its children `instance_12_mesh`, or `instance_12_points` where there are no
    triangles, and, for instances, `instance_12_box` (lines); `rest_mesh` is what is of no instance.

    The node `world` above them turns z up into the y up of glTF. Facts of an instance are the `extras` of its geometry.
    Each component is a file of its own, the main one at `path`. Returns the files written.
    """
    chosen = settings or GlbSettings()

    def write(component: Component, to: Path) -> None:
        to.write_bytes(_glb(store, component, chosen))

    return write_together(component_files(store, path), write)


def _glb(store: Store, component: Component, settings: GlbSettings) -> bytes:
    scene = trimesh.Scene(base_frame="scene")
    scene.graph.update("world", "scene", matrix=T_GLTF_WORLD)
    scene.metadata |= {
        "list3r_units": units(store),
        "list3r_metric": store.facts.scale_kind or "relative",
        "list3r_gravity": store.facts.gravity,
        "list3r_component": component.id,
    }
    fused = fused_surfaces(store, component.id)
    for instance in component.instances:
        limit = settings.points_per_structure if instance.structure else settings.points_per_instance
        name = f"instance_{instance.id}"
        node = f"{name} {instance.label or instance.structure or instance.description.split(',')[0]}".strip()
        scene.graph.update(node, "world")
        surface, kind = fused.get(instance.id), "mesh"
        if surface is None:
            support, kind = thinned_support(store, instance, limit), "points"
            surface = Surface.of_points(support.points, support.rgb)
        if len(surface.vertices):
            rgb = surface.rgb if settings.color == "rgb" else np.tile(_color(instance), (len(surface.rgb), 1))
            _add(scene, _drawn(surface, rgb), f"{name}_{kind}", node, instance)
        if has_box(instance) and not instance.structure:
            _add(scene, _wire_box(instance), f"{name}_box", node, instance)
    if REST in fused:
        rest = fused[REST]
        scene.add_geometry(_drawn(rest, rest.rgb), "rest_mesh", "rest_mesh", parent_node_name="world")
    if not scene.geometry:  # trimesh writes no glTF without any: one invisible point at the origin
        nothing = trimesh.PointCloud(np.zeros((1, 3)), colors=np.zeros((1, 4), np.uint8))
        scene.add_geometry(nothing, node_name="empty", geom_name="empty")
    return bytes(scene.export(file_type="glb", unitize_normals=False, tree_postprocessor=_finish))


def surface_glb(vertices: NDArray[np.float32], faces: NDArray[np.int32], rgb: NDArray[np.uint8]) -> bytes:
    """Return triangles alone, in coordinates as they are. Shapes (V, 3), (F, 3), (V, 3)."""
    scene = trimesh.Scene(_drawn(Surface(vertices, faces, rgb), rgb))
    return bytes(scene.export(file_type="glb", unitize_normals=False, tree_postprocessor=_finish))


def _finish(tree: dict[str, Any]) -> None:
    """Set the target of attribute views, which glTF validators ask for and trimesh leaves out; triangles show their
    colours as they are, since these hold the light of the room.
    """
    parts = [part for mesh in tree["meshes"] for part in mesh["primitives"]]
    for view in {tree["accessors"][n]["bufferView"] for part in parts for n in part["attributes"].values()}:
        tree["bufferViews"][view]["target"] = _ARRAY_BUFFER
    sheets = [part for part in parts if part.get("mode", _TRIANGLES) == _TRIANGLES]
    if sheets:
        seen = {"name": "seen", "pbrMetallicRoughness": {"metallicFactor": 0.0}, "extensions": {_UNLIT: {}}}
        tree["materials"] = [*tree.get("materials", []), seen]
        tree["extensionsUsed"] = [*tree.get("extensionsUsed", []), _UNLIT]
    for part in sheets:
        part["material"] = len(tree["materials"]) - 1


def _drawn(surface: Surface, rgb: NDArray[np.uint8]) -> Any:
    linear = np.round(255 * linear_from_srgb(rgb)).astype(np.uint8)
    rgba = np.hstack([linear, np.full((len(linear), 1), 255, np.uint8)])
    if not len(surface.faces):
        return trimesh.PointCloud(surface.vertices, colors=rgba)
    return trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=rgba, process=False)


def _add(scene: trimesh.Scene, geometry: Any, name: str, parent: str, instance: Instance) -> None:
    geometry.metadata |= {
        "id": instance.id,
        "label": instance.label or "",
        "description": instance.description,
        "confidence": round(float(instance.confidence), 4),
        "state": instance.state,
        "structure": instance.structure or "",
    }
    scene.add_geometry(geometry, node_name=name, geom_name=name, parent_node_name=parent)


def _wire_box(instance: Instance) -> trimesh.path.Path3D:
    entities = [trimesh.path.entities.Line(np.array(edge)) for edge in _EDGES]
    rgba: NDArray[np.uint8] = np.append(np.round(255 * linear_from_srgb(_color(instance))), 255).astype(np.uint8)
    return trimesh.path.Path3D(
        entities=entities, vertices=instance.box.corners(), colors=np.tile(rgba, (len(entities), 1)), process=False
    )


def _color(instance: Instance) -> Color:
    return (structure_color if instance.structure else instance_color)(instance.id)
