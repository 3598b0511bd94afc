"""Local instances as the occupied cells of adaptive grids: what overlap is measured on.

A surface of a chunk is known to the alignment error of the chunk and to the noise of its depth, so two supports are
compared within a tolerance: each instance is entered in a grid of half the tolerance, grown by the tolerance. The
coverage of all instances of one chunk by all of another is then one sparse product. The grid is adaptive: fine for
what is small or densely sampled, coarser (by powers of two) where the support points lie far apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.colors import lab_from_rgb
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import FrameSamples
from list3r.memory.store.derived import KEPT_TURNS, LruCache
from list3r.memory.store.tables.local_instances import LocalNode

Ints = NDArray[np.int64]

LEVELS = 5
"""Grids, each twice as coarse as the one before."""
_BITS, _HALF = 20, 1 << 19
_SPAN = range(-2, 3)
_REACH = np.array(
    [
        i * (1 << 2 * _BITS) + j * (1 << _BITS) + k
        for i in _SPAN
        for j in _SPAN
        for k in _SPAN
        if i * i + j * j + k * k <= 4
    ],
    dtype=np.int64,
)
"""What to add to a key to get the cells whose centres lie within two cells: the tolerance."""


@dataclass(frozen=True)
class ShapeSettings:
    """How exactly surfaces of two chunks are expected to meet."""

    tolerance_m: float = 0.03
    """Distance within which two surfaces are the same one: residual drift between chunks plus depth noise."""
    crowd: float = 1.2
    """Support points in an occupied cell, on average, that a grid must have to be filled by the points."""
    max_points: int = 250
    """Representative points of one instance, one from each occupied cell."""
    trim: float = 0.02
    """Share of the points outside the extents at either end of each axis."""
    border_px: float = 3.0
    """A box that comes this near to the border of what is seen is cut by it."""
    blind: float = 0.1
    """Up to this share of the image's width and height may be blind at each border, where depth does not cover colour;
    what is seen ends where no box of the chunk goes further."""


@dataclass(frozen=True)
class ChunkShapes:
    """The N local instances of one chunk, in chunk coordinates."""

    chunk_id: int
    session_id: int
    local_id: Ints
    """Shape (N,)."""
    points: Array
    """Representative support points, R of them over all instances. Shape (R, 3)."""
    rgb: NDArray[np.uint8]
    """Their colours. Shape (R, 3)."""
    owner: Ints
    """Instance (0 to N - 1) of each point, ascending. Shape (R,)."""
    occupied: Ints
    """Keys of the occupied cells, by instance. Shape (C,)."""
    occupied_owner: NDArray[np.int32]
    """Instance of each occupied cell, ascending. Shape (C,)."""
    level: Ints
    """Grid of each instance. Shape (N,)."""
    grain: float
    """Edge of the finest cells, chunk units."""
    unit: float
    """What a metre is in chunk units."""
    center: Array
    """Middle of the trimmed extents. Shape (N, 3)."""
    size: Array
    """Diagonal of the trimmed extents, chunk units. Shape (N,)."""
    plane: Array
    """(n, d), NaN for what is not flat. Shape (N, 4)."""
    truncated: Array
    """Share of its frames in which the border of what is seen cuts it, by mask area, in [0, 1]. Shape (N,)."""
    lab: Array
    """Median colour, CIE L*a*b*. Shape (N, 3)."""
    seen: Array
    """Part of the image in which anything is seen, xyxy, px, see `seen_xyxy`. Shape (4,)."""
    structure: NDArray[np.bool_]
    """Shape (N,)."""
    stability: Array
    """Shape (N,)."""
    feature: NDArray[np.float32]
    """Shape (N, D)."""
    frames: tuple[Ints, ...]
    """Frame.index of the visible frames of each."""
    boxes_xyxy: tuple[NDArray[np.float32], ...]
    """Boxes in those frames, px. Shape (V, 4) each."""
    areas_px: tuple[NDArray[np.int32], ...]
    """Shape (V,) each."""
    visible_fraction: tuple[NDArray[np.float32], ...]
    """Shape (V,) each."""
    samples: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """Where depth was computed in every third frame: ascending keys of frame and pixel; none of a sensor. (S,)."""
    sample_owner: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    """Instance (0 to N - 1) of each of them, -1 for none. Shape (S,)."""
    stands_for: int = 1
    """Frames of the recording that one of `frames` stands for: itself, and those after it that were passed over."""
    usual_frames: float = 1.0
    """Number of `frames` of an instance, in the middle of all that the chunk found, whatever was left out since."""

    def seen_for(self, at: int) -> int:
        """Return in how many frames of the recording an instance (0 to N - 1) is seen, passed over ones included."""
        return self.stands_for * len(self.frames[at])

    def only(self, kept: NDArray[np.bool_]) -> ChunkShapes:
        """Return some of the instances, (N,). Samples of the others still belong to something: they have the numbers
        after those that are kept.
        """
        number = np.empty(len(kept), np.int64)
        number[np.concatenate([np.flatnonzero(kept), np.flatnonzero(~kept)])] = np.arange(len(kept))
        points, cells = kept[self.owner], kept[self.occupied_owner]
        rows: dict[str, Any] = {name: getattr(self, name)[kept] for name in _ROWS}
        lists: dict[str, Any] = {name: tuple(compress(getattr(self, name), kept)) for name in _LISTS}
        owners, known = self.sample_owner.copy(), (self.sample_owner >= 0) & (self.sample_owner < len(kept))
        owners[known] = number[owners[known]]
        return replace(
            self,
            points=self.points[points],
            rgb=self.rgb[points],
            owner=number[self.owner[points]],
            occupied=self.occupied[cells],
            occupied_owner=number[self.occupied_owner[cells]].astype(np.int32),
            sample_owner=owners,
            **rows,
            **lists,
        )

    def spans(self, S_world_chunk: Sim3) -> tuple[Array, Array]:
        """Return corners of the boxes of the instances' points, world; the origin of the chunk for those without any.
        Shape (N, 3) each.
        """
        low = np.tile(S_world_chunk.translation, (len(self.local_id), 1)).astype(np.float64)
        high = low.copy()
        if len(self.points):
            p = S_world_chunk.apply(self.points)
            first = np.flatnonzero(np.diff(self.owner, prepend=-1))
            low[self.owner[first]] = np.minimum.reduceat(p, first)
            high[self.owner[first]] = np.maximum.reduceat(p, first)
        return low, high


_ROWS = (
    *("local_id", "level", "center", "size", "plane", "truncated", "lab"),
    *("structure", "stability", "feature"),
)
_LISTS = ("frames", "boxes_xyxy", "areas_px", "visible_fraction")


def chunk_shapes(
    nodes: Sequence[LocalNode],
    image_size: tuple[int, int],
    unit: float = 1.0,
    settings: ShapeSettings | None = None,
    *,
    chunk_id: int,
    session_id: int = 1,
) -> ChunkShapes:
    """Enter the local instances of one chunk in their grids.

    `image_size` is (height, width); `unit` is what a metre is in chunk units.
    """
    s = settings or ShapeSettings()
    nodes = sorted(nodes, key=lambda n: n.local_id)
    grain = 0.5 * s.tolerance_m * unit
    points, rgb, owner, cells = [], [], [], []
    seen = seen_xyxy([n.boxes_xyxy for n in nodes], image_size, s.blind)
    level = np.zeros(len(nodes), np.int64)
    count = np.zeros(len(nodes), np.int64)
    center, size = np.zeros((len(nodes), 3)), np.zeros(len(nodes))
    for n, node in enumerate(nodes):
        p = node.support.points.astype(np.float64)
        if len(p) == 0:
            continue
        low, high = np.quantile(p, [s.trim, 1.0 - s.trim], axis=0)
        center[n], size[n] = (low + high) / 2, float(np.linalg.norm(high - low))
        level[n], occupied, first = _own_grid(p, grain, s.crowd, at_least=2 if node.structure else 0)
        count[n] = len(occupied)
        cells.append(_key(occupied, int(level[n])))
        chosen = first[:: max(1, -(-len(first) // s.max_points))]
        points.append(p[chosen])
        rgb.append(node.support.rgb[chosen])
        owner.append(np.full(len(chosen), n))
    return ChunkShapes(
        chunk_id=chunk_id,
        session_id=session_id,
        local_id=np.array([n.local_id for n in nodes], np.int64),
        points=np.concatenate(points) if points else np.zeros((0, 3)),
        rgb=np.concatenate(rgb) if rgb else np.zeros((0, 3), np.uint8),
        owner=_stack(owner, np.int64),
        occupied=_stack(cells, np.int64),
        occupied_owner=np.repeat(np.flatnonzero(count), [len(c) for c in cells]).astype(np.int32),
        level=level,
        grain=grain,
        unit=unit,
        center=center,
        size=size,
        plane=np.array([np.full(4, np.nan) if n.plane is None else n.plane for n in nodes]).reshape(-1, 4),
        truncated=np.array([_truncated(n, seen, s.border_px) for n in nodes]),
        lab=np.array(
            [np.median(lab_from_rgb(n.support.rgb[:: max(1, len(n.support.rgb) // 200)]), axis=0) for n in nodes]
        ).reshape(-1, 3),
        seen=seen,
        structure=np.array([n.structure for n in nodes], bool),
        stability=np.array([n.stability for n in nodes]),
        feature=np.array([n.feature for n in nodes], np.float32) if nodes else np.zeros((0, 0), np.float32),
        frames=tuple(n.frames for n in nodes),
        boxes_xyxy=tuple(n.boxes_xyxy for n in nodes),
        areas_px=tuple(n.areas_px for n in nodes),
        visible_fraction=tuple(n.visible_fraction for n in nodes),
        usual_frames=float(np.median([max(1, len(n.frames)) for n in nodes])) if nodes else 1.0,
    )


def read_every(shapes: ChunkShapes, step: int) -> ChunkShapes:
    """Return the shapes of a chunk of which every `step`-th frame was to be read.

    One stands for less where the chunk was read more densely, as by the gaps between frames in which anything is seen.
    """
    if step == 1 or not shapes.frames:
        return shapes
    gaps = np.diff(np.unique(np.concatenate(shapes.frames)))
    return replace(shapes, stands_for=min(step, int(np.median(gaps))) if len(gaps) else step)


SAMPLED_FRAMES = 3
"""Every how many frames samples are kept."""
PIXEL_BITS = 24


def with_samples(shapes: ChunkShapes, samples: FrameSamples) -> ChunkShapes:
    """Return the shapes of a chunk of computed depth with the samples of every third frame."""
    kept = np.flatnonzero((samples.frame % SAMPLED_FRAMES == 0) & (samples.confidence > 0))
    keys = samples.frame[kept] << PIXEL_BITS | samples.pixel[kept].astype(np.int64)
    place = {n: k for k, n in enumerate(shapes.local_id.tolist())}
    owner = np.array([place.get(n, -1) for n in samples.instance[kept].tolist()], np.int32)
    order = np.argsort(keys, kind="stable")
    return replace(shapes, samples=np.asarray(keys[order], np.int64), sample_owner=owner[order])


def coverage(source: ChunkShapes, target: ChunkShapes, S_target_source: Sim3, grown: GrownCells | None = None) -> Array:
    """Return the share of each source instance's points that lie on each target instance. Shape (N_source, N_target).

    On means within the tolerance of the target's support and, where the target is flat, of its plane.
    """
    shape = (len(source.local_id), len(target.local_id))
    if len(source.points) == 0 or len(target.occupied) == 0:
        return np.zeros(shape)
    p = S_target_source.apply(source.points)
    if _FEW * len(p) < len(target.points):
        low, high = _reached(target)
        near = ((low <= p.max(axis=0)) & (high >= p.min(axis=0))).all(axis=1)
        if not near.all():
            out = np.zeros(shape)
            out[:, near] = coverage(source, target.only(near), S_target_source)
            return out
    cells, grains = (GrownCells() if grown is None else grown).of(target), _grains(p, target)
    hits, flat = np.zeros(shape[0] * shape[1]), ~np.isnan(target.plane[:, 0])
    for level in np.unique(target.level).tolist():
        which, at = cells.holders(_key_at(grains, level))
        asked = np.flatnonzero(flat[at])
        plane, on = target.plane[at[asked]], np.ones(len(at), bool)
        off = np.abs(np.einsum("ij,ij->i", p[which[asked]], plane[:, :3]) + plane[:, 3])
        on[asked] = off <= 2.0 * target.grain
        hits += np.bincount(source.owner[which[on]] * shape[1] + at[on], minlength=len(hits))
    total = np.bincount(source.owner, minlength=shape[0])
    return np.asarray(hits.reshape(shape) / np.maximum(total, 1)[:, None])


_FEW = 4
"""So many times as many points as of a source are looked at by what lies near the source alone."""


def _reached(target: ChunkShapes) -> tuple[Array, Array]:
    """Return corners of the boxes of the grown cells of each instance, (N, 3) each; from 0 to -1 where it has none."""
    edge = target.grain * 2.0**target.level
    low, high = np.zeros((len(edge), 3)), np.full((len(edge), 3), -1.0)
    first = np.flatnonzero(np.diff(target.occupied_owner, prepend=-1))
    held = target.occupied_owner[first]
    for axis, shift in enumerate((2 * _BITS, _BITS, 0)):
        cell = (target.occupied >> shift & (1 << _BITS) - 1) - _HALF
        low[held, axis] = (np.minimum.reduceat(cell, first) + _SPAN[0]) * edge[held]
        high[held, axis] = (np.maximum.reduceat(cell, first) + _SPAN[-1] + 1) * edge[held]
    return low, high


_KEPT_BYTES = 128 << 20
"""Those of some 280 chunks with a dozen things: of a place that many sessions saw, all are asked for in turn."""


@dataclass(frozen=True)
class _Grown:
    """The cells within the tolerance of each instance of a chunk."""

    shapes: ChunkShapes
    keys: Ints
    """Ascending, each once. Shape (G,)."""
    start: NDArray[np.int32]
    """Where the instances of each begin among `owner`. Shape (G + 1,)."""
    owner: NDArray[np.int32]
    """Shape (O,)."""

    def find(self, keys: Ints) -> tuple[Ints, Ints]:
        """Return which of some keys are those of cells, and the numbers of these. Shape (F,) each."""
        at = np.searchsorted(self.keys, keys)
        at[at == len(self.keys)] = 0
        found = np.flatnonzero(self.keys[at] == keys)
        return found, at[found]

    def holders(self, keys: Ints) -> tuple[Ints, NDArray[np.int32]]:
        """Return which of some keys lie within the tolerance of an instance, and of which one. Shape (H,) each."""
        found, at = self.find(keys)
        times = self.start[at + 1] - self.start[at]
        offset = np.repeat(self.start[at] - (np.cumsum(times) - times), times)
        return np.repeat(found, times), self.owner[np.arange(len(offset)) + offset]


class GrownCells(LruCache[int, _Grown]):
    """Grown cells of the chunks that were compared last: they take more memory than all else of a chunk."""

    def __init__(self) -> None:
        super().__init__(_KEPT_BYTES, lambda g: g.keys.nbytes + g.start.nbytes + g.owner.nbytes, KEPT_TURNS)

    def of(self, shapes: ChunkShapes) -> _Grown:
        """Return the cells within the tolerance of each instance."""
        return self.get(id(shapes)) or self.put(id(shapes), _grown(shapes))


def _grown(shapes: ChunkShapes) -> _Grown:
    start = np.searchsorted(shapes.occupied_owner, np.arange(len(shapes.local_id) + 1))
    parts = [_distinct((shapes.occupied[i:j, None] + _REACH).ravel()) for i, j in pairwise(start)]
    keys = _stack(parts, np.int64)
    owner = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in parts])
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    return _Grown(shapes, keys[first], np.append(first, len(keys)).astype(np.int32), owner[order])


def _distinct(keys: Ints) -> Ints:
    """Return keys in order, each once: what `np.unique` returns, in a twentieth of the time."""
    keys = np.sort(keys)
    first = np.ones(len(keys), bool)
    np.not_equal(keys[1:], keys[:-1], out=first[1:])
    return np.asarray(keys[first])


def _own_grid(points: Array, grain: float, crowd: float, at_least: int) -> tuple[int, Ints, Ints]:
    """Return the finest level whose cells the points fill: (level, occupied cells (M, 3), one point of each (M,))."""
    for level in range(at_least, LEVELS):
        cell = np.floor(points / (grain * 2.0**level)).astype(np.int64)
        _, first = np.unique(_key(cell, 0), return_index=True)
        if len(points) >= crowd * len(first) or level == LEVELS - 1:
            break
    return level, cell[first], first


def _grains(points: Array, shapes: ChunkShapes) -> Ints:
    """Return the finest cells that points in the frame of a chunk lie in. Shape (P, 3) -> (3, P)."""
    return np.asarray(np.floor(points.T / shapes.grain).astype(np.int64))


def _key_at(grains: Ints, level: int) -> Ints:
    """Return keys of the cells of a level that finest ones lie in: twice as large ones from level to level. Shape
    (3, P) -> (P,).
    """
    return _key((grains >> level).T, level)


def _key(cells: Ints, level: int) -> Ints:
    x, y, z = np.minimum(np.maximum(cells.T + _HALF, 0), 2 * _HALF - 1)
    return np.asarray(((level << _BITS | x) << _BITS | y) << _BITS | z, dtype=np.int64)


def seen_xyxy(boxes: Sequence[NDArray[np.float32]], image_size: tuple[int, int], blind: float) -> Array:
    """Return the part of the image in which anything is seen: its borders, or further in by at most the share `blind`
    where no box reaches them. Boxes xyxy of shape (V, 4) each, (height, width) -> (4,).
    """
    height, width = image_size
    image = np.array([0.0, 0.0, width - 1.0, height - 1.0])
    reached = [b for b in boxes if len(b)]
    if not reached:
        return image
    every = np.concatenate(reached).astype(np.float64)
    found = np.concatenate([every[:, :2].min(axis=0), every[:, 2:].max(axis=0)])
    inset = blind * np.array([width, height, width, height])
    return np.asarray(np.where(np.abs(found - image) <= inset, found, image))


def _truncated(node: LocalNode, seen: Array, border: float) -> float:
    b = node.boxes_xyxy
    cut = (b[:, :2] <= seen[:2] + border).any(axis=1) | (b[:, 2:] >= seen[2:] - border).any(axis=1)
    weight = node.areas_px.astype(np.float64)
    return float(weight[cut].sum() / max(float(weight.sum()), 1.0))


def _stack(parts: Sequence[NDArray[np.int64]], dtype: type) -> NDArray[np.int64]:
    return np.concatenate(parts).astype(dtype) if parts else np.zeros(0, dtype)
