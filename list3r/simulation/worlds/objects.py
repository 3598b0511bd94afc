"""Objects made of boxes, cylinders and spheres, and all solids of a world as arrays for the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import OrientedBox
from list3r.simulation.worlds.materials import Material

BOX, CYLINDER, SPHERE = 0, 1, 2
Array = NDArray[np.float64]
Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """One solid, upright, in the frame of its object: origin in the middle of the base, z up, front towards +y."""

    kind: int
    """BOX, CYLINDER (axis z) or SPHERE."""
    center: Vec3
    """Metres, object frame."""
    half: Vec3
    """Half extents, metres; the first two equal for a cylinder, all three for a sphere."""
    material: Material
    yaw: float = 0.0
    """Turn about z within the object, radians."""
    open_top: bool = False
    """A cylinder without its upper cap, or a sphere without its upper half: thin shells with a visible inside."""

    def extent(self) -> tuple[Array, Array]:
        """Lower and upper corner in the object frame. Two of shape (3,)."""
        hx, hy, hz = self.half
        if self.kind == BOX:
            c, s = abs(np.cos(self.yaw)), abs(np.sin(self.yaw))
            hx, hy = c * hx + s * hy, s * hx + c * hy
        center, reach = np.array(self.center), np.array([hx, hy, hz])
        top = center + reach
        if self.kind == SPHERE and self.open_top:
            top[2] = center[2]
        return center - reach, top


@dataclass(frozen=True)
class SimulatedObject:
    """One physical object with its ground truth."""

    id: int
    label: str
    parts: tuple[Part, ...]
    position: Vec3
    """The middle of the base in the world, metres."""
    yaw: float = 0.0
    """Turn about the world's z, radians."""
    support: int | None = None
    """Id of the object it rests on."""
    container: int | None = None
    """Id of the object it is in."""
    attached: int | None = None
    """Id of the wall it hangs on."""
    structure: str | None = None
    """floor, wall or ceiling where it bounds the room."""

    def is_round(self) -> bool:
        """Return whether it is rotationally symmetric, so that the yaw of its box is arbitrary."""
        return all(part.kind != BOX and part.center[:2] == (0, 0) for part in self.parts)

    def rotation(self) -> Array:
        """R_world_object. Shape (3, 3)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def box(self) -> OrientedBox:
        """Return the upright box of all its parts in the world."""
        extents = [part.extent() for part in self.parts]
        low, high = np.min([e[0] for e in extents], axis=0), np.max([e[1] for e in extents], axis=0)
        rotation = self.rotation()
        return OrientedBox(np.array(self.position) + rotation @ ((low + high) / 2), high - low, rotation)


@dataclass(frozen=True)
class MovingObject:
    """An object with a pose of its own in every frame."""

    obj: SimulatedObject
    """At the origin."""
    T_world_object: Array
    """Upright poses. Shape (F, 4, 4)."""


@dataclass(frozen=True)
class Solids:
    """All solids of a world, N of them."""

    kind: NDArray[np.int64]
    """Shape (N,)."""
    center: Array
    """World, metres. Shape (N, 3)."""
    half: Array
    """Half extents, metres. Shape (N, 3)."""
    yaw: Array
    """Turn about the world's z, radians. Shape (N,)."""
    open_top: NDArray[np.bool_]
    """Shape (N,)."""
    material: NDArray[np.int64]
    """Index into `materials`. Shape (N,)."""
    object_id: NDArray[np.int64]
    """Id of the object. Shape (N,)."""
    materials: tuple[Material, ...]

    def corners(self) -> Array:
        """Corners of the solids' own boxes in the world. Shape (N, 8, 3)."""
        signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
        local = signs[None] * self.half[:, None, :]
        c, s = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        turned = np.stack(
            [c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1], local[..., 2]], -1
        )
        return np.asarray(turned + self.center[:, None, :])


def stack_solids(objects: Sequence[SimulatedObject]) -> Solids:
    """Return the parts of all objects in the world frame."""
    pairs = [(obj, part) for obj in objects for part in obj.parts]
    materials = tuple(dict.fromkeys(part.material for _, part in pairs))
    index = {material: k for k, material in enumerate(materials)}
    return Solids(
        kind=np.array([p.kind for _, p in pairs]),
        center=np.array([np.array(t.position) + t.rotation() @ np.array(p.center) for t, p in pairs]),
        half=np.array([p.half for _, p in pairs], dtype=np.float64),
        yaw=np.array([t.yaw + p.yaw for t, p in pairs]),
        open_top=np.array([p.open_top for _, p in pairs]),
        material=np.array([index[p.material] for _, p in pairs]),
        object_id=np.array([t.id for t, _ in pairs]),
        materials=materials,
    )
