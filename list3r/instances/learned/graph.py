"""The graph of a cloud's pieces: features of each piece and of each border."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud, key_shift, neighbour_pairs, pack, unpack
from list3r.instances.geometric.features import lab_of
from list3r.instances.geometric.fusion import View
from list3r.instances.geometric.kernels import meeting, sums_by
from list3r.instances.learned.kernels import contact_sums, extremes, seen_across, touching

Float = NDArray[np.float32]

NODE_FEATURES = 26
EDGE_FEATURES = 24
REACH_PX = 3
"""Pixels between the two compared sides of a border in a view; depth is least certain right at it."""
COMPUTED_REACHES = 2
"""Times this distance that the other side is searched in computed depth, which has gaps at outlines."""


@dataclass(frozen=True)
class Surroundings:
    """Frame and units of the features."""

    up: NDArray[np.float64]
    """Upward direction, chunk frame. Shape (3,)."""
    unit: float
    """Chunk units per metre."""
    camera_height: float
    """Median of the cameras along `up`, chunk units."""
    computed: bool
    """True where depth was computed, not read by a sensor."""


@dataclass(frozen=True)
class ChunkSurface:
    """A cloud of N voxels with the inputs of its features, computed once."""

    cloud: Cloud
    views: Sequence[View]
    around: Surroundings
    pairs: tuple[NDArray[np.int32], NDArray[np.int32]]
    """Voxels that are neighbours. Shape (M,) each."""
    lab: Float
    """Colours of the voxels, Lab with lightness halved. Shape (N, 3)."""
    view_lab: tuple[Float, ...]
    """Colours of the views likewise. Shape (h, w, 3) each."""


def chunk_surface(cloud: Cloud, views: Sequence[View], around: Surroundings) -> ChunkSurface:
    """Return a cloud with its neighbours and colours."""
    shown = [lab_of(v.rgb.reshape(-1, 3).astype(np.float32)).reshape(v.rgb.shape) for v in views]
    left, right = (rows.astype(np.int32) for rows in neighbour_pairs(cloud.keys, 1))
    return ChunkSurface(cloud, views, around, (left, right), lab_of(cloud.rgb), tuple(shown))


@dataclass(frozen=True)
class PieceGraph:
    """P pieces and E undirected borders between them."""

    nodes: Float
    """Features of the pieces. Shape (P, NODE_FEATURES)."""
    left: NDArray[np.int64]
    """Piece on one side of each border, less than `right`. Shape (E,)."""
    right: NDArray[np.int64]
    edges: Float
    """Features of the borders, seen from the left. Shape (E, EDGE_FEATURES)."""
    weight: Float
    """Length of the borders, neighbouring voxels. Shape (E,)."""
    moments: Float
    """Voxels, mean place (x, y, z) and covariance (xx, yy, zz, xy, xz, yz) of the pieces, metres, upright. (P, 10)."""

    def reversed_edges(self) -> Float:
        """Return the features of the borders as seen from the right. Shape (E, EDGE_FEATURES)."""
        out = self.edges.copy()
        for a, b in _SWAPPED:
            out[:, [a, b]] = out[:, [b, a]]
        out[:, _TURNED] *= -1.0
        return out


_SWAPPED = ((4, 5), (12, 13), (18, 19))
"""Columns that trade places when a border is seen from its other side."""
_TURNED = [14, 15, 16]
"""Columns that change their sign then."""


def piece_graph(surface: ChunkSurface, labels: NDArray[np.int32], doublings: int = 1) -> PieceGraph:
    """Return the graph of pieces; `labels` (N,) is each voxel's piece, -1 for none.

    Pieces are neighbours over gaps, too, that depth edges leave: within two cells of the voxel's size doubled so often.
    """
    count = int(labels.max(initial=-1)) + 1
    stats = _Pieces(surface, labels, count)
    *pairs, code = touching(labels, *surface.pairs, count)
    meets = _Touching((pairs[0], pairs[1]), code)
    codes = _codes(surface.cloud, labels, meets, count, doublings)
    left, right = codes // count, codes % count
    contact = _contact(surface, labels, meets, codes)
    seen = _seen(surface, labels, codes, count)
    edges = np.column_stack([contact, _between(stats, left, right), seen, _contrast(stats, left, right)])
    weight = np.expm1(contact[:, 0]) + 1.0
    front = np.bincount(left, seen[:, 0] * seen[:, 1], count) + np.bincount(right, seen[:, 0] * seen[:, 2], count)
    behind = np.bincount(left, seen[:, 0] * seen[:, 2], count) + np.bincount(right, seen[:, 0] * seen[:, 1], count)
    total = np.maximum(np.bincount(left, seen[:, 0], count) + np.bincount(right, seen[:, 0], count), 0.1)
    nodes = np.column_stack([stats.features(), front / total, behind / total])
    tables = [a.astype(np.float32) for a in (nodes, edges, weight, stats.moments())]
    return PieceGraph(tables[0], left, right, tables[1], tables[2], tables[3])


class _Pieces:
    """Means and moments of the pieces of a cloud, in metres and upright."""

    def __init__(self, surface: ChunkSurface, labels: NDArray[np.int32], count: int) -> None:
        cloud, around, known = surface.cloud, surface.around, labels >= 0
        self._own = labels[known].astype(np.int64)
        self.count, self._around = count, around
        frame = upright_frame(around.up)
        points = (cloud.points[known] @ frame.T) / around.unit
        self._floor = float(np.quantile(points[:, 2], 0.01)) if len(points) else 0.0
        self.size = np.maximum(np.bincount(self._own, minlength=count), 1).astype(np.float64)
        self.center = self._mean(points)
        self.normal = self._mean(cloud.normals[known] @ frame.T)
        length = np.linalg.norm(self.normal, axis=1, keepdims=True)
        self.coherence = length[:, 0]
        self.normal = self.normal / np.maximum(length, 1e-6)
        lab = surface.lab[known]
        self.lab = self._mean(lab)
        away = lab - self.lab[self._own]
        self.lab_spread = np.sqrt(self._mean(away**2))
        self.sigma = self._mean(cloud.sigma[known][:, None])[:, 0] / around.unit
        offset = points - self.center[self._own]
        self._cov = np.stack([self._mean(offset * offset[:, k : k + 1]) for k in range(3)], axis=1)
        self.low, self.high = self._extremes(points[:, 2])
        self.voxel = cloud.voxel / around.unit

    def _mean(self, values: NDArray[np.generic]) -> NDArray[np.float64]:
        return sums_by(self._own, np.ascontiguousarray(values), self.count) / self.size[:, None]

    def _extremes(self, z: NDArray[np.generic]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        low, high = extremes(self._own, np.ascontiguousarray(z, np.float64), self.count)
        return np.minimum(low, high), np.maximum(low, high)

    def moments(self) -> NDArray[np.float64]:
        """Size, place and spread. Shape (P, 10)."""
        c = self._cov
        spread = [c[:, 0, 0], c[:, 1, 1], c[:, 2, 2], c[:, 0, 1], c[:, 0, 2], c[:, 1, 2]]
        return np.column_stack([self.size, self.center, *spread])

    def features(self) -> NDArray[np.float64]:
        """Features of each piece. Shape (P, NODE_FEATURES - 2)."""
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(self._cov), 0.0))
        eye = self._around.camera_height / self._around.unit
        wide = np.sqrt(np.maximum(self._cov[:, 0, 0] + self._cov[:, 1, 1], 0.0))
        area = self.size * self.voxel**2
        tall = self.high - self.low
        return np.column_stack(
            [
                np.log(self.size) / 4.0,
                np.log(area + 1e-4) / 4.0,
                self.normal[:, 2],
                np.abs(self.normal[:, 2]),
                self.coherence,
                np.clip(spread * 5.0, 0, 4),
                np.log(spread[:, 0] * 100 + 0.1),
                np.log(spread[:, 1] * 20 + 0.1),
                np.log(spread[:, 2] * 10 + 0.1),
                np.clip(wide * 3.0, 0, 4),
                np.clip(tall * 2.0, 0, 5),
                self.low - self._floor,
                self.high - self._floor,
                self.center[:, 2] - eye,
                self.lab / 40.0,
                np.clip(self.lab_spread / 15.0, 0, 3),
                np.clip(self.sigma * 100.0, 0, 5),
                np.full(self.count, float(self._around.computed)),
            ]
        )


def upright_frame(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation into a frame whose third axis is `up`. Shape (3, 3)."""
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


@dataclass(frozen=True)
class _Touching:
    """Pairs of neighbouring voxels of different pieces."""

    pairs: tuple[NDArray[np.int32], NDArray[np.int32]]
    """The voxel of the lesser piece, and that of the greater. Shape (T,) each."""
    code: NDArray[np.int64]
    """Lesser piece times the number of pieces plus the greater. Shape (T,)."""


MOST_IN_TABLE = 10_000
"""Pieces up to which pairs of them are marked in a table, which is faster than sorting them."""


def _codes(cloud: Cloud, labels: NDArray[np.int32], meets: _Touching, count: int, doublings: int) -> NDArray[np.int64]:
    """Codes of pieces that touch or come near each other, ascending. Shape (E,)."""
    if count > MOST_IN_TABLE:
        found = np.sort(np.concatenate([meets.code, *_near_codes(cloud, labels, count, doublings)]))
        return np.asarray(found[np.diff(found, prepend=-1) != 0])
    table = np.zeros(-(-count * count // 8) * 8, bool)
    table[meets.code] = True
    for codes in _near_codes(cloud, labels, count, doublings):
        table[codes] = True
    word = np.flatnonzero(table.view(np.uint64))
    row, place = np.nonzero(table.reshape(-1, 8)[word])
    return np.asarray(8 * word[row] + place, np.int64)


def _near_codes(cloud: Cloud, labels: NDArray[np.int32], count: int, doublings: int) -> Iterator[NDArray[np.int64]]:
    """Codes of pieces that come within two cells of a coarser grid: over gaps that depth edges leave."""
    known = np.flatnonzero(labels >= 0)
    cell = pack(unpack(cloud.keys[known]) >> doublings)
    order = np.lexsort((labels[known], cell))
    key, own = cell[order], labels[known][order].astype(np.int64)
    fresh = np.flatnonzero((np.diff(key, prepend=-1) != 0) | (np.diff(own, prepend=-1) != 0))
    key, own = key[fresh], own[fresh]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    last = np.append(first[1:], len(key)) - 1
    cells = key[first]
    span = (-1, 0, 1)
    half = [(i, j, k) for i in span for j in span for k in span if (i, j, k) >= (0, 0, 0)]
    for offset in half:
        here, there = meeting(cells, key_shift(offset))
        for mine in (first, last):
            for theirs in (first, last):
                a, b = own[mine[here]], own[theirs[there]]
                yield (np.minimum(a, b) * count + np.maximum(a, b))[a != b]


def _contact(
    surface: ChunkSurface, labels: NDArray[np.int32], meets: _Touching, codes: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Features of the voxels on both sides of each border. Shape (E, 10)."""
    cloud, at = surface.cloud, np.searchsorted(codes, meets.code)
    held = cloud.points, cloud.normals, surface.lab, cloud.sigma
    sums = contact_sums(meets.pairs, at, held, np.float32(cloud.voxel), len(codes))
    size = sums[:, 0]
    mean = sums / np.maximum(size, 1.0)[:, None]
    count = int(labels.max(initial=-1)) + 1
    outline = np.sqrt(np.maximum(np.bincount(labels[labels >= 0], minlength=count), 1.0))
    return np.column_stack(
        [
            np.log1p(size),
            mean[:, 1:4],
            size / outline[codes // count] / 4.0,
            size / outline[codes % count] / 4.0,
            mean[:, 4],
            mean[:, 5:7] / 15.0,
            mean[:, 7] / surface.around.unit * 100.0,
        ]
    )


def _between(stats: _Pieces, left: NDArray[np.int64], right: NDArray[np.int64]) -> NDArray[np.float64]:
    """Geometry between two pieces. Shape (E, 7)."""
    way = stats.center[right] - stats.center[left]
    far = np.maximum(np.linalg.norm(way, axis=1), 1e-6)
    n, m = stats.normal[left], stats.normal[right]
    ahead, back = (way * n).sum(axis=1), -(way * m).sum(axis=1)
    share = np.log(stats.size[right] / stats.size[left]) / 3.0
    return np.column_stack(
        [
            (n * m).sum(axis=1),
            np.log(far * 10.0 + 0.1),
            np.clip(ahead * 20.0, -4, 4),
            np.clip(back * 20.0, -4, 4),
            way[:, 2] / far,
            np.clip((stats.low[right] - stats.low[left]) * 3.0, -4, 4),
            share,
        ]
    )


def _contrast(stats: _Pieces, left: NDArray[np.int64], right: NDArray[np.int64]) -> NDArray[np.float64]:
    """How unlike the colours of two pieces are. Shape (E, 3)."""
    away = np.abs(stats.lab[right] - stats.lab[left]) / 15.0
    return np.column_stack([np.clip(away[:, 0], 0, 4), np.clip(np.hypot(away[:, 1], away[:, 2]), 0, 4)])


def _seen(
    surface: ChunkSurface, labels: NDArray[np.int32], codes: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Views of each border: number of observations, depth order, step of colour. (E, 5)."""
    table, sums = np.append(labels, np.int32(-1)), np.zeros((len(codes), 5))
    most = COMPUTED_REACHES if surface.around.computed else 1
    for view, lab, index in zip(surface.views, surface.view_lab, surface.cloud.index, strict=True):
        image, limit = table[index], 6.0 * view.reading + 0.015 * view.depth
        for apart in ((REACH_PX, 0, most), (0, REACH_PX, most)):
            seen_across(image, (view.depth, limit, lab), apart, codes, count, sums)
    mean = sums / np.maximum(sums[:, :1], 1.0)
    return np.column_stack([np.log1p(sums[:, 0]), mean[:, 1:3], mean[:, 3:] / 15])
