"""Test a candidate relation of two chunks against all their samples (not only those that it was estimated from).

A reconstruction model invents a relation between two similar places, and each side fits it well. It cannot invent the
rest of the two chunks: under a false relation, surfaces of one chunk are in the other's free space, and overlapping
instances are of different kinds. Both are counted here, in both directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.instance_similarity import InstanceSet
from list3r.frames.base import Camera
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameSamples

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

_SAME_SIDE = -0.2
"""Least cosine between two rays to a point for both to see the same side of its surface (a wall has two)."""


@dataclass(frozen=True)
class CrossSettings:
    """When a relation is contradicted."""

    points: int = 2500
    """Most points of one chunk that are compared with the other."""
    frames: int = 40
    """Most frames of a chunk in which they are compared."""
    columns: int = 16
    rows: int = 12
    """Grid of a frame in which depths are compared."""
    tolerance: float = 0.08
    """Depth difference that still agrees, as a share of the depth: noise, deformation and drift of a chunk."""
    least_confidence: float = 0.2
    """Samples of less confidence than this share of the chunk's median are ignored."""
    least_overlap: float = 0.03
    """Least share of a side's points on surfaces of the other side."""
    least_agreement: float = 0.75
    """Least share of points on a surface among those on a surface or in free space."""
    least_landed: int = 3
    """Least points of an instance on one of the other side for their kinds to be compared."""
    least_kinds: int = 6
    """Least number of overlapping instances for their kinds to count."""
    least_likeness: float = 0.5
    """Least mean rank (1 most similar, 0 least, 0.5 by chance) of overlapping instances."""


@dataclass(frozen=True)
class Side:
    """One chunk: its samples, its camera, its instances, and the local ids that move."""

    samples: FrameSamples
    camera: Camera
    instances: InstanceSet
    moving: frozenset[int] = frozenset()


@dataclass(frozen=True)
class CrossCheck:
    """Agreement of two chunks under a relation."""

    overlap: float
    """Share of a side's points on surfaces of the other, the larger of the two, in [0, 1]."""
    agreement: float
    """Points on surfaces among those on surfaces or in free space, the smaller of the two, in [0, 1]."""
    likeness: float
    """Mean rank of overlapping instances, in [0, 1]; NaN where too few overlap."""
    kinds: int
    """Number of overlapping instances."""

    def contradiction(self, settings: CrossSettings) -> str | None:
        """Return why the relation is false, or None."""
        if self.overlap < settings.least_overlap:
            return f"by it the chunks share no surface ({self.overlap:.0%} of their points)"
        if self.agreement < settings.least_agreement:
            return f"{1 - self.agreement:.0%} of the compared points are in free space of the other chunk"
        if self.likeness < settings.least_likeness:
            return f"the {self.kinds} instances that overlap are of different kinds ({self.likeness:.2f})"
        return None


def cross_check(
    S_v_u: Sim3,
    u: Side,
    v: Side,
    made_from: tuple[Ints, Ints] | None = None,
    settings: CrossSettings | None = None,
) -> CrossCheck:
    """Test a relation. Pairs of `made_from`, the frames of u and of v that it was estimated from, prove nothing."""
    chosen = settings or CrossSettings()
    known = made_from or (np.zeros(0, np.int64), np.zeros(0, np.int64))
    there = _compare(S_v_u, u, v, known[0], known[1], chosen)
    back = _compare(S_v_u.inverse(), v, u, known[1], known[0], chosen)
    likeness, kinds = _kinds(u.instances, v.instances, np.concatenate([there.landed, back.landed[:, ::-1]]), chosen)
    return CrossCheck(
        overlap=max(there.overlap, back.overlap),
        agreement=min(there.agreement, back.agreement),
        likeness=likeness,
        kinds=kinds,
    )


def shared_view(
    S_v_u: Sim3, u: Side, v: Side, frames: tuple[Ints, Ints], settings: CrossSettings | None = None
) -> float:
    """Return the largest share of surface that a frame of u and a frame of v share under a relation, in [0, 1].

    The smaller of the two shares of a pair of frames counts. `frames` are the compared frames of u and of v.
    """
    chosen = settings or CrossSettings()
    near = replace(chosen, points=4000, frames=10)
    part_u, part_v = _only(u, frames[0]), _only(v, frames[1])
    there, back = _seen(S_v_u, part_u, part_v, near), _seen(S_v_u.inverse(), part_v, part_u, near)
    return float(np.minimum(there, back.T).max()) if there.size and back.size else 0.0


def _only(side: Side, frames: Ints) -> Side:
    """Return ten of the given frames of a side, or fewer."""
    kept = frames[np.unique(np.linspace(0, len(frames) - 1, min(len(frames), 10)).astype(np.int64))]
    s = side.samples
    rows, cameras = np.isin(s.frame, kept), np.isin(s.camera_frames, kept)
    part = replace(
        s,
        frame=s.frame[rows],
        pixel=s.pixel[rows],
        points=s.points[rows],
        confidence=s.confidence[rows],
        instance=s.instance[rows],
        camera_frames=s.camera_frames[cameras],
        T_chunk_cam=s.T_chunk_cam[cameras],
    )
    return replace(side, samples=part)


def _seen(S: Sim3, source: Side, target: Side, settings: CrossSettings) -> Array:
    """Return the share of each source frame's points on the surfaces of each target frame. Shape (Gs, Gt)."""
    points, frame, _ = _points(source, settings)
    grids = _grids(target, settings)
    names = source.samples.camera_frames
    out = np.zeros((len(names), len(grids.frames)))
    if not len(points) or not out.size:
        return out
    there, row = S.apply(points), np.searchsorted(names, frame)
    agree, _, _ = _verdicts(there, grids, target.camera, settings)
    from_source = _unit(there - S.apply(source.samples.T_chunk_cam[row, :3, 3]))
    from_target = _unit(there[:, None] - target.samples.T_chunk_cam[None, :, :3, 3])
    same_side = np.einsum("ni,ngi->ng", from_source, from_target) > _SAME_SIDE
    np.add.at(out, row, agree & same_side)
    return np.asarray(out / np.maximum(np.bincount(row, minlength=len(names)), 1)[:, None])


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


@dataclass(frozen=True)
class _Comparison:
    """Comparison of a source's points with a target."""

    overlap: float
    agreement: float
    landed: Ints
    """Local ids (source, target) of the points on a surface, -1 for none. Shape (P, 2)."""


@dataclass(frozen=True)
class _Grids:
    """Samples of G frames as coarse depth images of R rows and C columns."""

    near: Array
    """Least depth along z in a cell and its neighbours, chunk units, infinite where unknown. Shape (G, R, C)."""
    far: Array
    """Greatest such depth, minus infinity where unknown. Shape (G, R, C)."""
    known: Mask
    """Where the cell itself holds a sample. Shape (G, R, C)."""
    instance: Ints
    """Instance of one sample in the cell, -1 for none. Shape (G, R, C)."""
    T_cam_chunk: Array
    """Shape (G, 4, 4)."""
    frames: Ints
    """Frame.index. Shape (G,)."""


def _compare(
    S: Sim3, source: Side, target: Side, skip_source: Ints, skip_target: Ints, settings: CrossSettings
) -> _Comparison:
    """Compare points of the source, moved by S, with the frames of the target; pairs of frames that are both skipped
    are left out."""
    points, frame, instance = _points(source, settings)
    grids = _grids(target, settings)
    if not len(points) or not len(grids.frames):
        return _Comparison(0.0, 1.0, np.zeros((0, 2), np.int64))
    there = S.apply(points)
    agree, through, label = _verdicts(there, grids, target.camera, settings)
    both = np.isin(frame, skip_source)[:, None] & np.isin(grids.frames, skip_target)[None]
    agree, through = agree & ~both, through & ~both
    on, off = agree.sum(axis=1), through.sum(axis=1)
    judged = (on + off) > 0
    share = on / np.maximum(on + off, 1)
    landed = np.where(agree, label, -1).max(axis=1)
    hit = share >= 0.5
    pairs = np.stack([instance[judged & hit], landed[judged & hit]], axis=1)
    agreement = float(share[judged].mean()) if judged.any() else 1.0
    return _Comparison(float((judged & hit).mean()), agreement, pairs.astype(np.int64))


def _usable(side: Side, settings: CrossSettings) -> Mask:
    s = side.samples
    sound = np.isfinite(s.points).all(axis=1) & ~np.isin(s.instance, sorted(side.moving)) & (s.confidence > 0)
    if not sound.any():
        return np.asarray(sound, bool)
    return np.asarray(sound & (s.confidence >= settings.least_confidence * np.median(s.confidence[sound])), bool)


def _points(side: Side, settings: CrossSettings) -> tuple[Array, Ints, Ints]:
    """Return points spread evenly over the samples, their frames and instances."""
    rows = np.flatnonzero(_usable(side, settings))
    if len(rows) > settings.points:
        rows = rows[np.linspace(0, len(rows) - 1, settings.points).astype(np.int64)]
    s = side.samples
    return s.points[rows].astype(np.float64), s.frame[rows], s.instance[rows].astype(np.int64)


def _grids(side: Side, settings: CrossSettings) -> _Grids:
    s, camera = side.samples, side.camera
    count = len(s.camera_frames)
    chosen = np.linspace(0, count - 1, min(count, settings.frames)).astype(np.int64)
    frames = s.camera_frames[chosen]
    T_cam_chunk: Array = np.linalg.inv(s.T_chunk_cam[chosen]).astype(np.float64)
    shape = len(frames), settings.rows, settings.columns
    near, far, instance = np.full(shape, np.inf), np.full(shape, -np.inf), np.full(shape, -1, np.int64)
    use = _usable(side, settings) & np.isin(s.frame, frames)
    if use.any():
        g = np.searchsorted(frames, s.frame[use])
        row, column = np.divmod(s.pixel[use].astype(np.int64), camera.width)
        at = g, row * settings.rows // camera.height, column * settings.columns // camera.width
        T = T_cam_chunk[g]
        z = np.einsum("ni,ni->n", T[:, 2, :3], s.points[use].astype(np.float64)) + T[:, 2, 3]
        np.minimum.at(near, at, z)
        np.maximum.at(far, at, z)
        np.maximum.at(instance, at, s.instance[use])
    known = np.isfinite(near)
    return _Grids(_spread(near, np.minimum), _spread(far, np.maximum), known, instance, T_cam_chunk, frames)


def _spread(depth: Array, take: np.ufunc) -> Array:
    """Return the least or greatest of each cell and its eight neighbours. Shape (G, R, C)."""
    edge = np.inf if take is np.minimum else -np.inf
    padded = np.pad(depth, ((0, 0), (1, 1), (1, 1)), constant_values=edge)
    r, c = depth.shape[1:]
    out = depth
    for y in range(3):
        for x in range(3):
            out = take(out, padded[:, y : y + r, x : x + c])
    return np.asarray(out)


def _verdicts(points: Array, grids: _Grids, camera: Camera, settings: CrossSettings) -> tuple[Mask, Mask, Ints]:
    """Return for each point and frame: on a surface, in free space, and the instance there. Shapes (N, G).

    A point is compared with the nearest and the farthest of the samples around it, so that edges between samples are no
    contradiction.
    """
    cam = np.einsum("gij,nj->ngi", grids.T_cam_chunk[:, :3, :3], points) + grids.T_cam_chunk[:, :3, 3]
    z = cam[..., 2]
    front = z > 1e-9
    safe = np.where(front, z, 1.0)
    with np.errstate(over="ignore"):
        x = np.floor((cam[..., 0] / safe * camera.fx + camera.cx + 0.5) * settings.columns / camera.width)
        y = np.floor((cam[..., 1] / safe * camera.fy + camera.cy + 0.5) * settings.rows / camera.height)
    inside = front & (x >= 0) & (y >= 0) & (x < settings.columns) & (y < settings.rows)
    frame = np.broadcast_to(np.arange(len(grids.frames)), z.shape)
    at = frame, np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64)
    known = inside & grids.known[at]
    low, high = grids.near[at] * (1.0 - settings.tolerance), grids.far[at] * (1.0 + settings.tolerance)
    return known & (z >= low) & (z <= high), known & (z < low), np.where(known, grids.instance[at], -1)


def _kinds(u: InstanceSet, v: InstanceSet, landed: Ints, settings: CrossSettings) -> tuple[float, int]:
    """Return the mean rank, in the other chunk, of the feature of the instance that each instance overlaps."""
    if u.space != v.space or len(u.local_id) < 2 or len(v.local_id) < 2 or u.feature.shape[1] != v.feature.shape[1]:
        return float("nan"), 0
    known = np.isin(landed[:, 0], u.local_id) & np.isin(landed[:, 1], v.local_id)
    votes = np.zeros((len(u.local_id), len(v.local_id)))
    at = np.searchsorted(u.local_id, landed[known, 0]), np.searchsorted(v.local_id, landed[known, 1])
    np.add.at(votes, at, 1.0)
    cosine = u.feature @ v.feature.T
    ranks = [*_ranks(votes, cosine, settings), *_ranks(votes.T, cosine.T, settings)]
    return (float(np.mean(ranks)) if len(ranks) >= settings.least_kinds else float("nan")), len(ranks)


def _ranks(votes: Array, cosine: Array, settings: CrossSettings) -> list[float]:
    out = []
    for row, likeness in zip(votes, cosine, strict=True):
        best = int(row.argmax())
        if row[best] >= settings.least_landed:
            others = np.delete(likeness, best)
            out.append(float(np.mean((others < likeness[best]) + 0.5 * (others == likeness[best]))))
    return out
