"""A global instance from its local instances: points, box, feature, confidence, best view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.colors import Swatch, dominant_colors
from list3r.memory.core.description.describe import shape_word
from list3r.memory.core.geometry import Array, OrientedBox, Sim3
from list3r.memory.core.records import BestView
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.voxels import ChunkShapes
from list3r.memory.library.relations.instance_geometry import InstanceGeometry, fit_box, without_strays


@dataclass(frozen=True)
class DeriveSettings:
    """How the extent of an instance is measured, and which is its best view."""

    max_points: int = 1000
    """Surface points kept for boxes and relations."""
    trim: float = 0.01
    """Share of points outside the box at either end of each axis."""
    ends: float = 0.1
    """Share of the points left out at either end, as it is measured how flat it is."""
    flat: float = 0.15
    """Thickness over the second longest extent of what is flat."""
    confirmed: float = 0.25
    """Share of the members that must have a surface at a point of a small instance of at least four whole views."""
    small_m: float = 0.5
    """Diagonal of a small instance; of a larger one each chunk sees another part."""
    whole_views: int = 4
    """Whole views from which members vote on points,"""
    whole_share: float = 0.7
    """where this share of the members are whole views;"""
    least_kept: float = 0.3
    """nothing is dropped where less than this share of the points would be kept."""
    agreed: float = 0.7
    """Share of the whole views of a small instance, by their frames, whose own ends are no further out than its box."""
    cut: float = 0.25
    """Weight of a view that the image's border cuts, as the best one is chosen."""
    hidden: float = 0.2
    """Weight of a view in which hardly anything of it is visible."""
    border_px: float = 3.0
    """A box that comes this near to the border of what is seen is cut by it."""


@dataclass(frozen=True)
class Member:
    """One local instance of an instance."""

    shapes: ChunkShapes
    at: int
    """Position in the chunk's shapes."""
    S_world_chunk: Sim3
    dropped: NDArray[np.bool_]
    """Points of the chunk's shapes that belong to something else. Shape (R,)."""

    def own(self) -> NDArray[np.int64]:
        """Return positions of the points of the chunk's shapes that are its surface. Shape (M,)."""
        start, stop = np.searchsorted(self.shapes.owner, [self.at, self.at + 1])
        return np.asarray(start + np.flatnonzero(~self.dropped[start:stop]))


@dataclass(frozen=True)
class DerivedInstance:
    """A global instance before it is written."""

    geometry: InstanceGeometry
    box: OrientedBox
    """The box that is reported; the box of its geometry, for relations, holds all of its points."""
    feature: NDArray[np.float32]
    """Unit length. Shape (D,)."""
    frames: NDArray[np.int64]
    """Session id and Frame.index of every frame in which it is seen, in order. Shape (F, 2)."""
    best_view: BestView | None
    shape: str
    """Its shape in a word, see `memory.describe`."""
    swatches: tuple[Swatch, ...]
    """Its colours, the commonest first."""
    dynamic: bool = False
    """Whether it was seen moving; its geometry is then where it was last."""
    resting: bool = True
    """Whether it is still there, so that it has relations."""


def derived_instance(
    instance_id: int,
    keys: Sequence[Key],
    chunks: Mapping[int, tuple[ChunkShapes, Sim3, NDArray[np.bool_]]],
    component: int,
    *,
    upright: bool,
    settings: DeriveSettings,
) -> DerivedInstance:
    """Return all that follows from the local instances of one instance; `chunks` are shapes, pose in the world and
    dropped points of theirs, `upright` says that z is up.
    """
    members = [Member(chunks[k][0], int(np.searchsorted(chunks[k][0].local_id, n)), *chunks[k][1:]) for k, n in keys]
    s = settings
    own = [m.own() for m in members]
    points = np.concatenate([m.S_world_chunk.apply(m.shapes.points[k]) for m, k in zip(members, own, strict=True)])
    rgb = np.concatenate([m.shapes.rgb[k] for m, k in zip(members, own, strict=True)])
    if len(points) == 0:
        points, rgb = members[0].S_world_chunk.apply(np.zeros((1, 3))), np.zeros((1, 3), np.uint8)
    owner = np.repeat(np.arange(len(members)), [len(k) for k in own])
    step = -(-len(points) // s.max_points)
    points, rgb, owner = points[::step], rgb[::step], owner[::step]
    keep = _confirmed(points, owner, members, s)
    points, rgb, owner = points[keep], rgb[keep], owner[keep]
    keep = without_strays(points)
    points, rgb, owner = points[keep], rgb[keep], owner[keep]
    frames = _frames(members)
    counts = np.array([m.shapes.seen_for(m.at) for m in members], dtype=np.float64)
    feature = np.average([m.shapes.feature[m.at] for m in members], axis=0, weights=np.maximum(counts, 1))
    box = fit_box(points, upright=upright, trim=s.trim)
    agreed = _agreed_box(box, points, owner, members, s, upright=upright)
    geometry = InstanceGeometry(
        id=instance_id,
        points=points,
        rgb=rgb,
        box=box,
        aabb=_aabb(points, s.trim),
        normal=_normal(members, points, s),
        flagged=float(np.average([m.shapes.structure[m.at] for m in members], weights=np.maximum(counts, 1))),
        component=component,
    )
    unit_feature = (feature / max(float(np.linalg.norm(feature)), 1e-12)).astype(np.float32)
    shape = shape_word((points - box.center) @ box.rotation, box.size, _metre(members))
    colors = dominant_colors(rgb)
    view = _best_view(members, s)
    return DerivedInstance(geometry, agreed, unit_feature, frames, view, shape, colors)


def _frames(members: Sequence[Member]) -> NDArray[np.int64]:
    """Return session id and index of the frames that show any of the members, in order. Shape (F, 2)."""
    seen = np.unique(np.concatenate([m.shapes.session_id << 40 | m.shapes.frames[m.at] for m in members]))
    return np.column_stack([seen >> 40, seen & (1 << 40) - 1])


def _metre(members: Sequence[Member]) -> float:
    """Return what a metre is about in the world, as its chunks tell."""
    return float(np.median([m.shapes.unit * float(m.S_world_chunk.scale) for m in members]))


def _aabb(points: Array, trim: float) -> Array:
    return np.asarray(np.quantile(points, [trim, 1.0 - trim], axis=0))


def _agreed_box(
    box: OrientedBox,
    points: Array,
    owner: NDArray[np.int64],
    members: Sequence[Member],
    s: DeriveSettings,
    *,
    upright: bool,
) -> OrientedBox:
    """Return the box of an instance, that of a small one up to the ends on which its whole views agree.

    The depth of each chunk is off in a way of its own, so what all saw together is larger than what any of them saw.
    Members that the image's border cut have no say.
    """
    cut = np.array([m.shapes.truncated[m.at] >= 0.5 for m in members])
    whole = [n for n in np.flatnonzero(~cut).tolist() if (owner == n).sum() >= _LEAST_POINTS]
    size = float(np.median([m.shapes.size[m.at] / m.shapes.unit for m in members]))
    if len(whole) < 2 or 1.0 - cut.mean() < s.whole_share or size > s.small_m:
        return box
    along = (points - box.center) @ box.rotation
    ends = np.array([np.quantile(along[owner == n], [s.trim, 1.0 - s.trim], axis=0) for n in whole])
    weight = np.minimum([len(members[n].shapes.frames[members[n].at]) for n in whole], _MOST_FRAMES).astype(np.float64)
    low, high = -_weighted_quantile(-ends[:, 0], weight, s.agreed), _weighted_quantile(ends[:, 1], weight, s.agreed)
    inside = ((along >= low) & (along <= high)).all(axis=1)
    return fit_box(points[inside], upright=upright, trim=s.trim) if inside.any() else box


_LEAST_POINTS, _MOST_FRAMES = 10, 30
"""Points of a view that has a say about ends, and frames from which no more say comes."""


def _weighted_quantile(values: Array, weight: Array, share: float) -> Array:
    """Return the quantile of each column of values, (N, D), that weigh (N,); between two views it goes from one to the
    other, as NumPy's does not for weights. Shape (D,).
    """
    order = np.argsort(values, axis=0, kind="stable")
    w = weight[order]
    at = np.cumsum(w, axis=0) - 0.5 * w
    ranked = np.take_along_axis(values, order, axis=0)
    return np.array([np.interp(share * weight.sum(), at[:, d], ranked[:, d]) for d in range(values.shape[1])])


def _confirmed(
    points: Array, owner: NDArray[np.int64], members: Sequence[Member], s: DeriveSettings
) -> NDArray[np.int64]:
    """Return points that enough of the members agree on: what a single chunk added to an instance that others saw whole
    is a bit of something else. Members that the image's border cut have no say, and where they are many nothing is
    dropped.
    """
    whole = np.array([m.shapes.truncated[m.at] < 0.5 for m in members])
    need = int(np.ceil(s.confirmed * whole.sum()))
    size = float(np.median([m.shapes.size[m.at] / m.shapes.unit for m in members]))
    if whole.sum() < s.whole_views or whole.mean() < s.whole_share or need < 2 or size > s.small_m:
        return np.arange(len(points))
    grain = 2.0 * members[0].shapes.grain * float(members[0].S_world_chunk.scale)
    cells = np.floor((points - points.min(axis=0)) / grain).astype(np.int64) + 1
    shape = cells.max(axis=0) + 2
    flat = np.ravel_multi_index(tuple(cells.T), tuple(shape))
    reach = np.array([np.ravel_multi_index((i + 1, j + 1, k + 1), tuple(shape)) for i, j, k in _NEAR]) - int(
        np.ravel_multi_index((1, 1, 1), tuple(shape))
    )
    seen = np.unique((flat[:, None] + reach) * len(members) + owner[:, None])
    held, count = np.unique(seen[whole[seen % len(members)]] // len(members), return_counts=True)
    at = np.minimum(np.searchsorted(held, flat), len(held) - 1)
    keep = np.flatnonzero((held[at] == flat) & (count[at] >= need))
    return keep if len(keep) >= s.least_kept * len(points) else np.arange(len(points))


_NEAR = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]


def _normal(members: Sequence[Member], points: Array, s: DeriveSettings) -> Array | None:
    """Return the normal of an instance that is flat in most of its views and as a whole, towards the cameras that saw
    it.
    """
    flat = [m for m in members if not np.isnan(m.shapes.plane[m.at]).any()]
    if 2 * len(flat) < len(members) or len(points) < 3:
        return None
    center = np.median(points, axis=0)
    axes = np.linalg.svd(points - center, full_matrices=False)[2]
    extent = np.ptp(np.quantile((points - center) @ axes.T, [s.ends, 1.0 - s.ends], axis=0), axis=0)
    if extent[2] > s.flat * extent[1]:
        return None
    toward = np.sum([m.S_world_chunk.rotation @ m.shapes.plane[m.at, :3] for m in flat], axis=0)
    return np.asarray(axes[2] if axes[2] @ toward >= 0 else -axes[2])


def _best_view(members: Sequence[Member], s: DeriveSettings) -> BestView | None:
    """Return the frame with the largest mask, weighted down where the border cuts it or something hides it."""
    best: tuple[float, int, int] | None = None
    box: Array = np.zeros(4)
    for m in members:
        b = m.shapes.boxes_xyxy[m.at].astype(np.float64)
        if len(b) == 0:
            continue
        seen = m.shapes.seen
        cut = (b[:, :2] <= seen[:2] + s.border_px).any(axis=1) | (b[:, 2:] >= seen[2:] - s.border_px).any(axis=1)
        visible = s.hidden + (1.0 - s.hidden) * m.shapes.visible_fraction[m.at]
        score = m.shapes.areas_px[m.at] * np.where(cut, s.cut, 1.0) * visible
        n = int(np.argmax(score))
        rank = (-float(score[n]), m.shapes.session_id, int(m.shapes.frames[m.at][n]))
        if best is None or rank < best:
            best, box = rank, b[n]
    if best is None:
        return None
    x0, y0, x1, y1 = (float(x) for x in box)
    return BestView(best[1], best[2], (x0, y0, x1, y1))
