"""The names that one page shows: of the most seen instances, without overlaps."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from list3r.memory.core.geometry import rotation_from_quat_wxyz
from list3r.memory.core.records import Instance
from list3r.viewer.world import ShownWorld

Size = tuple[float, float]
_ABOVE = "/fine/labels"
"""Hidden with fine detail while the camera of a slow page moves."""
_LETTER_PX, _LINE_PX = 6.2, 15.0
"""A letter and a line of a label of scale 1 on the page."""


@dataclass(frozen=True)
class NameSettings:
    """How names are shown."""

    most: int = 60
    """Most seen instances, from which names without overlaps are chosen."""
    scale: float = 0.9
    selected_scale: float = 1.2


class PageNames:
    """The labels of one page, in its own part of the scene."""

    def __init__(self, client: viser.ClientHandle, settings: NameSettings) -> None:
        self._client, self._settings = client, settings
        self._lock = threading.RLock()
        self._labels: list[tuple[Any, NDArray[np.float64], Size]] = []
        """Nodes with their places in the world and their sizes in px, the most important first."""

    def draw(self, world: ShownWorld, selected: int | None, *, visible: bool) -> None:
        """Draw the names of a world; the selected one always."""
        with self._lock:
            for node, _, _ in self._labels:
                node.remove()
            self._labels = [
                self._label(i, world.name(i.id), selected) for i in self._chosen(world, selected, visible=visible)
            ]
            self.arrange()

    def arrange(self) -> None:
        """Show the labels that have room from where the camera is now."""
        with self._lock:
            if not self._labels:
                return
            camera = self._client.camera
            T_world_cam = np.eye(4)
            T_world_cam[:3, :3] = rotation_from_quat_wxyz(np.asarray(camera.wxyz, np.float64))
            T_world_cam[:3, 3] = camera.position
            places = np.array([place for _, place, _ in self._labels])
            at = on_page(places, T_world_cam, float(camera.fov), float(camera.image_height))
            kept = with_room(at, np.array([size for _, _, size in self._labels]))
            for (node, _, _), shown in zip(self._labels, kept.tolist(), strict=True):
                if node.visible != shown:
                    node.visible = shown

    def _label(self, i: Instance, name: str, selected: int | None) -> tuple[Any, NDArray[np.float64], Size]:
        text, place = f"{i.id} {name}", np.array([*i.center[:2], i.aabb[1, 2]])
        scale = self._settings.selected_scale if i.id == selected else self._settings.scale
        node = self._client.scene.add_label(
            f"{_ABOVE}/{i.id}", text, position=place, anchor="bottom-center", font_screen_scale=scale, visible=False
        )
        return node, place, (scale * _LETTER_PX * len(text), scale * _LINE_PX)

    def _chosen(self, world: ShownWorld, selected: int | None, *, visible: bool) -> Sequence[Instance]:
        objects = [i for i in world.instances.values() if i.structure is None and i.id != selected]
        seen_most = sorted(objects, key=lambda i: -i.observations)[: self._settings.most] if visible else []
        chosen = world.instances.get(selected) if selected is not None else None
        return seen_most if chosen is None else [chosen, *seen_most]


def on_page(
    points: NDArray[np.float64], T_world_cam: NDArray[np.float64], fov: float, height_px: float
) -> NDArray[np.float64]:
    """Return where points of the world are on a page, px from its middle; NaN for those behind the camera.

    `fov` is that of the height, in radians. Shape (N, 3) -> (N, 2).
    """
    local = (points - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    before = local[:, 2] > 1e-6
    px = 0.5 * height_px / np.tan(fov / 2) * local[:, :2] / np.where(before, local[:, 2], 1.0)[:, None]
    return np.asarray(np.where(before[:, None], px, np.nan))


def with_room(at: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which labels are shown: in order, each that covers no earlier one. The first always, if possible.

    `at` is the middle of the lower edge, `size` width and height, both px; y points down. Shapes (N, 2) -> (N,).
    """
    half = size / 2
    middle = at - [0.0, 1.0] * half
    kept = np.zeros(len(at), bool)
    for k in np.flatnonzero(np.isfinite(at).all(axis=1)):
        apart = np.abs(middle[kept] - middle[k]) >= half[kept] + half[k]
        kept[k] = apart.any(axis=1).all()
    return kept
