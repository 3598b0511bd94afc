"""Choose how the world lies on the page of a plan view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.exporters.components import Component, has_box
from list3r.memory.records import Instance

Array = NDArray[np.float64]

VERTICAL_KINDS = ("wall",)
FLAT_KINDS = ("floor", "ceiling")


@dataclass(frozen=True)
class PlanFrame:
    """An orthographic view from above."""

    R_plan_world: Array
    """Rows: the page's right, the page's up, towards the reader. Shape (3, 3)."""
    center: Array
    """Plan coordinates of the middle of the map, world units. Shape (2,)."""
    pixels_per_unit: float
    size_px: tuple[int, int]
    """(width, height) of the map."""
    note: str
    """What is up in the picture."""

    def reduced(self, times: int) -> PlanFrame:
        """Return the same view in this many times fewer pixels each way."""
        width, height = self.size_px
        return replace(self, pixels_per_unit=self.pixels_per_unit / times, size_px=(width // times, height // times))

    def to_px(self, points_world: ArrayLike) -> Array:
        """Return the pixel positions (x right, y down) of world points. Shape (N, 3) -> (N, 2)."""
        xy = np.asarray(points_world, dtype=np.float64) @ self.R_plan_world[:2].T - self.center
        half = np.array(self.size_px) / 2.0
        return np.asarray(half + xy * self.pixels_per_unit * [1.0, -1.0])

    def height(self, points_world: ArrayLike) -> Array:
        """Return the height above the page, world units. Shape (N, 3) -> (N,)."""
        return np.asarray(np.asarray(points_world, dtype=np.float64) @ self.R_plan_world[2])


def choose_rotation(component: Component, gravity: str) -> tuple[Array, str]:
    """Return R_plan_world that looks down and has the walls along the page, and what it took for up, in words."""
    up, note = _up(component, gravity)
    right = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(up, right), up])
    angle = _dominant_angle(component, rotation)
    c, s = np.cos(-angle), np.sin(-angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation, note


def quarter_turn(rotation: Array) -> Array:
    """Return the same view with the page turned by a quarter. Shape (3, 3)."""
    return np.stack([rotation[1], -rotation[0], rotation[2]])


def _up(component: Component, gravity: str) -> tuple[Array, str]:
    """Return the vertical: world z, or without gravity the normal of the plane in which the camera moved."""
    if gravity != "unknown":
        return np.array([0.0, 0.0, 1.0]), f"seen from above: z is up (gravity {gravity})"
    if len(component.poses) < 3:
        return np.array([0.0, 0.0, 1.0]), "gravity unknown: seen along z"
    centers = np.stack([S_world_cam.translation for _, S_world_cam in component.poses])
    camera_up = -np.mean([S_world_cam.rotation[:, 1] for _, S_world_cam in component.poses], axis=0)
    _, spread, axes = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    if spread[1] < 0.05 * spread[0] or not spread[0] > 0:
        length = float(np.linalg.norm(camera_up))
        up = camera_up / length if length > 0.1 else np.array([0.0, 0.0, 1.0])
        return up, "gravity unknown: seen along the cameras' mean up"
    normal = axes[2] * (np.sign(axes[2] @ camera_up) or 1.0)
    return np.asarray(normal), "gravity unknown: seen along the normal of the plane in which the camera moved"


def _dominant_angle(component: Component, rotation: Array) -> float:
    """Return the direction in [-45, 45] degrees, as radians, of most wall and box sides on the page."""
    boxed = [i for i in component.instances if has_box(i)]
    chosen = [i for i in boxed if is_wall(i, rotation[2])] or [i for i in boxed if not i.structure]
    total = 0j
    for instance in chosen:
        axes = (instance.box.rotation * instance.box.size).T @ rotation[:2].T
        k = int(np.argmax(np.linalg.norm(axes, axis=1)))
        total += float(np.linalg.norm(axes[k])) * np.exp(4j * np.arctan2(axes[k, 1], axes[k, 0]))
    return float(np.angle(total) / 4) if abs(total) > 0 else 0.0


def is_wall(instance: Instance, up: Array) -> bool:
    """Tell whether an instance is structure that stands upright, by its kind or else by the thin side of its box."""
    if not instance.structure or instance.structure in FLAT_KINDS or not has_box(instance):
        return False
    thin = instance.box.rotation[:, int(np.argmin(instance.box.size))]
    return instance.structure in VERTICAL_KINDS or abs(float(thin @ up)) < 0.5
