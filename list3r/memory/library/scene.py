"""The placed chunks of a memory, as one derivation sees them: each read once, when first asked for."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import cache, cached_property

import numpy as np

from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import ChunkRow, MotionTrack
from list3r.memory.library.merging.movers import PlacedChunks, Tracks
from list3r.memory.library.overlap.pair_scores import Key, PairScores
from list3r.memory.library.overlap.summaries import Summaries, cameras_of
from list3r.memory.library.overlap.voxels import ChunkShapes, Ints
from list3r.memory.library.rules import ConsolidationSettings
from list3r.memory.library.scores import Pair, PairScoreCache
from list3r.memory.library.world.world import World
from list3r.memory.store.store import Store

_FAR_M = 0.5
"""Chunks whose points are further apart than this share no instance."""


class Scene:
    """What chunks saw, and their poses."""

    def __init__(self, store: Store, summaries: Summaries, world: World, settings: ConsolidationSettings) -> None:
        self.store, self.world, self.settings = store, world, settings
        self.summaries = summaries
        self.rows: Mapping[int, ChunkRow] = {c.chunk_id: c for c in store.chunks.all()}
        """All chunks by id."""
        self.scores = PairScoreCache(store, summaries, (settings.rounding, settings.changes, settings.shapes))
        self.constraints = store.edits.constraints()
        self._times = cache(lambda k: store.frames.times(self.rows[k]))
        self._cameras = cache(lambda k: cameras_of(store, [self.rows[k]]).translation)

    # ------------------------------------------------------------------ one chunk

    def shapes(self, chunk_id: int) -> ChunkShapes:
        """Return the local instances of a chunk."""
        return self.summaries[chunk_id].shapes

    def pose(self, chunk_id: int) -> Sim3:
        """Return S_world_chunk."""
        return self.rows[chunk_id].S_world_chunk

    def session(self, chunk_id: int) -> int:
        """Return the session of a chunk."""
        return self.rows[chunk_id].session_id

    def component(self, chunk_id: int) -> int:
        """Return the connected component of a chunk."""
        return self.rows[chunk_id].component

    def frames_of(self, key: Key) -> Ints:
        """Return Frame.index of the frames in which a local instance is seen. Shape (V,)."""
        shapes = self.shapes(key[0])
        return shapes.frames[int(np.searchsorted(shapes.local_id, key[1]))]

    def seen_for(self, key: Key) -> int:
        """Return in how many frames of the recording a local instance is seen, passed over ones included."""
        shapes = self.shapes(key[0])
        return shapes.seen_for(int(np.searchsorted(shapes.local_id, key[1])))

    def times_of(self, chunk_ids: Iterable[int]) -> dict[tuple[int, int], float]:
        """Return seconds by (session id, Frame.index) of the frames in the spans of chunks."""
        out: dict[tuple[int, int], float] = {}
        for k in chunk_ids:
            out |= self._times(k)
        return out

    def cameras_of(self, chunk_ids: Iterable[int]) -> Array:
        """Return where the cameras of chunks were, world. Shape (F, 3)."""
        return np.concatenate([np.zeros((0, 3)), *map(self._cameras, chunk_ids)])

    # ------------------------------------------------------------------ pairs of chunks

    @cached_property
    def near(self) -> Mapping[int, list[int]]:
        """The chunks of one component near each, itself among them, in order."""
        ids, extents = list(self.rows), np.array([self.extent(k) for k in self.rows])
        part = np.array([c.component for c in self.rows.values()])
        out = {}
        for n, k in enumerate(ids):
            meet = np.all((extents[:, 0] <= extents[n, 1]) & (extents[:, 1] >= extents[n, 0]), axis=1)
            found = {ids[m] for m in np.flatnonzero(meet & (part == part[n])).tolist()}
            out[k] = sorted({k, *found})
        return out

    def extent(self, chunk_id: int) -> Array:
        """Return the box round a chunk's points in the world, grown by half of `_FAR_M`. Shape (2, 3)."""
        summary, S_world_chunk = self.summaries[chunk_id], self.pose(chunk_id)
        points = summary.shapes.points
        if len(points) == 0:
            return np.array([[np.inf] * 3, [-np.inf] * 3])
        slack = 0.5 * _FAR_M * float(S_world_chunk.scale) * summary.unit
        p = S_world_chunk.apply(points)
        return np.stack([p.min(axis=0) - slack, p.max(axis=0) + slack])

    def pairs(self, among: Collection[int]) -> list[Pair]:
        """Return the pairs (u <= v) of some chunks that are near each other."""
        return [(u, v) for u in sorted(among) for v in self.near[u] if v >= u and v in among]

    def overlaps(self, pairs: Iterable[Pair], left_out: Collection[Key] = ()) -> dict[Pair, PairScores]:
        """Return how pairs of chunks overlap, without some of their local instances."""
        stays = {k: np.ones(len(self.shapes(k).local_id), bool) for k, _ in left_out}
        for k, n in left_out:
            stays[k][int(np.searchsorted(self.shapes(k).local_id, n))] = False
        out = {}
        for u, v in pairs:
            p = self.scores.of(u, v)
            if u in stays:
                p = p.only(stays[u][p.i])
            out[u, v] = p.only(stays[v][p.j]) if v in stays else p
        return out

    # ------------------------------------------------------------------ motion

    @cached_property
    def motions(self) -> Mapping[Key, MotionTrack | None]:
        """The local instances that move, and where they were."""
        if not self.store.local_instances.any_dynamic():
            return {}
        return {(k, n): track for k in self.rows for n, track in self.summaries[k].motions.items()}

    def tracks(self) -> Tracks:
        """Return the same with the times of the frames."""
        return Tracks(self.motions, self.times_of(self.rows))

    def placed(self) -> PlacedChunks:
        """Return what is asked of chunks about what moves."""
        shapes, poses = {k: self.shapes(k) for k in self.rows}, {k: self.pose(k) for k in self.rows}
        return PlacedChunks(shapes, poses, {k: self.component(k) for k in self.rows})
