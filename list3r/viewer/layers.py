"""The 3D scene of all pages: boxes, path, and lines of the selected instance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from list3r.exporters.glb import surface_glb
from list3r.memory.core.geometry import OrientedBox, quat_wxyz_from_rotation
from list3r.memory.core.records import Relation
from list3r.viewer.clouds import FINE
from list3r.viewer.world import CHANGE_COLORS, CameraPath, ShownWorld, colors, point_size, sheet_colors

_INK = (255, 200, 0)
_BEFORE = 0.002
"""The selected surface is drawn so far before itself."""
_MEASURED = (230, 40, 90)
_EDGES = np.array([(a, a ^ bit) for a in range(8) for bit in (1, 2, 4) if a < a ^ bit])
"""Pairs of corners of `OrientedBox.corners` that an edge joins."""


@dataclass(frozen=True)
class LayerSettings:
    """How much is drawn."""

    selected_points: int = 100_000
    """Points of the selected instance that are tinted, at most."""
    frustums: int = 40


class Layers:
    """The scene of one server; every layer is drawn again when its content changes."""

    def __init__(self, server: viser.ViserServer, settings: LayerSettings) -> None:
        self._scene, self._settings = server.scene, settings
        self._nodes: dict[str, list[Any]] = {}

    def clear(self, layer: str) -> None:
        """Take a layer away."""
        for node in self._nodes.pop(layer, []):
            node.remove()

    def highlight(self, world: ShownWorld, mode: str, selected: int | None, *, visible: bool) -> None:
        """Draw the selected instance once more, tinted and larger, so that the others can stay, and its box."""
        self.clear("selected")
        if selected is None:
            return
        nodes = [self._boxes(f"{FINE}/box", [world.instances[selected].box], [_INK])]
        cloud = world.cloud.of(selected, self._settings.selected_points)
        if visible and selected in world.sheets:
            nodes.append(self._scene.add_glb(f"{FINE}/selected", _tinted(world, mode, selected)))
        elif visible and len(cloud.points):
            middle = cloud.points.mean(axis=0)
            size = 1.5 * float(point_size(cloud.spacing[cloud.counts > 0], world.unit)[0])
            nodes.append(
                self._scene.add_point_cloud(
                    f"{FINE}/selected", cloud.points - middle, colors(world, cloud, mode, selected), point_size=size,
                    point_shape="circle", point_shading="flat", position=middle.astype(np.float64),
                )
            )  # fmt: skip
        self._nodes["selected"] = nodes

    def _boxes(self, name: str, boxes: Sequence[OrientedBox], ink: Sequence[tuple[int, int, int]]) -> Any:
        lines = np.array([b.corners() for b in boxes], np.float32)[:, _EDGES].reshape(-1, 2, 3)
        shades = np.repeat(np.array(ink, np.uint8), len(_EDGES), axis=0)
        ends = np.stack([shades, shades], axis=1)
        return self._scene.add_line_segments(name, lines, ends, thickness=2.0, thickness_units="screen")

    def path(self, path: CameraPath, session: int | None, *, visible: bool, unit: float) -> None:
        """Draw the camera's path, through gaps broken, with frustums."""
        self.clear("path")
        keep = np.ones(len(path.session), bool) if session is None else path.session <= session
        place, rotation, number = path.position[keep], path.rotation[keep], path.session[keep]
        if not visible or len(place) < 2:
            return
        lines = np.stack([place[:-1], place[1:]], axis=1)
        joined = (number[:-1] == number[1:]) & (np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) < 1.0 * unit)
        nodes: list[Any] = [
            self._scene.add_line_segments(
                "/path/line", lines[joined].astype(np.float32), (60, 120, 220), thickness=2.0, thickness_units="screen"
            )
        ]
        for k in range(0, len(place), max(1, len(place) // self._settings.frustums)):
            nodes.append(
                self._scene.add_camera_frustum(
                    f"/path/{k}", fov=0.8, aspect=4 / 3, scale=0.08 * unit, color=(60, 120, 220),
                    wxyz=quat_wxyz_from_rotation(rotation[k]), position=place[k],
                )
            )  # fmt: skip
        self._nodes["path"] = nodes

    def camera(
        self, path: CameraPath, k: int, rgb: NDArray[np.uint8] | None, intrinsics: tuple[float, ...], unit: float
    ) -> None:
        """Draw the camera of one frame, with its picture where that is stored. `intrinsics`: fy, width, height."""
        self.clear("camera")
        fy, width, height = intrinsics
        self._nodes["camera"] = [
            self._scene.add_camera_frustum(
                "/camera", fov=2 * float(np.arctan2(height / 2, fy)), aspect=width / height, scale=0.25 * unit,
                color=_INK, image=rgb, wxyz=quat_wxyz_from_rotation(path.rotation[k]), position=path.position[k],
            )
        ]  # fmt: skip

    def relations(self, world: ShownWorld, selected: int, relations: Sequence[Relation]) -> None:
        """Draw lines from the selected instance to related ones, with their predicates."""
        self.clear("relations")
        start = world.instances[selected].center
        words: dict[int, list[str]] = {}
        for r in relations:
            if r.subject == selected and r.object in world.instances:
                words.setdefault(r.object, []).append(r.predicate.replace("_", " "))
        if not words:
            return
        ends = np.array([[start, world.instances[n].center] for n in words], np.float32)
        nodes: list[Any] = [
            self._scene.add_line_segments("/relations/lines", ends, _INK, thickness=2.0, thickness_units="screen")
        ]
        for n, label in words.items():
            middle = 0.35 * start + 0.65 * world.instances[n].center
            text = f"{', '.join(label)} {n}"
            nodes.append(self._scene.add_label(f"/relations/{n}", text, position=middle, font_screen_scale=0.7))
        self._nodes["relations"] = nodes

    def changes(self, world: ShownWorld, *, visible: bool) -> None:
        """Draw where instances were before: arrows of moved ones, boxes of removed ones."""
        self.clear("changes")
        if not visible:
            return
        nodes: list[Any] = []
        moved = [c for c in world.changes.values() if c.event.kind == "moved" and c.event.from_box and c.event.to_box]
        ways = [(c.event.from_box.center, c.event.to_box.center) for c in moved if c.event.from_box and c.event.to_box]
        if ways:
            unit = world.unit
            nodes.append(
                self._scene.add_arrows(
                    "/changes/moved", np.array(ways, np.float32), CHANGE_COLORS["moved"], shaft_radius=0.01 * unit,
                    head_radius=0.03 * unit, head_length=0.06 * unit,
                )
            )  # fmt: skip
        before = [(c.event.from_box, CHANGE_COLORS[c.event.kind]) for c in world.changes.values() if c.event.from_box]
        if before:
            boxes, ink = [b for b, _ in before if b is not None], [color for _, color in before]
            nodes.append(self._boxes("/changes/before", boxes, ink))
        self._nodes["changes"] = nodes

    def measured(self, ends: Sequence[NDArray[np.float64]], text: str) -> None:
        """Draw a measured line between two places, or a mark at the first of them."""
        self.clear("measured")
        if len(ends) == 2:
            line = np.array([ends], np.float32)
            self._nodes["measured"] = [
                self._scene.add_line_segments("/measured/line", line, _MEASURED, thickness=3, thickness_units="screen"),
                self._scene.add_label("/measured/text", text, position=(ends[0] + ends[1]) / 2),
            ]
        elif ends:
            self._nodes["measured"] = [self._scene.add_label("/measured/text", text, position=ends[0])]


def _tinted(world: ShownWorld, mode: str, selected: int) -> bytes:
    """Return the triangles of an instance, tinted, a little before themselves."""
    sheet = world.sheets[selected]
    ink = np.round(0.5 * sheet_colors(world, selected, mode) + 0.5 * np.array(_INK)).astype(np.uint8)
    raised = sheet.vertices + _BEFORE * world.unit * sheet.normals()
    return surface_glb(raised.astype(np.float32), sheet.faces, ink)
