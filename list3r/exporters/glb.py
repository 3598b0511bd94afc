"""Write boxes and points as binary glTF, for any 3D viewer."""

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

T_GLTF_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""glTF has y up: its x, y, z are the world's x, z, -y."""

_ARRAY_BUFFER = 34962
"""Buffer targets of vertex attributes, by the numbers of OpenGL."""
_EDGES = ((0, 1), (0, 2), (0, 4), (3, 1), (3, 2), (3, 7), (5, 1), (5, 4), (5, 7), (6, 2), (6, 4), (6, 7))
"""Pairs of `OrientedBox.corners` that differ along one axis."""


@dataclass(frozen=True)
class GlbSettings:
    """Content of the file."""

    color: str = "rgb"
    """Of the points. rgb: the colours that were seen; instance: one colour an instance, the same in every export."""
    points_per_instance: int = 5000
    """At most this many points of an instance."""
    points_per_structure: int = 20000
    """At most this many points of a floor, a wall and the like."""

    def __post_init__(self) -> None:
        check_choice("color", self.color, ("instance", "rgb"))


def write_glb(store: Store, path: str | Path, settings: GlbSettings | None = None) -> tuple[Path, ...]:
    """Write node `instance_12 mug` with its children `instance_12_points` and, for instances, `instance_12_box`
    (lines).

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
    for instance in component.instances:
        limit = settings.points_per_structure if instance.structure else settings.points_per_instance
        name = f"instance_{instance.id}"
        node = f"{name} {instance.label or instance.structure or instance.description.split(',')[0]}".strip()
        scene.graph.update(node, "world")
        support = thinned_support(store, instance, limit)
        if len(support.points):
            rgb = support.rgb if settings.color == "rgb" else np.tile(_color(instance), (len(support.points), 1))
            linear = np.round(255 * linear_from_srgb(rgb)).astype(np.uint8)
            alpha = np.full((len(linear), 1), 255, np.uint8)
            cloud = trimesh.PointCloud(support.points, colors=np.hstack([linear, alpha]))
            _add(scene, cloud, f"{name}_points", node, instance)
        if has_box(instance) and not instance.structure:
            _add(scene, _wire_box(instance), f"{name}_box", node, instance)
    if not scene.geometry:  # trimesh writes no glTF without any: one invisible point at the origin
        nothing = trimesh.PointCloud(np.zeros((1, 3)), colors=np.zeros((1, 4), np.uint8))
        scene.add_geometry(nothing, node_name="empty", geom_name="empty")
    return bytes(scene.export(file_type="glb", unitize_normals=False, tree_postprocessor=_say_what_buffers_hold))


def _say_what_buffers_hold(tree: dict[str, Any]) -> None:
    """Set the target of attribute views, which glTF validators ask for and trimesh leaves out."""
    used = {n for mesh in tree["meshes"] for part in mesh["primitives"] for n in part["attributes"].values()}
    for view in {tree["accessors"][n]["bufferView"] for n in used}:
        tree["bufferViews"][view]["target"] = _ARRAY_BUFFER


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
