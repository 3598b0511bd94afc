"""Find similar frames among all keyframes.

Frames with SIFT features are found by these: the nearest stored features of each one vote for their frames, the more
the nearer they are against those that follow. Others are found by exact search over one descriptor of each frame
(research/association: places, 0047).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.sift import SIFT_WIDTH, root_sift
from list3r.memory.core.records import ChunkRow
from list3r.memory.store.store import Store
from list3r.reconstruction.features.vlad import Vocabulary

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
CLASSICAL: Mapping[int, DescriptorScale] = {1984: DescriptorScale(0.08, 0.22)}
"""The descriptors of `reconstruction.features.vlad`, by their length."""
VOTES = DescriptorScale(0.0075, 0.03)
"""Votes of local features, as a share of"""
_VOTERS = 400
"""as many as a keyframe has: few features that agree tell little."""
_KEYFRAMES = 2000
"""Beyond this many, only the strongest features of a frame vote, so that a search takes no longer."""
_PROBES, _NEIGHBOURS = 4, 6
"""Inverted lists that are searched for a feature; stored features that it votes for."""
_OTHER = np.float32(0.1)
"""Least squared distance of a feature of something else, where all that are found are of one place."""


@dataclass(frozen=True)
class SearchSettings:
    """How candidates are chosen."""

    exclude_chunks: int = 1
    """Chunks just before in the same video that are neighbours, not revisits."""
    exclude_frames: int = 30
    """Frames of one video this close are no revisit either."""
    neighbour_frames: int = 80
    """Frames of neighbouring chunks this far apart may be a revisit all the same, by their features."""
    nearest: int = 256
    """Stored frames compared with each new one."""
    mutual: bool = True
    """Only mutual nearest neighbours are candidates."""
    suppress_frames: int = 20
    """A pair within this many frames of a better one, on both sides, is the same revisit."""
    features_apart: int = 6
    """The same of candidates by features, which need not be mutual nor the best to be verified: the most votes often
    go to a frame that few others confirm."""
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
    """Of two descriptors; of features the votes, as a share."""
    s_det: float
    """The same on the scale of trained place recognition."""


class FeatureIndex:
    """SIFT features of the stored keyframes (`sift_rows`), in inverted lists, one for each pair of words.

    The lists depend on no memory, so that equal memories give equal answers.
    """

    def __init__(self) -> None:
        import faiss

        words = Vocabulary.built_in().words
        pairs = _whole(_unit((words[:, None] + words)[np.triu_indices(len(words))]))
        quantizer = faiss.IndexFlatL2(pairs.shape[1])
        quantizer.add(pairs)
        kind = faiss.ScalarQuantizer.QT_fp16
        self.keys: Ints = np.zeros((0, 2), np.int64)
        self._owner: Ints = np.zeros(0, np.int64)
        self._index: Any = faiss.IndexIVFScalarQuantizer(
            quantizer, pairs.shape[1], len(pairs), kind, faiss.METRIC_L2, False
        )
        self._index.is_trained = True  # nothing is learned: half precision, and the lists are given
        self._faiss: Any = faiss

    def add(self, keys: Ints, features: Sequence[Floats]) -> None:
        """Append rows: (chunk id, Frame.index) of shape (K, 2) and unit vectors (N, d) of each keyframe."""
        self._index.add(np.concatenate(features))
        owner = np.repeat(np.arange(len(keys)) + len(self.keys), [len(f) for f in features])
        self._owner = np.concatenate([self._owner, owner])
        self.keys = np.concatenate([self.keys, keys])

    def search(self, frames: Sequence[Floats], allowed: NDArray[np.bool_], k: int) -> tuple[Ints, Floats]:
        """Return rows and votes of the k keyframes, allowed ones (Q, K), with most votes of each frame's features
        (N, d). (Q, k)."""
        votes = np.zeros(allowed.shape, np.float32)
        voters = max(_VOTERS // 8, min(_VOTERS, _VOTERS * _KEYFRAMES // max(1, int(allowed.any(axis=0).sum()))))
        for n, features in enumerate(frames):
            bitmap = np.packbits(allowed[n, self._owner], bitorder="little")
            selector = self._faiss.IDSelectorBitmap(len(self._owner), self._faiss.swig_ptr(bitmap))
            parameters = self._faiss.SearchParametersIVF(sel=selector, nprobe=_PROBES)
            distance, row = self._index.search(features[:voters], _NEIGHBOURS + 1, params=parameters)
            distance = np.where(row >= 0, distance, 0.0)
            beyond = np.maximum(distance.max(axis=1, keepdims=True), _OTHER)
            vote = np.where(row >= 0, (1.0 - distance / beyond) ** 2, 0.0)
            owner = self._owner[row].ravel()
            votes[n] = np.bincount(owner, vote.ravel(), len(self.keys)) / voters
        rows = np.argsort(-votes, axis=1, kind="stable")[:, :k]
        return rows, np.take_along_axis(votes, rows, axis=1)


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
        """Return rows and cosines of the k nearest of each descriptor, allowed ones (Q, K); -1 where there are fewer.
        (Q, k)."""
        rows, cosines = np.empty((len(descriptors), k), np.int64), np.empty((len(descriptors), k), np.float32)
        for n, bitmap in enumerate(np.packbits(allowed, axis=1, bitorder="little")):
            selector = self._faiss.IDSelectorBitmap(allowed.shape[1], self._faiss.swig_ptr(bitmap))
            parameters: Any = self._faiss.SearchParameters(sel=selector)  # type: ignore[call-arg]
            cosines[n], rows[n] = self.index.search(descriptors[n : n + 1], k, params=parameters)
        return rows, cosines


@dataclass
class FrameIndices:
    """The indices of an open store."""

    checksums: dict[int, int] = field(default_factory=dict)
    """Of the chunks that were read, by chunk id."""
    by_kind: dict[int, FrameIndex | FeatureIndex] = field(default_factory=dict)
    """By the length of descriptors; 0: of features."""

    def clear(self) -> None:
        """Forget the descriptors that were read."""
        self.checksums.clear()
        self.by_kind.clear()


@dataclass(frozen=True)
class _Described:
    """The keyframes of a chunk."""

    keys: Ints
    """Chunk id and Frame.index. Shape (K, 2)."""
    looks: Any
    """Unit vectors: (K, D) of whole frames, or (N, d) of the features of each one."""
    kind: int
    """As in `FrameIndices.by_kind`."""


def find_candidates(store: Store, chunk_id: int, settings: SearchSettings | None = None) -> list[Candidate]:
    """Find stored frames similar to frames of a chunk, best first; of chunks that came before it only."""
    chosen = settings or SearchSettings()
    rows = {c.chunk_id: c for c in store.chunks.all()}
    own = _described(store, chunk_id)
    index = _index(store, [k for k in rows if k < chunk_id]).by_kind.get(own.kind)
    if index is None or not len(own.keys):
        return []
    here, ids = rows[chunk_id], index.keys[:, 0]
    revisit = np.isin(ids, [k for k, row in rows.items() if is_revisit(here, row, chosen)])
    same_video = np.isin(ids, [k for k, row in rows.items() if row.session_id == here.session_id])
    least = np.where(revisit, chosen.exclude_frames + 1, chosen.neighbour_frames)
    off = np.abs(index.keys[None, :, 1] - own.keys[:, None, 1])
    allowed = (revisit if own.kind else ids < chunk_id) & ~(same_video & (off < least))
    if not allowed.any():
        return []
    found, likeness = index.search(own.looks, allowed, min(chosen.nearest, int(allowed.any(axis=0).sum())))
    new = np.repeat(np.arange(len(own.keys)), found.shape[1])
    stored, likeness = found.ravel(), likeness.ravel()
    scale = CLASSICAL.get(own.kind, TRAINED) if own.kind else VOTES
    keep = (stored >= 0) & (likeness >= scale.relaxed)
    if not own.kind:
        chosen = replace(
            chosen, suppress_frames=chosen.features_apart, per_pair=chosen.per_pair_of_sessions, mutual=False
        )
    later = {k for k, row in rows.items() if row.session_id != here.session_id}
    return choose(own.keys[new[keep], 1], index.keys[stored[keep]], likeness[keep], scale, chosen, later)


def choose(
    frame_v: Ints,
    stored: Ints,
    cosine: Floats,
    scale: DescriptorScale,
    settings: SearchSettings,
    other_sessions: Collection[int] = (),
) -> list[Candidate]:
    """Return the similar frames of pairs of chunks, thinned out in time, with a quota for each pair of chunks.

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
        if settings.mutual and (c < best_new[f, chunk] or c < best_old[chunk, frame]):
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
        chunk = _described(store, chunk_id)
        if len(chunk.keys):
            if (index := known.by_kind.get(chunk.kind)) is None:
                index = known.by_kind[chunk.kind] = FrameIndex(chunk.kind) if chunk.kind else FeatureIndex()
            index.add(chunk.keys, chunk.looks)
        known.checksums[chunk_id] = checksums[chunk_id]
    return known


def _described(store: Store, chunk_id: int) -> _Described:
    """Return what the keyframes of a chunk look like; a descriptor that is not finite is similar to nothing."""
    keys, descriptors = store.keyframes.descriptors([chunk_id])
    if not len(keys):
        return _Described(keys, (), 0)
    if descriptors.shape[1] in CLASSICAL:
        features = [store.keyframes.get(chunk_id, int(frame)).keypoint_descriptors for frame in keys[:, 1]]
        if all(f.shape[1] == SIFT_WIDTH for f in features) and any(len(f) for f in features):
            return _Described(keys, sift_rows(features), 0)
    sound = np.where(np.isfinite(descriptors).all(axis=1, keepdims=True), descriptors, np.float32(0))
    return _Described(keys, _unit(np.asarray(sound, np.float32)), sound.shape[1])


def sift_rows(features: Sequence[NDArray[np.uint8]]) -> list[Floats]:
    """Return the SIFT descriptors (N, 128) of each frame as unit vectors (N, d) for `FeatureIndex`."""
    return [_whole(_unit(Vocabulary.built_in().reduced(root_sift(f)))) for f in features]


def _whole(rows: Floats) -> Floats:
    """Return vectors with zeros appended to whole groups of eight, without which FAISS takes five times as long."""
    return np.pad(rows, ((0, 0), (0, -rows.shape[1] % 8)))


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.float32(1e-12)))
