"""The nodes of chunks, and the relations of the frames that two chunks share, each computed from the samples once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable
from dataclasses import replace

import numpy as np

from list3r.association.graph.chunk_nodes import (
    ChunkNodes,
    FrameRelations,
    NodeSettings,
    Tie,
    relate_frames,
    ties_of,
)
from list3r.association.graph.solver import adjoint
from list3r.memory.core.records import Edge, FrameSamples
from list3r.memory.store.derived import Derived, LruCache
from list3r.memory.store.store import Store

_KEPT_BYTES = 12 << 20
"""Of nodes, and of relations; each takes some 3 kB of a chunk. The least recently used are computed again."""


class _Nodes(LruCache[Hashable, ChunkNodes]):
    """By chunk, checksum of its samples, and frames of a node."""

    def __init__(self) -> None:
        super().__init__(_KEPT_BYTES, _bytes_of)


class _Relations(LruCache[Hashable, FrameRelations]):
    """By edge, checksums of its chunks' samples, and frames of a node."""

    def __init__(self) -> None:
        super().__init__(_KEPT_BYTES, _bytes_of)


class _Ties(LruCache[Hashable, tuple[Tie, ...]]):
    """By edge, checksums of its chunks' samples, their nodes, the frames' relations, and settings."""

    def __init__(self) -> None:
        super().__init__(_KEPT_BYTES, lambda ties: 200 + 1000 * len(ties))


class _Samples(LruCache[Hashable, FrameSamples]):
    """Of the last two chunks that were read."""

    def __init__(self) -> None:
        super().__init__(2)


class SampledChunks:
    """The samples of chunks. Those of two chunks are kept in memory; with a store their nodes, relations and ties are
    kept while it is open, so that the end of a session need not read all samples again."""

    def __init__(self, read: Callable[[int], FrameSamples], store: Store | None = None) -> None:
        self._read, self._store = read, store
        derived = Derived() if store is None else store.derived
        self._nodes, self._relations, self._held = derived.of(_Nodes), derived.of(_Relations), derived.of(_Samples)
        self._ties = derived.of(_Ties)
        self._stamps: dict[int, int] = {}

    @staticmethod
    def of(store: Store) -> SampledChunks:
        """Return the samples of a memory."""
        return SampledChunks(store.chunks.samples, store)

    def nodes(self, chunk: int, length: int) -> ChunkNodes:
        """Return the nodes of a chunk, runs of `length` frames."""
        key = chunk, self._stamp(chunk), length
        found = self._nodes.get(key)
        if found is None:
            samples = self._samples(chunk)
            found = ChunkNodes.of(samples, length) if len(samples.camera_frames) else _one_node()
        return self._nodes.put(key, found)

    def relations(self, edge: Edge, length: int) -> FrameRelations:
        """Return the relation of every frame that both chunks of an edge share; `length` is that of the nodes of u."""
        key = edge.u, edge.v, self._stamp(edge.u), self._stamp(edge.v), edge.S_v_u.as_matrix().tobytes(), length
        found = self._relations.get(key)
        if found is None:
            nodes = self.nodes(edge.u, length)
            found = relate_frames(self._samples(edge.u), self._samples(edge.v), edge, nodes)
        return self._relations.put(key, found)

    def ties(
        self, edge: Edge, relations: FrameRelations, nodes: tuple[ChunkNodes, ChunkNodes], settings: NodeSettings
    ) -> tuple[Tie, ...]:
        """Return the relations of an edge averaged over the frames of each of its chunks' nodes."""
        key = (
            (edge.u, edge.v, self._stamp(edge.u), self._stamp(edge.v), edge.S_v_u.as_matrix().tobytes()),
            (*(len(n.at) for n in nodes), bool(relations.off[:, 6].any()), settings),
        )
        found = self._ties.get(key)
        return found if found is not None else self._ties.put(key, tuple(ties_of(relations, edge, *nodes, settings)))

    def turned(self, edge: Edge, turning: Collection[int], length: int) -> Edge:
        """Return an edge relative to the middle nodes of its chunks: with the scale that `turning` chunks lose between
        there and the frames that support the edge."""
        if edge.covariance is None or not (edge.u in turning or edge.v in turning):
            return edge
        u, v = self.nodes(edge.u, length), self.nodes(edge.v, length)
        shared = int(u.at[-1] + v.at[0]) // 2
        at_u, at_v = edge.frames or (shared, shared)
        covariance = edge.covariance
        if edge.u in turning:
            covariance = covariance + u.turned(u.middle, u.nearest(at_u))
        if edge.v in turning:
            moved = adjoint(edge.S_v_u.inverse())
            covariance = covariance + moved @ v.turned(v.middle, v.nearest(at_v)) @ moved.T
        return replace(edge, covariance=covariance)

    def _stamp(self, chunk: int) -> int:
        if chunk not in self._stamps:
            self._stamps[chunk] = 0 if self._store is None else self._store.chunks.checksum(chunk)
        return self._stamps[chunk]

    def _samples(self, chunk: int) -> FrameSamples:
        """Return the samples of a chunk without frames whose pose is not finite."""
        key = chunk, self._stamp(chunk)
        held = self._held.get(key)
        if held is not None:
            return held
        samples = self._read(chunk)
        good = np.isfinite(samples.T_chunk_cam).all(axis=(1, 2))
        if not good.all():
            samples = replace(samples, camera_frames=samples.camera_frames[good], T_chunk_cam=samples.T_chunk_cam[good])
        return self._held.put(key, samples)


def _one_node() -> ChunkNodes:
    """Return the node of a chunk without posed frames."""
    zero, none = np.zeros(1), np.zeros(1, np.int64)
    return ChunkNodes(none, none, zero, np.zeros((1, 3)), np.ones(1), np.ones(1, np.int64), np.zeros((0, 7, 7)))


def _bytes_of(found: ChunkNodes | FrameRelations) -> int:
    return sum(int(part.nbytes) + 100 for part in vars(found).values())
