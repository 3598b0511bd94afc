"""Triangle meshes of the shapes that furniture is made of. Metres, z up."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Mesh:
    """Triangles in the frame of a thing."""

    vertices: Array
    """Metres. Shape (V, 3)."""
    triangles: NDArray[np.int64]
    """Rows of vertices. Shape (T, 3)."""

    def moved(
        self, offset: Vector = (0.0, 0.0, 0.0), *, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
    ) -> Mesh:
        """Return the mesh turned about x (`roll`), y (`pitch`), z (`yaw`), radians, and then shifted by metres."""
        return Mesh(self.vertices @ turn(yaw, pitch, roll).T + np.array(offset), self.triangles)

    def scaled(self, factors: Vector) -> Mesh:
        """Return the mesh stretched along x, y and z."""
        return Mesh(self.vertices * np.array(factors), self.triangles)


def turn(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Return the rotation about x by `roll`, then y by `pitch`, then z by `yaw`, radians. Shape (3, 3)."""
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return np.asarray(about_z @ about_y @ about_x)


def join(meshes: list[Mesh]) -> Mesh:
    """Return one mesh of several."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes])
    triangles = [m.triangles + o for m, o in zip(meshes, offsets, strict=False)]
    return Mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(triangles))


def grid_triangles(rows: int, columns: int, *, closed: bool = False) -> NDArray[np.int64]:
    """Return two triangles for each cell of a grid of vertices; `closed` joins the last column to the first."""
    span = columns if closed else columns - 1
    r, c = (a.ravel() for a in np.meshgrid(np.arange(rows - 1), np.arange(span), indexing="ij"))
    right = (c + 1) % columns
    a, b, d, e = r * columns + c, r * columns + right, (r + 1) * columns + c, (r + 1) * columns + right
    return np.concatenate([np.stack([a, b, d], 1), np.stack([b, e, d], 1)])


def box(size: Vector, base: Vector = (0.0, 0.0, 0.0)) -> Mesh:
    """Return a box; `base` is the middle of its bottom face."""
    signs = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    faces = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    triangles = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
    return Mesh(signs * np.array(size) + np.array(base), triangles)


def soft_box(
    size: Vector, base: Vector = (0.0, 0.0, 0.0), radius: float = 0.04, puff: float = 0.0, cells: int = 6
) -> Mesh:
    """Return a box with round edges, as upholstery has; `puff` lifts the middle of its faces by that share."""
    line = np.linspace(-1, 1, cells + 1)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    one = np.ones_like(u)
    sides = [np.stack(s, 1) for s in ((u, v, one), (u, v, -one), (u, one, v), (u, -one, v), (one, u, v), (-one, u, v))]
    cube = np.concatenate(sides)
    triangles = np.concatenate([grid_triangles(cells + 1, cells + 1) + k * (cells + 1) ** 2 for k in range(6)])
    half = np.array(size) / 2
    radius = min(radius, 0.98 * float(half.min()))
    point = cube * half
    core = np.clip(point, -(half - radius), half - radius)
    away = point - core
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    bulge = 1.0 + puff * np.prod(
        [1 - np.clip(np.abs(cube[:, k]), 0, 1) ** 4 * (np.abs(cube[:, k]) < 1) for k in range(3)], axis=0
    )
    vertices = (core + radius * away) * np.where(np.abs(cube) >= 1, bulge[:, None], 1.0)
    return Mesh(vertices + np.array(base) + [0, 0, half[2]], triangles)


def pillow(size: Vector, base: Vector = (0.0, 0.0, 0.0), sag: float = 0.0, cells: int = 10) -> Mesh:
    """Return a stuffed case that thins out towards its seams; `sag` bends its ends down by metres."""
    line = np.linspace(-1, 1, cells + 1)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    thick = np.sqrt(np.clip((1 - u**4) * (1 - v**4), 0, 1)) ** 0.8
    pinch = 1 - 0.06 * (u**2 * v**2)
    x, y = u * size[0] / 2 * pinch, v * size[1] / 2 * pinch
    middle = size[2] / 2 - sag * u**2
    top = np.stack([x, y, middle + thick * size[2] / 2], 1)
    bottom = np.stack([x, y, middle - thick * size[2] / 2], 1)
    triangles = grid_triangles(cells + 1, cells + 1)
    return Mesh(np.concatenate([top, bottom]) + np.array(base), np.concatenate([triangles, triangles + len(top)]))


def lathe(profile: list[tuple[float, float]], base: Vector = (0.0, 0.0, 0.0), sides: int = 20) -> Mesh:
    """Return a surface of revolution about z through (radius, height) points, metres."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(sides, z)], 1) for r, z in profile]
    return Mesh(np.concatenate(rings) + np.array(base), grid_triangles(len(profile), sides, closed=True))


def cylinder(
    radius: float, height: float, base: Vector = (0.0, 0.0, 0.0), top: float | None = None, sides: int = 16
) -> Mesh:
    """Return a closed cylinder or cone; `top` is its upper radius where it differs."""
    upper = radius if top is None else top
    return lathe([(0.0, 0.0), (radius, 0.0), (upper, height), (0.0, height)], base, sides)


def ball(radius: float, base: Vector = (0.0, 0.0, 0.0), sides: int = 18) -> Mesh:
    """Return a ball that rests on `base`."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    return lathe([(radius * float(np.cos(a)), radius * (1 + float(np.sin(a)))) for a in angle], base, sides)


def rod(start: Vector, end: Vector, radius: float, sides: int = 7) -> Mesh:
    """Return a round bar from one point to another."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / max(length, 1e-9)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(axis, first), axis], axis=1)
    mesh = cylinder(radius, length, sides=sides)
    return Mesh(mesh.vertices @ frame.T + a, mesh.triangles)


def bar(start: Vector, end: Vector, width: float, depth: float) -> Mesh:
    """Return a square bar from one point to another."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / max(length, 1e-9)
    first = np.cross(np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0]), axis)
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(axis, first), axis], axis=1)
    mesh = box((width, depth, length))
    return Mesh(mesh.vertices @ frame.T + a, mesh.triangles)


def tube(points: Array, radius: float, sides: int = 6) -> Mesh:
    """Return a round tube along a polyline. `points` has shape (N, 3), metres."""
    pairs = pairwise(points)
    return join([rod(tuple(a), tuple(b), radius, sides) for a, b in pairs])


def cloth(heights: Array, size: tuple[float, float], thickness: float = 0.0) -> Mesh:
    """Return a sheet over a rectangle from a grid of heights (rows along y, columns along x), metres."""
    rows, columns = heights.shape
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, columns) * size[0], np.linspace(-0.5, 0.5, rows) * size[1])
    top = np.stack([x.ravel(), y.ravel(), heights.ravel() + thickness], 1)
    triangles = grid_triangles(rows, columns)
    if thickness <= 0:
        return Mesh(top, triangles)
    rim = np.concatenate(
        [
            np.arange(columns),
            np.arange(1, rows) * columns + columns - 1,
            (rows - 1) * columns + np.arange(columns - 2, -1, -1),
            np.arange(rows - 2, 0, -1) * columns,
        ]
    )
    low = top[rim] - [0, 0, thickness]
    ring = np.concatenate([top[rim], low])
    sides = grid_triangles(2, len(rim), closed=True)
    return join([Mesh(top, triangles), Mesh(ring, sides)])


def waves(rng: np.random.Generator, shape: tuple[int, int], height: float, length: float = 3.0) -> Array:
    """Return a smooth random field of deviation `height`, about `length` waves across. Shape (rows, columns)."""
    y, x = np.meshgrid(np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), indexing="ij")
    out = np.zeros(shape)
    for _ in range(6):
        k = rng.normal(size=2) * length
        out += np.cos(2 * np.pi * (k[0] * x + k[1] * y) + rng.uniform(0, 6.3))
    return np.asarray(height * out / np.sqrt(3.0))
