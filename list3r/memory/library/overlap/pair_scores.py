"""Where the surfaces of local instances meet: pair by pair of chunks, and many pairs as one table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.library.overlap.voxels import ChunkShapes, GrownCells, Ints, coverage

Key = tuple[int, int]
"""(chunk id, local id)."""


@dataclass(frozen=True)
class PairScores:
    """E pairs of local instances that meet, of two chunks (or of one)."""

    i: Ints
    """Position in the first chunk. Shape (E,)."""
    j: Ints
    """Position in the second chunk. Shape (E,)."""
    i_on_j: Array
    """Share of i's surface that lies on j. Shape (E,)."""
    j_on_i: Array
    """Share of j's surface that lies on i. Shape (E,)."""
    shared: Ints
    """Frames of the recording in which both are seen. Shape (E,)."""
    frame_iou: Array
    """Mean IoU of their boxes in those frames. Shape (E,)."""

    def only(self, kept: NDArray[np.bool_]) -> PairScores:
        """Return some of them, (E,)."""
        return PairScores(*(getattr(self, name)[kept] for name in _COLUMNS))


_COLUMNS = ("i", "j", "i_on_j", "j_on_i", "shared", "frame_iou")


def pair_scores(u: ChunkShapes, v: ChunkShapes, S_u_v: Sim3, grown: GrownCells | None = None) -> PairScores:
    """Compare all local instances of two chunks; pairs whose surfaces nowhere meet are left out.

    Pass the same chunk twice, with the identity, for the pairs within a chunk (i < j); and the `grown` cells of chunks
    that are compared often.
    """
    i_on_j = coverage(u, v, S_u_v.inverse(), grown)
    j_on_i = coverage(v, u, S_u_v, grown).T
    meet = (i_on_j > 0) | (j_on_i > 0)
    if u.chunk_id == v.chunk_id:
        meet = np.triu(meet, 1)
    shared, iou = _shared_frames(u, v)
    i, j = np.nonzero(meet)
    return PairScores(i, j, i_on_j[i, j], j_on_i[i, j], shared[i, j], iou[i, j])


def _shared_frames(u: ChunkShapes, v: ChunkShapes) -> tuple[Ints, Array]:
    """For all pairs: frames in which both are seen, and the mean IoU of their boxes there. Shape (N_u, N_v) each."""
    shape = (len(u.local_id), len(v.local_id))
    count, total = np.zeros(shape, np.int64), np.zeros(shape)
    if u.session_id != v.session_id or not shape[0] or not shape[1]:
        return count, total
    frames_u, frames_v = np.concatenate(u.frames), np.concatenate(v.frames)
    boxes_u, boxes_v = np.concatenate(u.boxes_xyxy).astype(float), np.concatenate(v.boxes_xyxy).astype(float)
    owner_u = np.repeat(np.arange(shape[0]), [len(f) for f in u.frames])
    order = np.argsort(frames_v, kind="stable")
    first = np.searchsorted(frames_v[order], frames_u)
    times = np.searchsorted(frames_v[order], frames_u, side="right") - first
    at_u = np.repeat(np.arange(len(frames_u)), times)
    at_v = order[np.arange(len(at_u)) + np.repeat(first - (np.cumsum(times) - times), times)]
    owner_v = np.repeat(np.arange(shape[1]), [len(f) for f in v.frames])
    cell = owner_u[at_u] * shape[1] + owner_v[at_v]
    count = np.bincount(cell, minlength=count.size).reshape(shape)
    total += np.bincount(cell, _iou(boxes_u[at_u], boxes_v[at_v]), minlength=total.size).reshape(shape)
    return count * min(u.stands_for, v.stands_for), total / np.maximum(count, 1)


def box_iou(a: Array, b: Array) -> Array:
    """Return IoU of boxes xyxy. Shape (A, 4), (B, 4) -> (A, B)."""
    return _iou(a[:, None], b[None])


def _iou(a: Array, b: Array) -> Array:
    """Return IoU of pairs of boxes xyxy. Shapes (..., 4) broadcast."""
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    inter = np.prod(np.clip(high - low, 0, None), axis=-1)
    area_a, area_b = (np.prod(x[..., 2:] - x[..., :2], axis=-1) for x in (a, b))
    return np.asarray(inter / np.maximum(area_a + area_b - inter, 1e-9))


class Numbering:
    """The local instances of some chunks in one numbering, in the order of their keys."""

    def __init__(self, chunks: Mapping[int, ChunkShapes]) -> None:
        self.keys = [(k, n) for k in sorted(chunks) for n in chunks[k].local_id.tolist()]
        self._at = {key: n for n, key in enumerate(self.keys)}
        self.start: dict[int, int] = {}
        count = 0
        for k in sorted(chunks):
            self.start[k] = count
            count += len(chunks[k].local_id)

    def __len__(self) -> int:
        return len(self.keys)

    def homes(self, groups: Iterable[Sequence[Key]]) -> Ints:
        """Return the number of the group that each is in, -1 for none. Shape (N,)."""
        out = np.full(len(self.keys), -1, np.int64)
        for n, group in enumerate(groups):
            out[[self._at[k] for k in group if k in self._at]] = n
        return out


@dataclass(frozen=True)
class PairTable:
    """M pairs of local instances that meet, of many pairs of chunks, by their numbers."""

    a: Ints
    """Shape (M,)."""
    b: Ints
    """Larger than `a`. Shape (M,)."""
    a_on_b: Array
    """Share of a's surface that lies on b. Shape (M,)."""
    b_on_a: Array
    """Shape (M,)."""
    shared: Ints
    """Frames of the recording in which both are seen. Shape (M,)."""
    frame_iou: Array
    """Mean IoU of their boxes in those frames. Shape (M,)."""

    @staticmethod
    def of(pairs: Mapping[tuple[int, int], PairScores], numbering: Numbering) -> PairTable:
        """Return those of pairs of chunks (u <= v) that are in the numbering."""
        known = [(u, v, p) for (u, v), p in pairs.items() if u in numbering.start and v in numbering.start]
        sizes = [len(p.i) for _, _, p in known]
        start_u = np.repeat(np.array([numbering.start[u] for u, _, _ in known], np.int64), sizes)
        start_v = np.repeat(np.array([numbering.start[v] for _, v, _ in known], np.int64), sizes)
        return PairTable(
            start_u + joined([p.i for _, _, p in known], np.int64),
            start_v + joined([p.j for _, _, p in known], np.int64),
            joined([p.i_on_j for _, _, p in known], np.float64),
            joined([p.j_on_i for _, _, p in known], np.float64),
            joined([p.shared for _, _, p in known], np.int64),
            joined([p.frame_iou for _, _, p in known], np.float64),
        )


def joined(parts: Sequence[NDArray[Any]], dtype: type) -> NDArray[Any]:
    """Concatenate arrays; an empty one of a type where there are none."""
    return np.concatenate(parts) if parts else np.zeros(0, dtype)
