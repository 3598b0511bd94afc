"""A room while it is furnished: who stands where, so that nothing passes through anything."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from training.worlds.draft import Draft
from training.worlds.materials import Material
from training.worlds.mesh import Mesh, box

CELL_M = 0.02
LAYERS_M = np.array([0.03, 0.2, 0.4, 0.6, 0.8, 1.1, 1.6, 2.1])
"""Heights that part the layers in which things may stand over one another: a chair under a table."""


@dataclass(frozen=True)
class Placed:
    """One thing of a world."""

    id: int
    """From 1; 0 is nothing."""
    kind: str
    label: str
    family: str
    parts: tuple[tuple[Mesh, Material], ...]
    T_world_thing: NDArray[np.float64]
    """Shape (4, 4)."""
    structure: bool = False

    def vertices(self) -> NDArray[np.float64]:
        """Return its vertices in the world, metres. Shape (V, 3)."""
        local = np.concatenate([mesh.vertices for mesh, _ in self.parts])
        return np.asarray(local @ self.T_world_thing[:3, :3].T + self.T_world_thing[:3, 3])


@dataclass
class Room:
    """Floor from (0, 0) to `size`, z up; what stands in it and the cells that are taken."""

    size: tuple[float, float, float]
    rng: np.random.Generator
    things: list[Placed] = field(default_factory=list)
    taken: NDArray[np.bool_] = field(init=False)
    """Cells of the floor in each layer. Shape (layers, rows along y, columns along x)."""
    walls: list[NDArray[np.bool_]] = field(init=False)
    """Cells of each wall that are covered (rows along z)."""

    def __post_init__(self) -> None:
        nx, ny, nz = (int(np.ceil(s / CELL_M)) for s in self.size)
        self.taken = np.zeros((len(LAYERS_M), ny, nx), bool)
        self.walls = [np.zeros((nz, n), bool) for n in (nx, ny, nx, ny)]

    def wall_pose(self, wall: int, along: float, away: float, z: float = 0.0) -> NDArray[np.float64]:
        """Return the pose of a thing with its back to a wall: y = 0, x = 0, y = top, x = right. Shape (4, 4)."""
        w, deep, _ = self.size
        spot = [
            (along, away, 0.0),
            (away, along, -np.pi / 2),
            (along, deep - away, np.pi),
            (w - away, along, np.pi / 2),
        ][wall]
        return flat_pose(spot[0], spot[1], spot[2], z)

    def wall_length(self, wall: int) -> float:
        """Return the length of a wall, metres."""
        return self.size[wall % 2]

    def fits(self, draft: Draft, pose: NDArray[np.float64]) -> bool:
        """Return true where a thing, with what it brings along, meets no other and stays inside."""
        points = surface_points(draft, self.rng) @ pose[:3, :3].T + pose[:3, 3]
        if (
            (points[:, :2] < -0.005).any()
            or (points[:, :2] > np.array(self.size[:2]) + 0.005).any()
            or points[:, 2].max() > self.size[2]
        ):
            return False
        layer, row, column = self._cells(points)
        return not self.taken[layer, row, column].any()

    def place(
        self, kind: str, label: str, family: str, draft: Draft, pose: NDArray[np.float64], *, mark: bool = True
    ) -> None:
        """Put a thing and what it brings along into the room."""
        from training.worlds.catalogue import LOOSE

        self.things.append(Placed(len(self.things) + 1, kind, label, family, tuple(draft.parts), pose))
        for name, child, local in draft.loose:
            self.place(name, name, LOOSE.get(name, name), child, pose @ local, mark=False)
        if mark:
            points = surface_points(draft, self.rng) @ pose[:3, :3].T + pose[:3, 3]
            layer, row, column = self._cells(points)
            self.taken[layer, row, column] = True

    def _cells(self, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        layer = np.searchsorted(LAYERS_M, points[:, 2], side="right") - 1
        known = layer >= 0
        column = np.clip(points[:, 0] / CELL_M, 0, self.taken.shape[2] - 1).astype(np.int64)
        row = np.clip(points[:, 1] / CELL_M, 0, self.taken.shape[1] - 1).astype(np.int64)
        return layer[known], row[known], column[known]

    def wall_free(self, wall: int, span: tuple[float, float], z: tuple[float, float], *, take: bool = False) -> bool:
        """Return true where a rectangle of a wall is bare; `take` covers it."""
        grid = self.walls[wall]
        c0, c1 = (int(np.clip(s / CELL_M, 0, grid.shape[1])) for s in span)
        r0, r1 = (int(np.clip(s / CELL_M, 0, grid.shape[0])) for s in z)
        if span[0] < 0 or span[1] > self.wall_length(wall) or grid[r0:r1, c0:c1].any():
            return False
        if take:
            grid[r0:r1, c0:c1] = True
        return True

    def free_eye(self, x: float, y: float, reach: float = 0.22) -> bool:
        """Return true where a camera can be held."""
        row, column, n = int(y / CELL_M), int(x / CELL_M), int(reach / CELL_M)
        if min(x, y, self.size[0] - x, self.size[1] - y) < reach:
            return False
        near = self.taken[5:, max(0, row - n) : row + n + 1, max(0, column - n) : column + n + 1]
        return not near.any()


def flat_pose(x: float, y: float, yaw: float, z: float = 0.0) -> NDArray[np.float64]:
    """Return an upright pose. Shape (4, 4)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def surface_points(draft: Draft, rng: np.random.Generator, count: int = 3000) -> NDArray[np.float64]:
    """Return points spread over the surface of a thing and its loose things, in its frame. Shape (N, 3)."""
    mesh = draft.mesh()
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rows = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    points = [a[rows] + u * (b - a)[rows] + v * (c - a)[rows]]
    for _, child, pose in draft.loose:
        points.append(surface_points(child, rng, 400) @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(points)


def room_shell(
    size: tuple[float, float, float], wall: Material, floor: Material, ceiling: Material
) -> list[tuple[str, Mesh, Material]]:
    """Return floor, ceiling and four walls as slabs outside of the room."""
    w, deep, h = size
    t = 0.1
    out = [
        ("floor", box((w + 2 * t, deep + 2 * t, t), (w / 2, deep / 2, -t)), floor),
        ("ceiling", box((w + 2 * t, deep + 2 * t, t), (w / 2, deep / 2, h)), ceiling),
    ]
    for x, y, sx, sy in (
        (w / 2, -t / 2, w, t),
        (-t / 2, deep / 2, t, deep),
        (w / 2, deep + t / 2, w, t),
        (w + t / 2, deep / 2, t, deep),
    ):
        out.append(("wall", box((sx, sy, h), (x, y, 0)), wall))
    return out
