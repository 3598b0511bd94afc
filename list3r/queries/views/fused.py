"""Stored depth fused into a grid of signed distances, and the triangles of that, simplified.

The grid is Open3D's (Dong et al., IEEE TPAMI 2022). Two changes make its surface better on small pictures: it takes the
pixel below and left of a place for the nearest one, so the camera's centre is moved by half a pixel, and depth is
interpolated within surfaces.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MissingPackageError
from list3r.memory.store.store import Store
from list3r.queries.relations import unit_of
from list3r.queries.views.depth_frames import REST, DepthFrame, depth_frames

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class FusionSettings:
    """How depth is fused."""

    voxel_m: float = 0.02
    """Edge of a cell of the grid."""
    truncation_cells: float = 3.0
    """Distances are kept so far before and behind a surface; what is thinner is one surface."""
    most_depth_m: float = 4.5
    """Depth beyond is too coarse."""
    block: int = 8
    """Cells along a block of the grid."""
    most_blocks: int = 20_000
    """Blocks that are in memory at a time, 6 kB each; a larger scene is fused part by part."""
    kept_share: float = 0.25
    """Share of the triangles that simplification leaves."""
    color_m: float = 0.05
    """Simplification treats white as so much higher than black, so that pictures on a wall stay sharp."""


@dataclass(frozen=True)
class Surface:
    """Triangles with colours, or points alone. World coordinates."""

    vertices: NDArray[np.float32]
    """Shape (V, 3)."""
    faces: NDArray[np.int32]
    """Counter-clockwise as seen from where the cameras were; none where points alone are known. Shape (F, 3)."""
    rgb: NDArray[np.uint8]
    """Of vertices, sRGB. Shape (V, 3)."""

    def with_faces(self, chosen: NDArray[np.int32]) -> Surface:
        """Return only some of the faces, with their vertices. Shape (F, 3)."""
        used, faces = np.unique(chosen, return_inverse=True)
        return Surface(self.vertices[used], faces.reshape(-1, 3).astype(np.int32), self.rgb[used])

    def sampled(self, count: int, seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]:
        """Return points on the faces by lot, their colours, and unit normals. Shape (count, 3) each."""
        rng = np.random.default_rng(seed)
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        across = np.cross(b - a, c - a)
        area = np.linalg.norm(across, axis=1)
        chosen = rng.choice(len(area), count, p=area / area.sum() if area.any() else None)
        weight = rng.dirichlet((1.0, 1.0, 1.0), count)[:, :, None]
        points, rgb = ((values[self.faces[chosen]] * weight).sum(axis=1) for values in (self.vertices, self.rgb))
        normals = across[chosen] / np.maximum(area[chosen], 1e-30)[:, None]
        return points.astype(np.float32), np.round(rgb).astype(np.uint8), normals.astype(np.float32)

    def normals(self) -> NDArray[np.float64]:
        """Return unit normals of vertices, the faces around each weighted with their areas. Shape (V, 3)."""
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        across = np.repeat(np.cross(b - a, c - a), 3, axis=0)
        sums = [np.bincount(self.faces.ravel(), across[:, k], len(self.vertices)) for k in range(3)]
        out = np.stack(sums, axis=1)
        return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30))

    @staticmethod
    def of_points(points: NDArray[np.float32], rgb: NDArray[np.uint8]) -> Surface:
        """Return points alone. Both shape (N, 3)."""
        return Surface(points, np.zeros((0, 3), np.int32), rgb)


def can_fuse() -> bool:
    """Tell whether the packages are installed that fusion takes."""
    return all(importlib.util.find_spec(name) is not None for name in ("open3d", "fast_simplification"))


def fused(store: Store, component: int, settings: FusionSettings | None = None) -> tuple[Surface, Ints]:
    """Return the surface of a component, and whose each face is: ids, `REST` for none. Shape (F,)."""
    s, unit = settings or FusionSettings(), unit_of(store)
    fusion = _Fusion(s, s.voxel_m * unit, s.most_depth_m * unit)
    touched = [fusion.blocks(f) for f in depth_frames(store, component)]
    blocks = np.unique(np.concatenate([np.zeros((0, 3), np.int64), *touched]), axis=0)
    boxes = list(_boxes(blocks, s.most_blocks)) if len(blocks) else []
    parts = []
    for low, high in boxes:
        count = int(((blocks >= low - 1) & (blocks <= high + 1)).all(axis=1).sum())
        part = fusion.part(depth_frames(store, component), (low, high), count)
        parts.append(_simplified(*part, s, unit, border=len(boxes) > 1))
    return _joined(parts, 1e-4 * fusion.voxel)


def _boxes(blocks: Ints, most: int) -> Iterator[tuple[Ints, Ints]]:
    """Yield the lowest and highest blocks of parts of at most so many. Shape (N, 3)."""
    low, high = blocks.min(axis=0), blocks.max(axis=0)
    axis = int((high - low).argmax())
    if len(blocks) <= most or low[axis] == high[axis]:
        yield low, high
        return
    here = blocks[:, axis] < max(np.median(blocks[:, axis]), low[axis] + 1)
    yield from _boxes(blocks[here], most)
    yield from _boxes(blocks[~here], most)


class _Fusion:
    """Open3D's grid for the frames of one component."""

    def __init__(self, settings: FusionSettings, voxel: float, most_depth: float) -> None:
        self._s, self.voxel, self._most = settings, voxel, most_depth
        try:
            self._core: Any = importlib.import_module("open3d.core")
            self._geometry: Any = importlib.import_module("open3d.t.geometry")
        except (ImportError, OSError) as error:  # a library of the system is missing
            said = f"open3d, which fuses surfaces, cannot be loaded ({error})"
            hint = "on Debian: apt-get install libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6"
            raise MissingPackageError(f"{said}; {hint}; without open3d points are shown") from error
        self._empty = self._grid(1)

    def blocks(self, frame: DepthFrame) -> Ints:
        """Return the blocks near the depth of a frame. Shape (N, 3)."""
        return self._near(*self._views(frame)).astype(np.int64)

    def part(self, frames: Iterator[DepthFrame], box: tuple[Ints, Ints], count: int) -> tuple[Surface, Ints]:
        """Return the surface in the blocks of a box, about so many, and whose each vertex is."""
        low, high = box
        size = self.voxel * self._s.block
        grid, votes = self._grid(count), _Votes(self.voxel)
        for frame in frames:
            depth, lens, T_cam_world = self._views(frame)
            blocks = self._near(depth, lens, T_cam_world)
            # Triangles of the last cells reach into the next blocks.
            blocks = blocks[((blocks >= low - 1) & (blocks <= high + 1)).all(axis=1)]
            if len(blocks):
                color = self._geometry.Image((frame.colors(2) / np.float32(255)).astype(np.float32))
                most = (1.0, self._most, self._s.truncation_cells)
                grid.integrate(self._core.Tensor(blocks), depth, color, lens, T_cam_world, *most)
                votes.add(frame, low, high, size)
        surface = _in_order(grid.extract_triangle_mesh(0.5))
        middle = np.floor(surface.vertices[surface.faces].mean(axis=1) / size)
        surface = surface.with_faces(surface.faces[((middle >= low) & (middle <= high)).all(axis=1)])
        return surface, votes.of(surface.vertices)

    def _near(self, depth: Any, lens: Any, T_cam_world: Any) -> NDArray[np.int32]:
        touch = self._empty.compute_unique_block_coordinates
        try:
            found = touch(depth, lens, T_cam_world, 1.0, self._most, self._s.truncation_cells)
        except RuntimeError:  # no depth within reach
            return np.zeros((0, 3), np.int32)
        return np.asarray(found.numpy())

    def _views(self, frame: DepthFrame) -> tuple[Any, Any, Any]:
        fx, fy, cx, cy = (2 * v for v in frame.camera)
        lens = np.array([[fx, 0, cx + 1.0], [0, fy, cy + 1.0], [0, 0, 1]])  # half a pixel twice
        return (
            self._geometry.Image(frame.twice_as_fine()),
            self._core.Tensor(lens),
            self._core.Tensor(np.linalg.inv(frame.T_world_cam)),
        )

    def _grid(self, count: int) -> Any:
        kinds = (self._core.float32, self._core.uint16, self._core.uint16)
        return self._geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), kinds, (1, 1, 3), self.voxel, self._s.block, count
        )


# ---------------------------------------------------------------------------------------------- whose it is

_CELLS = 1 << 20
_TOGETHER = 64
"""Frames whose votes are added up at once."""


class _Votes:
    """How many pixels of which instance lie in each cell."""

    def __init__(self, cell: float) -> None:
        self._cell = cell
        self._counted: list[tuple[Ints, Ints, Ints]] = []

    def add(self, frame: DepthFrame, low: Ints, high: Ints, size: float) -> None:
        """Count the pixels of a frame that lie in a box of blocks of a size."""
        points = frame.points()
        blocks = np.floor(points / size)
        here = (frame.depth > 0) & ((blocks >= low) & (blocks <= high)).all(axis=2)
        cells = np.floor(points[here] / self._cell).astype(np.int64) + _CELLS
        key = (cells @ [1 << 42, 1 << 21, 1]).astype(np.int64)
        self._counted.append(_counted(key, frame.owner[here], np.ones(len(key), np.int64)))
        if len(self._counted) > _TOGETHER:
            self._counted = [self._sum()]

    def of(self, vertices: NDArray[np.float32]) -> Ints:
        """Return whose most pixels are in the voted cell nearest to each vertex. Shape (V, 3) -> (V,)."""
        from scipy.spatial import cKDTree

        key, owner = _commonest(*self._sum())
        if not len(key):
            return np.full(len(vertices), REST, np.int64)
        cells = np.stack([key >> 42, (key >> 21) & (2 * _CELLS - 1), key & (2 * _CELLS - 1)], axis=1) - _CELLS
        return np.asarray(owner[cKDTree((cells + 0.5) * self._cell).query(vertices)[1]])

    def _sum(self) -> tuple[Ints, Ints, Ints]:
        key, owner, count = (np.concatenate(c) for c in zip(*self._counted, strict=True))
        return _counted(key, owner, count)


def _counted(where: Ints, whose: Ints, count: Ints) -> tuple[Ints, Ints, Ints]:
    """Return each pair once, in order, with the sum of its counts. All shape (N,)."""
    order = np.lexsort((whose, where))
    where, whose = where[order], whose[order]
    first = np.flatnonzero(np.append(True, (np.diff(where) != 0) | (np.diff(whose) != 0))[: len(where)])
    total = np.add.reduceat(count[order], first) if len(first) else count
    return where[first], whose[first], total


def _commonest(where: Ints, whose: Ints, count: Ints) -> tuple[Ints, Ints]:
    """Return each place once, in order, and whose it is mostly; pairs are given once each. All shape (N,)."""
    order = np.lexsort((-count, where))
    where, whose = where[order], whose[order]
    first = np.append(True, np.diff(where) != 0)[: len(where)]
    return where[first], whose[first]


# ---------------------------------------------------------------------------------------------- triangles


def _in_order(mesh: Any) -> Surface:
    """Return Open3D's triangles in the same order every time; its threads give them in any."""
    vertices, faces = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    order = np.lexsort(vertices.T)
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    faces = place[faces]
    turn = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    rgb = np.round(255 * mesh.vertex.colors.numpy().clip(0, 1)).astype(np.uint8)
    return Surface(vertices[order], faces[np.lexsort(faces.T)], rgb[order])


def fewer(surface: Surface, share: float) -> Surface:
    """Return the surface with about this share of its triangles, its edge as it is; points are drawn by lot."""
    count = len(surface.vertices)
    if not len(surface.faces):
        chosen = np.sort(np.random.default_rng(count).permutation(count)[: int(np.ceil(share * count))])
        return Surface.of_points(surface.vertices[chosen], surface.rgb[chosen])
    s = FusionSettings(kept_share=share, color_m=0.02 * float(np.ptp(surface.vertices, axis=0).max()))
    return _simplified(surface, np.zeros(count, np.int64), s, 1.0, border=True)[0]


def _simplified(surface: Surface, owner: Ints, s: FusionSettings, unit: float, *, border: bool) -> tuple[Surface, Ints]:
    """Return fewer triangles by quadric errors (Garland and Heckbert 1997), and whose each vertex is.

    The errors are those of the surface raised by its brightness. With `border` the edge of the surface stays as it is.
    """
    import fast_simplification

    most = int(s.kept_share * len(surface.faces))
    if not most:
        return surface, owner
    raise_by = s.color_m * unit * _brightness(surface)[:, None] * surface.normals()
    vertices, faces, steps = fast_simplification.simplify(
        surface.vertices + raise_by,
        np.ascontiguousarray(surface.faces),
        target_count=most,
        return_collapses=True,
        preserve_border=border,
    )
    into = np.arange(len(owner))
    into[steps[:, 1]] = steps[:, 0]
    while (into[into] != into).any():
        into = into[into]
    left = surface.faces[(into[surface.faces] != np.roll(into[surface.faces], 1, axis=1)).all(axis=1)]
    kept = np.unique(into[left])  # in the order of the vertices
    there = np.isin(into, kept)
    of = np.searchsorted(kept, into[there])
    _, whose = _commonest(*_counted(of, owner[there], np.ones_like(of)))
    rgb = np.round(_means(surface.rgb[there], of)).astype(np.uint8)
    vertices = (vertices - _means(raise_by[there], of)).astype(np.float32)
    return Surface(vertices, faces.astype(np.int32), rgb), whose


def _means(rows: NDArray[Any], of: Ints) -> NDArray[np.float64]:
    """Return the mean of the rows of each group; `of` numbers them from 0. Shape (N, 3) -> (G, 3)."""
    sums = np.stack([np.bincount(of, rows[:, k]) for k in range(3)], axis=1)
    return np.asarray(sums / np.maximum(np.bincount(of), 1)[:, None])


def _brightness(surface: Surface) -> NDArray[np.float64]:
    return np.asarray(surface.rgb @ np.array([0.299, 0.587, 0.114]) / 255)


def _joined(parts: list[tuple[Surface, Ints]], step: float) -> tuple[Surface, Ints]:
    """Return parts as one surface, the vertices at their seams once, and whose each face is: two of its corners'."""
    if not parts:
        return Surface.of_points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)), np.zeros(0, np.int64)
    starts = np.cumsum([0, *(len(p.vertices) for p, _ in parts)])
    vertices, rgb = (np.concatenate([getattr(p, n) for p, _ in parts]) for n in ("vertices", "rgb"))
    faces = np.concatenate([p.faces + n for (p, _), n in zip(parts, starts, strict=False)])
    owner = np.concatenate([o for _, o in parts])
    if len(parts) > 1:
        _, first, which = np.unique(np.round(vertices / step), axis=0, return_index=True, return_inverse=True)
        vertices, rgb, owner, faces = vertices[first], rgb[first], owner[first], which.ravel()[faces].astype(np.int32)
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces = faces[whole]
    return Surface(vertices, faces, rgb), np.sort(owner[faces], axis=1)[:, 1]
