"""All solids of a scene, fixed and moving, and where they can appear in a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.simulation.worlds.objects import SimulatedObject, stack_solids

Array = NDArray[np.float64]

NEAR_M = 0.05
_EDGES = np.array([[a, b] for a in range(8) for b in range(a) if (a ^ b) in (1, 2, 4)])


class SolidScene:
    """The solids of objects that are still and of objects that are put elsewhere from frame to frame."""

    def __init__(self, objects: Sequence[SimulatedObject], moving: Sequence[SimulatedObject] = ()) -> None:
        self.solids = stack_solids((*objects, *moving))
        self.corners = self.solids.corners()
        """World, metres. Shape (N, 8, 3)."""
        self._own = {t.id: (np.flatnonzero(self.solids.object_id == t.id), stack_solids([t])) for t in moving}

    def place(self, object_id: int, T_world_object: Array) -> None:
        """Put one of the moving objects somewhere, upright; it is made at the origin. `T_world_object` (4, 4)."""
        rows, home = self._own[object_id]
        rotation, position = T_world_object[:3, :3], T_world_object[:3, 3]
        self.solids.center[rows] = home.center @ rotation.T + position
        self.solids.yaw[rows] = home.yaw + np.arctan2(rotation[1, 0], rotation[0, 0])
        self.corners[rows] = home.corners() @ rotation.T + position


def screen_rectangles(corners: Array, T_world_cam: Array, camera: Camera) -> tuple[Array, NDArray[np.int64]]:
    """Least depth (N,) and pixel rectangle [left, right) x [top, bottom) (N, 4) of boxes with corners (N, 8, 3)."""
    local = (corners - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    a, b = local[:, _EDGES[:, 0]], local[:, _EDGES[:, 1]]
    za, zb = a[..., 2], b[..., 2]
    share = np.clip((NEAR_M - za) / np.where(np.abs(zb - za) < 1e-12, 1e-12, zb - za), 0, 1)
    cut = a + share[..., None] * (b - a)
    points = np.concatenate([local, cut], axis=1)
    ahead = points[..., 2] >= NEAR_M * (1 - 1e-6)
    z = np.where(ahead, points[..., 2], 1.0)
    px, py = camera.fx * points[..., 0] / z + camera.cx, camera.fy * points[..., 1] / z + camera.cy
    left, top = np.where(ahead, px, np.inf).min(axis=1), np.where(ahead, py, np.inf).min(axis=1)
    right, bottom = np.where(ahead, px, -np.inf).max(axis=1), np.where(ahead, py, -np.inf).max(axis=1)
    rects = np.stack([np.ceil(left), np.ceil(top), np.floor(right) + 1, np.floor(bottom) + 1], axis=1)
    size = np.array([camera.width, camera.height, camera.width, camera.height])
    return np.maximum(local[..., 2].min(axis=1), 0.0), np.clip(rects, 0, size).astype(np.int64)
