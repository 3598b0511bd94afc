"""Find similar frames: exact search over the descriptors of all keyframes (research/association 0047)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.records import ChunkRow
from list3r.memory.store.store import Store

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class DescriptorScale:
    """Meaning of the cosines of one kind of frame descriptor."""

    relaxed: float
    """Cosine from which two frames may show one place: the paper's relaxed threshold of 0.5."""
    strict: float
    """Cosine above which frame similarity alone suffices: VGGT-Long's threshold of 0.85."""

    def score(self, cosine: float) -> float:
        """Return s_det in [0, 1]: the cosine on the scale of trained place recognition, 0.5 relaxed and 0.85 strict."""
        at = (-1.0, self.relaxed, self.strict, 1.0)
        return float(np.interp(cosine, at, (0.0, 0.5, 0.85, 1.0)))


TRAINED = DescriptorScale(0.5, 0.85)
"""Trained place recognition, and its simulation."""
CLASSICAL: Mapping[int, DescriptorScale] = {
    384: DescriptorScale(0.6, 0.75),
    1984: DescriptorScale(0.08, 0.22),
}
"""The classical descriptors of `reconstruction.descriptor` and `reconstruction.vlad`, by their length."""


@dataclass(frozen=True)
class SearchSettings:
    """How candidates are chosen."""

    exclude_chunks: int = 1
    """Chunks just before in the same video that are neighbours, not revisits."""
    exclude_frames: int = 30
    """Frames of one video this close are no revisit either."""
    nearest: int = 256
    """Stored frames compared with each new one."""
    suppress_frames: int = 20
    """A pair within this many frames of a better one, on both sides, is the same revisit."""
    per_chunk: int = 24
    """Most candidates of a new chunk."""
    per_pair: int = 2
    """Most candidates between two chunks."""
    per_pair_of_sessions: int = 6
    """The same of chunks of two sessions: a short session has few chunks, and its place must be found twice."""


@dataclass(frozen=True)
class Candidate:
    """Two similar keyframes."""

    u: int
    """Chunk id of the stored keyframe."""
    frame_u: int
    """Frame.index."""
    frame_v: int
    """Frame.index in the new chunk."""
    cosine: float
    s_det: float
    """The cosine on the scale of trained place recognition."""


class FrameIndex:
    """Descriptors of the stored keyframes of one length."""

    def __init__(self, length: int) -> None:
        import faiss

        self.keys: Ints = np.zeros((0, 2), np.int64)
        self.index: Any = faiss.IndexScalarQuantizer(length, faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT)
        self._faiss = faiss

    def add(self, keys: Ints, descriptors: Floats) -> None:
        """Append rows: (chunk id, Frame.index) of shape (K, 2) and unit vectors (K, D)."""
        self.keys = np.concatenate([self.keys, keys])
        self.index.add(np.ascontiguousarray(descriptors))

    def search(self, descriptors: Floats, allowed: NDArray[np.bool_], k: int) -> tuple[Ints, Floats]:
        """Return rows and cosines of k nearest allowed ones of each descriptor, -1 where there are fewer. (Q, k)."""
        bitmap = np.packbits(allowed, bitorder="little")
        selector = self._faiss.IDSelectorBitmap(len(allowed), self._faiss.swig_ptr(bitmap))
        parameters: Any = self._faiss.SearchParameters(sel=selector)  # type: ignore[call-arg]
        cosines, rows = self.index.search(np.ascontiguousarray(descriptors), k, params=parameters)
        return rows, cosines


@dataclass
class FrameIndices:
    """The indices of an open store."""

    checksums: dict[int, int] = field(default_factory=dict)
    """Of the chunks that were read, by chunk id."""
    by_length: dict[int, FrameIndex] = field(default_factory=dict)

    def clear(self) -> None:
        """Forget the descriptors that were read."""
        self.checksums.clear()
        self.by_length.clear()


def find_candidates(store: Store, chunk_id: int, settings: SearchSettings | None = None) -> list[Candidate]:
    """Find stored frames similar to frames of a chunk, best first; of chunks that came before it only."""
    chosen = settings or SearchSettings()
    rows = {c.chunk_id: c for c in store.chunks.all()}
    own_keys, own = _descriptors(store, [chunk_id])
    if not len(own_keys):
        return []
    index = _index(store, [k for k in rows if k < chunk_id]).by_length.get(own.shape[1])
    if index is None:
        return []
    allowed_chunks = [k for k, row in rows.items() if is_revisit(rows[chunk_id], row, chosen)]
    allowed = np.isin(index.keys[:, 0], allowed_chunks)
    if not allowed.any():
        return []
    found, cosines = index.search(own, allowed, min(chosen.nearest, int(allowed.sum())))
    new = np.repeat(np.arange(len(own)), found.shape[1])
    stored, cosine = found.ravel(), cosines.ravel()
    same_video = np.array([rows[int(k)].session_id == rows[chunk_id].session_id for k in index.keys[stored, 0]], bool)
    near = same_video & (np.abs(index.keys[stored, 1] - own_keys[new, 1]) <= chosen.exclude_frames)
    scale = CLASSICAL.get(own.shape[1], TRAINED)
    keep = (stored >= 0) & (cosine >= scale.relaxed) & ~near
    later = {k for k in allowed_chunks if rows[k].session_id != rows[chunk_id].session_id}
    return choose(own_keys[new[keep], 1], index.keys[stored[keep]], cosine[keep], scale, chosen, later)


def choose(
    frame_v: Ints,
    stored: Ints,
    cosine: Floats,
    scale: DescriptorScale,
    settings: SearchSettings,
    other_sessions: Collection[int] = (),
) -> list[Candidate]:
    """Return the mutual nearest neighbours between pairs of chunks, thinned out in time, with a quota for each pair of
    chunks.

    `frame_v` (P,) is Frame.index in the new chunk, `stored` (P, 2) chunk id and Frame.index, `cosine` (P,).
    `other_sessions` are the chunks of other sessions than the new one's.
    """
    best_new: dict[tuple[int, int], float] = {}
    best_old: dict[tuple[int, int], float] = {}
    for f, (chunk, frame), c in zip(frame_v.tolist(), stored.tolist(), cosine.tolist(), strict=True):
        best_new[f, chunk] = max(c, best_new.get((f, chunk), -2.0))
        best_old[chunk, frame] = max(c, best_old.get((chunk, frame), -2.0))
    out: list[Candidate] = []
    for n in np.lexsort((frame_v, stored[:, 1], stored[:, 0], -cosine)):
        f, chunk, frame, c = int(frame_v[n]), int(stored[n, 0]), int(stored[n, 1]), float(cosine[n])
        if c < best_new[f, chunk] or c < best_old[chunk, frame]:
            continue
        same = [k for k in out if k.u == chunk]
        near = settings.suppress_frames
        most = settings.per_pair_of_sessions if chunk in other_sessions else settings.per_pair
        if len(same) >= most or any(abs(k.frame_v - f) <= near and abs(k.frame_u - frame) <= near for k in same):
            continue
        out.append(Candidate(chunk, frame, f, c, scale.score(c)))
        if len(out) == settings.per_chunk:
            break
    return out


def is_revisit(here: ChunkRow, there: ChunkRow, settings: SearchSettings) -> bool:
    """Return whether common surfaces of two chunks are a revisit: the other came before and is no neighbour."""
    if there.chunk_id >= here.chunk_id:
        return False
    return there.session_id != here.session_id or (
        here.index - there.index > settings.exclude_chunks or there.last_frame < here.first_frame
    )


def _index(store: Store, chunk_ids: Sequence[int]) -> FrameIndices:
    """Return index with all of the given chunks in it, read again where a chunk has changed."""
    wanted = set(chunk_ids)
    checksums = {k: c for k, c in store.chunks.checksums().items() if k in wanted}
    known = store.derived.of(FrameIndices)
    if any(known.checksums[k] != checksums.get(k) for k in known.checksums):
        known.clear()
    missing = [k for k in sorted(checksums) if k not in known.checksums]
    for chunk_id in missing:
        keys, descriptors = _descriptors(store, [chunk_id])
        if len(keys):
            known.by_length.setdefault(descriptors.shape[1], FrameIndex(descriptors.shape[1])).add(keys, descriptors)
        known.checksums[chunk_id] = checksums[chunk_id]
    return known


def _descriptors(store: Store, chunk_ids: Sequence[int]) -> tuple[Ints, Floats]:
    """Return keys and unit descriptors of some chunks; one that is not finite becomes zero, similar to nothing."""
    keys, descriptors = store.keyframes.descriptors(chunk_ids)
    if not len(keys):
        return keys, np.zeros((0, 0), np.float32)
    descriptors = np.asarray(descriptors, np.float32)
    sound = np.where(np.isfinite(descriptors).all(axis=1, keepdims=True), descriptors, np.float32(0))
    return keys, np.asarray(sound / np.maximum(np.linalg.norm(sound, axis=1, keepdims=True), np.float32(1e-12)))
