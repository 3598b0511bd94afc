"""Find places seen before: frame descriptors propose, geometry verifies (paper 3.2 and A.2, first part).

What the paper adds by instances (their semantic and layout agreement, s_sem and s_rel) is to rank the proposals
between `propose` and `verify`; chunks without metric scale need a joint window for an edge and get none here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.association.verification import VerificationSettings, verify
from list3r.memory.records import ChunkRow, Edge, Keyframe

Floats = NDArray[np.float32]

_FAISS_FROM = 20_000
"""Stored descriptors from which an index pays for its import."""


@dataclass(frozen=True)
class RevisitSettings:
    """How revisits are proposed."""

    least_cosine: float = 0.05
    """Least cosine of two frames, after the mean of all stored descriptors is taken out."""
    exclude_chunks: int = 1
    """Chunks just before in the same video that are not revisits but neighbours."""
    suppress_frames: int = 20
    """A proposal within so many frames of a better one, on both sides, is the same revisit."""
    per_chunk: int = 12
    """Most proposals verified for a new chunk."""
    per_pair: int = 2
    """Most proposals between two chunks."""
    enough: int = 6
    """Accepted edges after which no further proposal of a chunk is verified."""
    verification: VerificationSettings = field(default_factory=VerificationSettings)


@dataclass(frozen=True)
class Proposal:
    """Two keyframes that look alike."""

    new: int
    """Row of the new chunk's keyframe."""
    stored: int
    """Row of the stored one."""
    cosine: float


class KeyframeStore(Protocol):
    """What of the memory is read here."""

    def chunks(self, session_id: int | None = None) -> list[ChunkRow]: ...

    def keyframes(self, chunk_id: int) -> list[Keyframe]: ...

    def keyframe(self, chunk_id: int, frame_index: int) -> Keyframe: ...

    def keyframe_descriptors(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]: ...


def find_loops(store: KeyframeStore, chunk_id: int, settings: RevisitSettings | None = None) -> list[Edge]:
    """Loop edges, accepted or rejected, between a chunk and those stored before it."""
    chosen = settings or RevisitSettings()
    rows = {c.chunk_id: c for c in store.chunks()}
    keys, descriptors = store.keyframe_descriptors()
    if not len(keys):
        return []
    here = rows[chunk_id]
    new = keys[:, 0] == chunk_id
    old = np.array([_is_revisit(here, rows.get(int(k)), chosen) for k in keys[:, 0]], dtype=bool)
    if not new.any() or not old.any():
        return []
    proposals = propose(descriptors[new], keys[new], descriptors[old], keys[old], chosen)
    keyframes = {k.frame_index: k for k in store.keyframes(chunk_id)}
    edges: list[Edge] = []
    for proposal in proposals:
        u, frame_u = (int(n) for n in keys[old][proposal.stored])
        metric = here.scale_kind == rows[u].scale_kind == "metric"
        keyframe_v = keyframes[int(keys[new][proposal.new][1])]
        edge = verify(store.keyframe(u, frame_u), keyframe_v, u, chunk_id, metric, chosen.verification)
        edge.scores["cosine"] = proposal.cosine
        edges.append(edge)
        if sum(e.accepted for e in edges) >= chosen.enough:
            break
    return edges


def propose(
    new: Floats,
    new_keys: NDArray[np.int64],
    stored: Floats,
    stored_keys: NDArray[np.int64],
    settings: RevisitSettings,
) -> list[Proposal]:
    """Pairs of frames that look alike, best first: mutual suppression in time, a quota for each pair of chunks.

    Descriptors have shape (N, D), keys (N, 2): chunk id and Frame.index.
    """
    mean = stored.mean(axis=0) if len(stored) >= 8 else np.zeros(stored.shape[1], np.float32)
    rows, columns, cosines = _nearest(_centred(new, mean), _centred(stored, mean), settings)
    kept: list[Proposal] = []
    pairs: dict[int, int] = {}
    for k in np.lexsort((columns, rows, -cosines)):
        n, s, chunk = int(rows[k]), int(columns[k]), int(stored_keys[columns[k], 0])
        if cosines[k] < settings.least_cosine or len(kept) >= settings.per_chunk:
            break
        if pairs.get(chunk, 0) >= settings.per_pair or any(
            stored_keys[p.stored, 0] == chunk
            and abs(int(new_keys[p.new, 1] - new_keys[n, 1])) <= settings.suppress_frames
            and abs(int(stored_keys[p.stored, 1] - stored_keys[s, 1])) <= settings.suppress_frames
            for p in kept
        ):
            continue
        kept.append(Proposal(n, s, float(cosines[k])))
        pairs[chunk] = pairs.get(chunk, 0) + 1
    return kept


def _is_revisit(here: ChunkRow, there: ChunkRow | None, settings: RevisitSettings) -> bool:
    if there is None or there.chunk_id >= here.chunk_id:
        return False
    return there.session_id != here.session_id or here.index - there.index > settings.exclude_chunks


def _nearest(
    new: Floats, stored: Floats, settings: RevisitSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Rows, columns and cosines of the best matches of each new descriptor."""
    count = min(len(stored), 8 * settings.per_chunk)
    if len(stored) >= _FAISS_FROM:
        import faiss

        index = faiss.IndexFlatIP(stored.shape[1])
        index.add(np.ascontiguousarray(stored))
        cosines, columns = index.search(np.ascontiguousarray(new), count)
    else:
        all_cosines = new @ stored.T
        columns = np.argsort(-all_cosines, axis=1, kind="stable")[:, :count]
        cosines = np.take_along_axis(all_cosines, columns, axis=1)
    rows = np.repeat(np.arange(len(new)), count)
    return rows, columns.ravel(), cosines.ravel()


def _centred(descriptors: Floats, mean: Floats) -> Floats:
    moved = descriptors - mean
    return np.asarray(moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), np.float32(1e-9)))
