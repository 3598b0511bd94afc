"""Choose how the world is turned on the page of a plan view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.exporters.components import Component, has_box
from list3r.memory.core.records import Instance, Support

Array = NDArray[np.float64]
FLAT_KINDS = ("floor", "ceiling")


@dataclass(frozen=True)
class PlanView:
    """An orthographic view from above."""

    R_plan_world: Array
    """Rows: the page's right, the page's up, towards the reader. Shape (3, 3)."""
    low: Array
    """Lower left corner of the map, plan coordinates, world units. Shape (2,)."""
    high: Array
    """Upper right corner. Shape (2,)."""
    note: str
    """The up direction of the picture."""

    def on_page(self, points_world: ArrayLike) -> Array:
        """Return plan coordinates of world points. Shape (..., 3) -> (..., 2)."""
        return np.asarray(np.asarray(points_world, np.float64) @ self.R_plan_world[:2].T)

    def height(self, points_world: ArrayLike) -> Array:
        """Return the height above the page, world units. Shape (..., 3) -> (...)."""
        return np.asarray(np.asarray(points_world, np.float64) @ self.R_plan_world[2])

    @property
    def shows_world_axes(self) -> bool:
        """Whether the page is a plane of world x and y, so that it can be marked with their values."""
        return bool(self.R_plan_world[2, 2] > 1 - 1e-9)


def choose_view(component: Component, supports: dict[int, Support], gravity: str) -> PlanView:
    """Look down, with the walls along the page, everything inside, and the longer side across."""
    rotation, note = choose_rotation(component, gravity)
    low, high = _extent(component, supports, rotation)
    if high[1] - low[1] > high[0] - low[0]:
        rotation = np.stack([rotation[1], -rotation[0], rotation[2]])
        low, high = _extent(component, supports, rotation)
    margin = 0.03 * np.maximum(high - low, 1e-6).max()
    return PlanView(rotation, low - margin, high + margin, note)


def choose_rotation(component: Component, gravity: str) -> tuple[Array, str]:
    """Return R_plan_world that looks down and has the walls along the page, and the chosen up direction in words."""
    up, note = _up(component, gravity)
    right = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(up, right), up])
    angle = _dominant_angle(component, rotation)
    c, s = np.cos(-angle), np.sin(-angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation, note


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
    """Return whether an instance is upright structure, by its kind or else by the thin side of its box."""
    if not instance.structure or instance.structure in FLAT_KINDS or not has_box(instance):
        return False
    thin = instance.box.rotation[:, int(np.argmin(instance.box.size))]
    return instance.structure == "wall" or abs(float(thin @ up)) < 0.5


def _extent(component: Component, supports: dict[int, Support], rotation: Array) -> tuple[Array, Array]:
    """Return lower and upper corner, plan coordinates, of boxes of instances, camera, and structure but its fringe."""
    page = rotation[:2].T
    parts = [i.box.corners() @ page for i in component.instances if not i.structure and has_box(i)]
    parts += [S_world_cam.translation[None] @ page for _, S_world_cam in component.poses]
    for i in component.instances:
        if i.structure and len(supports[i.id].points):
            parts.append(np.quantile(supports[i.id].points @ page, [0.01, 0.99], axis=0))
    flat = np.concatenate(parts) if parts else np.array([[-1.0, -1.0], [1.0, 1.0]])
    return flat.min(axis=0), flat.max(axis=0)
