"""What carries what: whether two clusters of a cut are parts of one thing though no border told so.

Thin legs, posts and feet are seen in bits that are too small, or too far from what they carry, for a graph of borders.
What tells them is how both lie to one another, what either stands on or hangs at, and whether views look through the
space under and between them; a small network is asked (docs/decisions/0158-what-carries-a-thing.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.instances.geometric.cloud import component_numbers
from list3r.instances.learned.agglomeration import STRONGEST
from list3r.instances.learned.graph import ChunkSurface, upright_frame
from list3r.instances.learned.network import Weights, two_layers
from list3r.instances.learned.things import ThingVerdicts, names_of

Float = NDArray[np.float64]
Ints = NDArray[np.int64]

GROUPS = (
    ("chair", "armchair", "stool", "bench", "sofa", "pouf", "bed"),
    ("table", "desk", "counter", "nightstand"),
    ("lamp", "fan", "coat stand", "plant", "clothes"),
    ("shelf", "cupboard", "wardrobe", "chest of drawers", "fridge", "washing machine", "radiator"),
    ("monitor", "television", "computer", "laptop", "keyboard", "mouse"),
    ("picture", "mirror", "window", "blind", "curtain", "board", "panel", "clock", "door", "air conditioner"),
)
"""Names that carry alike."""
REACH_M = 0.35
"""Longest gap between two clusters of which the network is asked."""
LEAST_M = 0.2
"""Longest edge from which a thing may have legs of its own."""
LINK_M = 0.025
"""Distance between voxels of one bit,"""
LEAST_BIT = 6
"""and their number from which it counts."""
MOST_BOUND = 3000
"""Voxels up to which what was taken for structure may be a foot."""
MOST_POINTS = 300
"""Points of a cluster that are looked at."""
TOUCH_M = 0.04
UP, SIDE = 0.6, 0.4
MOST = 20.0
"""Features are cut at this."""
CARRIES = "carry.mean"
"""Name of the first array of the network; weights without it join nothing."""


@dataclass(frozen=True)
class CarrySettings:
    """When what carries a thing joins it."""

    listed_from: float = 0.6
    """Things that are at least so probably one whole may have bits."""
    sure: float = 0.5
    """Probability from which a bit is a part of a thing."""


class Borders(NamedTuple):
    """What lies between the clusters of a cut. Shape (E,) each."""

    left: Ints
    right: Ints
    affinity: NDArray[np.float32]
    weight: NDArray[np.float32]


@dataclass(frozen=True)
class Clusters:
    """C clusters of a cut and bits of voxels that are of none."""

    labels: NDArray[np.int32]
    """Cluster of each voxel, -1 for none. Shape (N,)."""
    count: int
    structure: Float
    whole: Float
    """Probabilities; 0 for bits. Shape (C,) each."""
    groups: Float
    """Probabilities of `GROUPS`. Shape (C, G)."""
    borders: tuple[Ints, NDArray[np.float64]]
    """Codes (lesser cluster times `count` plus the greater), ascending, and their mean affinity. Shape (B,) each."""


@dataclass(frozen=True)
class CarryPairs:
    """Q pairs of which the network is asked whether they are parts of one thing."""

    thing: Ints
    """Shape (Q,)."""
    bit: Ints
    x: NDArray[np.float32]
    """Shape (Q, F)."""


def clusters_of(
    surface: ChunkSurface,
    labels: NDArray[np.int32],
    told: ThingVerdicts,
    names: tuple[str, ...],
    borders: Borders,
) -> Clusters:
    """Return the clusters of a cut (T of them) and, numbered on, connected bits of voxels of none."""
    count, labels = len(told.structure), labels.copy()
    rows = np.flatnonzero(labels < 0)
    if len(rows):
        pairs = cKDTree(surface.cloud.points[rows]).query_pairs(LINK_M * surface.around.unit, output_type="ndarray")
        number, _ = component_numbers(pairs[:, 0], pairs[:, 1], len(rows))
        size = np.bincount(number)
        fresh = np.where(size >= LEAST_BIT, np.cumsum(size >= LEAST_BIT) - 1 + count, -1)
        labels[rows] = fresh[number]
        bits = int((size >= LEAST_BIT).sum())
    else:
        bits = 0
    total = count + bits
    groups = np.stack([told.names[:, [n in g for n in names]].sum(axis=1) for g in GROUPS], axis=1)
    a, b, score, weight = borders
    apart = a != b
    code = np.minimum(a, b)[apart] * total + np.maximum(a, b)[apart]
    codes, at = np.unique(code, return_inverse=True)
    mass = np.bincount(at, weight[apart])
    mean = np.bincount(at, np.clip(score, -STRONGEST, STRONGEST)[apart] * weight[apart]) / np.maximum(mass, 1e-6)
    none = np.zeros(bits)
    return Clusters(
        np.asarray(labels, np.int32),
        total,
        np.append(told.structure, none).astype(np.float64),
        np.append(told.whole, none).astype(np.float64),
        np.concatenate([groups, np.zeros((bits, len(GROUPS)))]),
        (codes, mean),
    )


def joined_by_carrying(
    surface: ChunkSurface,
    cut: tuple[NDArray[np.int32], ThingVerdicts],
    borders: Borders,
    weights: Weights,
    s: CarrySettings,
) -> NDArray[np.int32]:
    """Return the labels of a cut (N,) in which the bits that carry a thing are its own, the surest first."""
    labels, told = cut
    c = clusters_of(surface, labels, told, names_of(weights), borders)
    listed = (c.whole >= s.listed_from) & (c.structure <= 0.5)
    pairs = carry_pairs(surface, c, listed)
    x = np.clip(pairs.x, -MOST, MOST)
    odds = two_layers(weights, "carry.net", (x - weights["carry.mean"]) / weights["carry.std"])[:, 0].astype(np.float64)
    into = np.append(np.where(np.arange(c.count) < len(told.structure), np.arange(c.count), -1), -1)
    taken: set[int] = set()
    for row in np.argsort(-odds, kind="stable").tolist():
        bit, thing = int(pairs.bit[row]), int(pairs.thing[row])
        if 1.0 / (1.0 + np.exp(-odds[row])) < s.sure:
            break
        if bit not in taken and into[thing] != bit:
            taken.add(bit)
            into[into == (into[bit] if into[bit] >= 0 else bit)] = into[thing]
            into[bit] = into[thing]
    return np.asarray(into[c.labels], np.int32)


def carry_pairs(surface: ChunkSurface, c: Clusters, listed: NDArray[np.bool_]) -> CarryPairs:
    """Return the pairs that are asked about; `listed` (C,) are the things that are told."""
    place = _Place(surface, c)
    free = c.structure <= 0.5
    may = free | (place.size <= MOST_BOUND)
    things = np.flatnonzero(listed & free & (np.max(place.high - place.low, axis=1) >= LEAST_M) & (place.size > 0))
    found: list[tuple[int, int]] = []
    for t in things.tolist():
        near = (place.low < place.high[t] + REACH_M).all(axis=1) & (place.high > place.low[t] - REACH_M).all(axis=1)
        near &= may & (place.size > 0)
        near[t] = False
        near &= ~(
            listed & free & ((place.size > place.size[t]) | ((place.size == place.size[t]) & (np.arange(c.count) < t)))
        )
        found += [(t, k) for k in np.flatnonzero(near).tolist()]
    return place.described(found, listed)


class _Place:
    """The cloud upright in metres, and what each cluster is like there."""

    def __init__(self, surface: ChunkSurface, c: Clusters) -> None:
        around = surface.around
        self._surface, self._c = surface, c
        self._frame = upright_frame(around.up)
        self._points = (surface.cloud.points @ self._frame.T) / around.unit
        self._rise = surface.cloud.normals @ around.up
        self._floor = float(np.quantile(self._points[:, 2], 0.01)) if len(self._points) else 0.0
        order = np.argsort(c.labels, kind="stable")
        bounds = np.searchsorted(c.labels[order], np.arange(c.count + 1))
        self.size = np.diff(bounds)
        self.low, self.high = np.full((c.count, 3), np.inf), np.full((c.count, 3), -np.inf)
        self._sample: list[Ints] = []
        rng = np.random.default_rng(0)
        for k in range(c.count):
            rows = order[bounds[k] : bounds[k + 1]]
            if len(rows):
                self.low[k], self.high[k] = self._points[rows].min(axis=0), self._points[rows].max(axis=0)
            self._sample.append(rows if len(rows) <= MOST_POINTS else rng.choice(rows, MOST_POINTS, replace=False))
        self._alone: dict[int, Float] = {}
        self._trees: dict[int, cKDTree] = {}
        self._frames: dict[int, tuple[Float, Float, Float]] = {}
        bound = np.append(c.structure > 0.5, False)[c.labels]
        level = np.flatnonzero(self._rise > UP)[::2]
        wall = np.flatnonzero(bound & (np.abs(self._rise) < SIDE))[::3]
        lid = np.flatnonzero(bound & (self._rise < -UP))[::3]
        self._level, self._level_tree = level, _tree(self._points[level] * FLAT)
        self._wall, self._lid = _tree(self._points[wall]), _tree(self._points[lid])

    def tree(self, k: int) -> cKDTree:
        if k not in self._trees:
            self._trees[k] = cKDTree(self._points[self._sample[k]])
        return self._trees[k]

    def rectangle(self, k: int) -> tuple[Float, Float, Float]:
        """Middle, axes and half lengths of a cluster seen from above. Shapes (2,), (2, 2), (2,)."""
        if k not in self._frames:
            xy = self._points[self._sample[k]][:, :2]
            mean = xy.mean(axis=0)
            axes = np.linalg.eigh(np.cov((xy - mean).T) + 1e-9 * np.eye(2))[1] if len(xy) > 2 else np.eye(2)
            along = (xy - mean) @ axes
            low, high = np.quantile(along, [0.01, 0.99], axis=0)
            self._frames[k] = mean + axes @ ((low + high) / 2), axes, (high - low) / 2
        return self._frames[k]

    def alone(self, k: int) -> Float:
        """What a cluster is like by itself. Shape (A,)."""
        if k not in self._alone:
            c, rows = self._c, self._sample[k]
            p, rise = self._points[rows], self._rise[rows]
            lab = self._surface.lab[rows]
            half = self.rectangle(k)[2]
            thick = np.sqrt(max(float(np.linalg.eigvalsh(np.cov(p.T))[0]), 0.0)) if len(p) > 3 else 0.0
            self._alone[k] = np.array(
                [
                    np.log(self.size[k]),
                    *np.log(2 * half + 0.02),
                    np.log(self.high[k, 2] - self.low[k, 2] + 0.02),
                    np.log(thick + 0.005),
                    min(self.low[k, 2] - self._floor, 3.0),
                    min(self.high[k, 2] - self._floor, 3.0),
                    (rise > UP).mean(),
                    (np.abs(rise) < SIDE).mean(),
                    (rise < -UP).mean(),
                    self._standing(k),
                    _share_within(self._wall, p, 0.08),
                    _share_within(self._lid, p, 0.1),
                    lab.std(axis=0).mean() / 15.0,
                    c.structure[k],
                    c.whole[k],
                    *c.groups[k],
                ]
            )
        return self._alone[k]

    def _standing(self, k: int) -> float:
        """Share of a cluster's lowest part that has a level surface of something else close below."""
        p = self._points[self._sample[k]]
        foot = p[p[:, 2] < self.low[k, 2] + 0.06][:60]
        if not len(self._level) or not len(foot):
            return 0.0
        gap, at = self._level_tree.query(foot * FLAT, k=min(6, len(self._level)), distance_upper_bound=TOUCH_M)
        gap, at = np.asarray(gap).reshape(len(foot), -1), np.asarray(at).reshape(len(foot), -1)
        other = self._c.labels[self._level[np.minimum(at, len(self._level) - 1)]] != k
        return float((np.isfinite(gap) & other).any(axis=1).mean())

    def described(self, found: list[tuple[int, int]], listed: NDArray[np.bool_]) -> CarryPairs:
        """Return the pairs that are near each other, with what the network sees of them."""
        kept: list[tuple[int, int]] = []
        rows: list[list[float]] = []
        probes: list[Float] = []
        for t, k in found:
            gap, at = (np.asarray(v) for v in self.tree(t).query(self._points[self._sample[k]]))
            nearest = int(np.argmin(gap))
            if gap[nearest] > REACH_M:
                continue
            kept.append((t, k))
            here = self._points[self._sample[t][at[nearest]]]
            there = self._points[self._sample[k][nearest]]
            rows.append(self._between(t, k, gap, there - here))
            probes.append(here + np.linspace(0.15, 0.85, 6)[:, None] * (there - here))
        if not kept:
            return CarryPairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, self.features()), np.float32))
        pair = np.array(kept)
        between = self._seen(np.concatenate(probes)).reshape(len(kept), 6, 2).mean(axis=1)
        things = np.unique(pair[:, 0])
        under = np.zeros((self._c.count, 2))
        under[things] = self._under(things)
        table = np.column_stack([np.array(rows), between, under[pair[:, 0]], self._rivals(pair, np.array(rows)[:, 0])])
        own = np.array([np.concatenate([self.alone(t), self.alone(k)]) for t, k in kept])
        flags = np.column_stack([listed[pair[:, 1]], pair[:, 1] >= len(listed)])
        x = np.column_stack([own, table, flags])
        return CarryPairs(pair[:, 0], pair[:, 1], x.astype(np.float32))

    @staticmethod
    def features() -> int:
        """Columns of what the network sees."""
        return 2 * (16 + len(GROUPS)) + 19 + 6 + 2

    def _between(self, t: int, k: int, gap: Float, way: Float) -> list[float]:
        """How a bit lies to a thing. Length 19."""
        c, surface = self._c, self._surface
        middle, axes, half = self.rectangle(t)
        p = self._points[self._sample[k]]
        local = np.abs((p[:, :2] - middle) @ axes)
        inside = (local < half + 0.03).all(axis=1).mean()
        at = np.abs((p[:, :2].mean(axis=0) - middle) @ axes) / (half + 0.03)
        back = self.tree(k).query(self._points[self._sample[t]], distance_upper_bound=TOUCH_M)[0]
        away = surface.lab[self._sample[t]].mean(axis=0) - surface.lab[self._sample[k]].mean(axis=0)
        code = min(t, k) * c.count + max(t, k)
        row = int(np.searchsorted(c.borders[0], code))
        meets = row < len(c.borders[0]) and c.borders[0][row] == code
        rise_t, rise_k = self._rise[self._sample[t]].mean(), self._rise[self._sample[k]].mean()
        return [
            float(gap.min()),
            float(np.log(np.median(gap) + 0.02)),
            float((gap < TOUCH_M).mean()),
            float(np.isfinite(back).mean()),
            float(way[2]),
            float(np.hypot(way[0], way[1])),
            float(inside),
            *np.minimum(at, 3.0).tolist(),
            float(np.clip(self.high[k, 2] - self.low[t, 2], -1, 1)),
            float(np.clip(self.low[k, 2] - self.low[t, 2], -1.5, 1.5)),
            float(np.clip(self.high[k, 2] - self.high[t, 2], -1.5, 1.5)),
            float(np.log((self.size[k] + 1) / (self.size[t] + 1))),
            float(abs(away[0]) / 15.0),
            float(np.hypot(away[1], away[2]) / 15.0),
            float(meets),
            float(c.borders[1][row]) if meets else 0.0,
            float(np.prod(2 * half + 0.02)),
            float(rise_t - rise_k),
        ]

    def _rivals(self, pair: Ints, gap: Float) -> Float:
        """How much nearer than another thing a thing is to its bit, and how many others there are. Shape (Q, 2)."""
        out = np.zeros((len(pair), 2))
        for k in np.unique(pair[:, 1]).tolist():
            mine = np.flatnonzero(pair[:, 1] == k)
            for row in mine.tolist():
                others = gap[mine[mine != row]]
                out[row] = (float(others.min()) if len(others) else REACH_M) - gap[row], np.log1p(len(others))
        return out

    def _under(self, things: Ints) -> Float:
        """Share of the space under each thing that views look through, and that none sees. Shape (T, 2)."""
        grid = np.linspace(-0.8, 0.8, 5)
        probes, owner = [], []
        for row, t in enumerate(things.tolist()):
            tall = self.low[t, 2] - self._floor
            if tall < 0.08:
                continue
            middle, axes, half = self.rectangle(t)
            flat = np.stack(np.meshgrid(grid * half[0], grid * half[1]), axis=-1).reshape(-1, 2) @ axes.T + middle
            for depth in (0.04, 0.1, 0.2, 0.4):
                if depth < tall:
                    probes.append(np.column_stack([flat, np.full(len(flat), self.low[t, 2] - depth)]))
                    owner.append(np.full(len(flat), row))
        out = np.zeros((len(things), 2))
        if probes:
            at = np.concatenate(owner)
            seen = self._seen(np.concatenate(probes))
            total = np.maximum(np.bincount(at, minlength=len(things)), 1)
            for column in range(2):
                out[:, column] = np.bincount(at, seen[:, column], minlength=len(things)) / total
        return out

    def _seen(self, probes: Float) -> Float:
        """Whether some view looks through each point, and whether none sees it. Shape (S, 3) -> (S, 2)."""
        chunk = (probes * self._surface.around.unit) @ self._frame
        through, shown = np.zeros(len(probes), bool), np.zeros(len(probes), bool)
        for view in self._surface.views:
            T = np.linalg.inv(view.T_chunk_cam)
            p = chunk @ T[:3, :3].T + T[:3, 3]
            z = np.maximum(p[:, 2], 1e-6)
            u = np.rint(p[:, 0] / z * view.camera.fx + view.camera.cx)
            v = np.rint(p[:, 1] / z * view.camera.fy + view.camera.cy)
            h, w = view.depth.shape
            ok = np.flatnonzero((p[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < w) & (v < h))
            at = v[ok].astype(int), u[ok].astype(int)
            ahead = view.depth[at] - p[ok, 2]
            limit = 3.0 * view.reading[at] + 0.02 * self._surface.around.unit
            known = view.depth[at] > 0
            through[ok] |= known & (ahead > limit)
            shown[ok] |= known & (np.abs(ahead) <= limit)
        return np.column_stack([through, ~through & ~shown]).astype(np.float64)


FLAT = np.array([0.4, 0.4, 1.0])


def _tree(points: Float) -> cKDTree:
    return cKDTree(points if len(points) else np.full((1, 3), 1e6))


def _share_within(tree: cKDTree, points: Float, reach: float) -> float:
    return float(np.isfinite(tree.query(points, distance_upper_bound=reach)[0]).mean()) if len(points) else 0.0
