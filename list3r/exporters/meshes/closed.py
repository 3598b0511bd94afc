"""Closed surfaces from numbers: the zero level of a field, convex hulls, slabs; all with faces that look outward."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


@dataclass(frozen=True)
class ClosedSurface:
    """Triangles without a border: two at each edge."""

    vertices: Array
    """Shape (V, 3)."""
    faces: Faces
    """Counter-clockwise as seen from outside. Shape (F, 3)."""

    def volume(self) -> float:
        """Return the volume inside, by the divergence theorem."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    def normals(self) -> Array:
        """Return unit normals of vertices, the faces around each weighted with their areas. Shape (V, 3)."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        out = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(out, self.faces[:, k], across)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return np.where(length > 0, out / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])


# ---------------------------------------------------------------------------------------------- fields

_TETRAHEDRA = tuple((0, 1 << a, (1 << a) | (1 << b), 7) for a, b in ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)))
"""Corners (a bit an axis) of the six tetrahedra of a cube, along its diagonal: alike on faces that two cubes share."""
_RIGHT_HANDED = (0, 3, 4)
"""Even permutations of the axes."""
_CORNERS = np.array([[n >> k & 1 for k in range(3)] for n in range(8)])


def zero_level(field: Array) -> ClosedSurface:
    """Return the surface around values above 0, in grid steps, by marching tetrahedra.

    The border of the grid must be below 0. Shape (X, Y, Z).
    """
    field = np.where(field == 0, -1e-9, field)
    inside = field > 0
    some = np.zeros(tuple(n - 1 for n in field.shape), np.int8)
    for x, y, z in itertools.product((0, 1), repeat=3):
        some += inside[x : x + some.shape[0], y : y + some.shape[1], z : z + some.shape[2]]
    cells = np.argwhere((some > 0) & (some < 8))
    corners = np.ravel_multi_index(tuple((cells[:, None] + _CORNERS).reshape(-1, 3).T), field.shape).reshape(-1, 8)
    flat, above = field.ravel(), inside.ravel()
    triangles = [_of_tetrahedra(corners[:, list(t)], above) for t in _TETRAHEDRA]
    triangles = [f if n in _RIGHT_HANDED else f[:, ::-1] for n, f in enumerate(triangles)]
    ends = np.concatenate([*triangles, np.zeros((0, 3, 2), np.int64)])  # each corner of a face is on an edge
    edges, faces = _distinct(ends.reshape(-1, 2), field.size)
    places = [np.stack(np.unravel_index(edges[:, k], field.shape), axis=1).astype(np.float64) for k in (0, 1)]
    share = np.clip(flat[edges[:, 0]] / (flat[edges[:, 0]] - flat[edges[:, 1]]), 0.05, 0.95)[:, None]
    return ClosedSurface(places[0] + share * (places[1] - places[0]), faces.reshape(-1, 3).astype(np.int64))


def _of_tetrahedra(corners: NDArray[np.int64], above: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the faces inside tetrahedra: three edges (inside, outside) each. Shape (T, 4) -> (N, 3, 2)."""
    order = np.argsort(~above[corners], axis=1, kind="stable")  # inside first
    odd = _odd(order)
    sorted_corners = np.take_along_axis(corners, order, axis=1)
    count = above[corners].sum(axis=1)
    out = []
    for inside, faces in _FACES.items():
        chosen, flipped = sorted_corners[count == inside], odd[count == inside]
        for face in faces:
            ends = np.stack([chosen[:, list(edge)] for edge in face], axis=1)
            out.append(np.where(flipped[:, None, None], ends[:, ::-1], ends))
    return np.concatenate(out) if out else np.zeros((0, 3, 2), np.int64)


_FACES = {
    1: (((0, 1), (0, 2), (0, 3)),),
    2: (((0, 2), (1, 3), (1, 2)), ((0, 2), (0, 3), (1, 3))),
    3: (((0, 3), (1, 3), (2, 3)),),
}
"""Faces by the number of corners inside, which come first; turned alike in a tetrahedron of one handedness."""


def _odd(order: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which permutations are odd. Shape (T, 4) -> (T,)."""
    swaps = sum((order[:, a] > order[:, b]).astype(int) for a, b in itertools.combinations(range(4), 2))
    return np.asarray(swaps % 2 == 1)


def _distinct(pairs: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct pairs of numbers below `count`, in order, and which of them each is. Shape (N, 2)."""
    keys, which = np.unique(pairs @ [count, 1], return_inverse=True)
    return np.stack(np.divmod(keys, count), axis=1), which


def outward(surface: ClosedSurface) -> ClosedSurface:
    """Return the surface with faces that look outward as a whole."""
    return surface if surface.volume() >= 0 else ClosedSurface(surface.vertices, surface.faces[:, ::-1])


# ---------------------------------------------------------------------------------------------- hulls and slabs


def hull(points: Array) -> ClosedSurface:
    """Return the convex hull. Raises `scipy.spatial.QhullError` for points in a plane. Shape (N, 3)."""
    found = ConvexHull(points)
    used, faces = np.unique(found.simplices, return_inverse=True)
    vertices, faces = points[used], faces.reshape(-1, 3)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    return ClosedSurface(vertices, np.where(inward[:, None], faces[:, ::-1], faces).astype(np.int64))


def divided(surface: ClosedSurface, longest: float, most_faces: int = 6000) -> ClosedSurface:
    """Return the same surface with each face cut in four until no edge is longer, or faces would be too many."""
    vertices, faces = surface.vertices, surface.faces
    while 4 * len(faces) <= most_faces:
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        if np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max() <= longest:
            break
        unique, which = _distinct(edges, len(vertices))
        m = which.reshape(3, -1).T + len(vertices)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        corner = [np.stack([faces[:, k], m[:, k], m[:, (k + 2) % 3]], axis=1) for k in range(3)]
        faces = np.concatenate([*corner, m])
    return ClosedSurface(vertices, faces)


def slab(cells: NDArray[np.bool_]) -> ClosedSurface:
    """Return occupied cells of a grid as a plate, in steps of the grid: x, y of the cells, z from -0.5 to 0.5.

    Cells that touch at a corner alone are joined by one more, so that no edge has four faces. Shape (X, Y).
    """
    cells = _without_corner_contacts(np.pad(cells, 1))
    x, y = np.nonzero(cells)
    width = cells.shape[1] + 1
    layer = (cells.shape[0] + 1) * width
    a, b, c, d = (x * width + y, (x + 1) * width + y, (x + 1) * width + y + 1, x * width + y + 1)
    top = np.stack([a, b, c, d], axis=1) + layer
    quads = [top, np.stack([a, d, c, b], axis=1)]
    for near, far, dx, dy in ((a, b, 0, -1), (b, c, 1, 0), (c, d, 0, 1), (d, a, -1, 0)):
        rim = ~cells[x + dx, y + dy]
        quads.append(np.stack([near, far, far + layer, near + layer], axis=1)[rim])
    faces = np.concatenate([np.concatenate(quads)[:, [0, 1, 2]], np.concatenate(quads)[:, [0, 2, 3]]])
    used, faces = np.unique(faces, return_inverse=True)
    z, rest = np.divmod(used, layer)
    vertices = np.stack([rest // width - 1, rest % width - 1, z - 0.5], axis=1).astype(np.float64)
    return ClosedSurface(vertices, faces.reshape(-1, 3).astype(np.int64))


def _without_corner_contacts(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    cells = cells.copy()
    _join_corners(cells)
    return cells


def _join_corners(cells: NDArray[np.bool_]) -> None:
    """Join cells that touch at a corner alone, in place."""
    a, b, c, d = cells[:-1, :-1], cells[1:, :-1], cells[1:, 1:], cells[:-1, 1:]
    while True:
        one, other = a & c & ~b & ~d, b & d & ~a & ~c
        if not (one.any() or other.any()):
            return
        b |= one
        a |= other


def net(cells: NDArray[np.bool_]) -> tuple[ClosedSurface, NDArray[np.int64]]:
    """Return the surface of occupied cells, in steps of the grid from the middle of the first one, and its vertices'
    corners: a vertex for each corner of the cells that lies on the surface, at the middle of the sides that it joins
    (surface nets, Gibson 1998). A corner is named by the cell above it in all axes.

    Cells that touch along an edge alone are joined by one more, so that no edge has four faces. Shape (X, Y, Z).
    """
    cells = np.pad(cells, 2)
    while True:
        before = int(cells.sum())
        for axis in range(3):
            for layer in np.moveaxis(cells, axis, 0):
                _join_corners(layer)
        if int(cells.sum()) == before:
            break
    shape = tuple(n - 1 for n in cells.shape)  # of corners, each between eight cells
    sums, weights = np.zeros((*shape, 3)), np.zeros(shape)
    quads = []
    number = np.arange(int(np.prod(shape))).reshape(shape)
    for axis in range(3):
        at = np.moveaxis(cells, axis, 0)
        corner = np.moveaxis(number, axis, 0)
        for inside in (0, 1):
            face = np.argwhere(at[inside : len(at) - 1 + inside] & ~at[1 - inside : len(at) - inside])
            around = [corner[face[:, 0], face[:, 1] + dy - 1, face[:, 2] + dz - 1] for dy, dz in _RING]
            middle = np.insert(face[:, 1:].astype(float), axis, face[:, 0] + 0.5, axis=1)
            for ring in around:
                np.add.at(sums.reshape(-1, 3), ring, middle)
                np.add.at(weights.reshape(-1), ring, 1.0)
            turned = (inside == 1) != (axis == 1)
            quads.append(np.stack(around[::-1] if turned else around, axis=1))
    ring = np.concatenate(quads)
    used, faces = np.unique(np.concatenate([ring[:, [0, 1, 2]], ring[:, [0, 2, 3]]]), return_inverse=True)
    vertices = sums.reshape(-1, 3)[used] / weights.reshape(-1)[used, None]
    corners = np.stack(np.unravel_index(used, shape), axis=1) - 1
    of, faces = _fans(faces.reshape(-1, 3))
    return ClosedSurface(vertices[of] - 2, faces), corners[of]


def _fans(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give each ring of faces round a vertex one of its own, where cells touch at a corner.

    Returns which vertex each new one is, and the faces. Each edge has two faces.
    """
    corner = np.arange(faces.size).reshape(-1, 3)
    ahead, to = np.roll(corner, -1, axis=1).ravel(), np.roll(faces, -1, axis=1).ravel()
    here, at = corner.ravel(), faces.ravel()
    rising = at < to
    ends = np.where(rising, here, ahead), np.where(rising, ahead, here)
    order = np.lexsort((np.maximum(at, to), np.minimum(at, to))).reshape(-1, 2)
    one, other = np.concatenate([end[order] for end in ends]).T
    links = coo_matrix((np.ones(len(one), np.int8), (one, other)), shape=(faces.size, faces.size))
    count, ring = connected_components(links, directed=False)
    of = np.empty(count, np.int64)
    of[ring] = at
    return of, ring.reshape(-1, 3).astype(np.int64)


_RING = ((0, 0), (1, 0), (1, 1), (0, 1))


def filled(occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return occupied cells and the cells that they enclose. Any shape."""
    return np.asarray(ndimage.binary_fill_holes(occupied))
