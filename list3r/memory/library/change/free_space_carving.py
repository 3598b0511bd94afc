"""How much of each local instance the frames of another session see through: what stayed, and what did not.

Two local instances of two sessions at one place are one instance only if neither session sees through the surface of
the other. That is asked of depth alone, so it holds for two instances that look alike and for one instance in another
light.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.library.overlap.pair_scores import PairScores
from list3r.memory.library.overlap.visibility import DepthView, VisibilitySettings, chunk_views, seen_through_shares
from list3r.memory.library.overlap.voxels import ChunkShapes
from list3r.memory.store.store import Store

_KEPT = 64
"""Chunks whose depth pictures are kept in memory."""


class FreeSpaceCarving:
    """Asks the keyframes of one chunk about the instances of another one."""

    def __init__(self, store: Store, settings: VisibilitySettings, least_overlap: float = 0.2) -> None:
        self._store, self._s, self._least = store, settings, least_overlap
        self._views_of = lru_cache(_KEPT)(self._read_views)

    def shares(self, u: ChunkShapes, v: ChunkShapes, p: PairScores, S_v_u: Sim3) -> tuple[Array, Array]:
        """For each pair of instances of two chunks the share of either that the other chunk sees through.

        Of what that chunk tells about; 0 where it tells too little, where the two hardly meet, and for structure.
        Shape (E,) each.
        """
        meet = np.maximum(p.i_on_j, p.j_on_i) >= self._least
        return self._of(u, v, p.i, meet, S_v_u), self._of(v, u, p.j, meet, S_v_u.inverse())

    def _of(self, own: ChunkShapes, other: ChunkShapes, at: np.ndarray, meet: np.ndarray, S_other_own: Sim3) -> Array:
        out = np.zeros(len(at))
        some = [n for n in np.unique(at[meet]).tolist() if not own.structure[n]]
        if some:
            spans = np.searchsorted(own.owner, np.add.outer(some, (0, 1)))
            surfaces = [S_other_own.apply(own.points[start:stop]) for start, stop in spans.tolist()]
            shares = seen_through_shares(surfaces, self._views_of(other.chunk_id, other.unit), self._s)
            for n, share in zip(some, shares, strict=True):
                out[meet & (at == n)] = share or 0.0
        return out

    def _read_views(self, chunk_id: int, unit: float) -> list[DepthView]:
        """Return the keyframes of a chunk, in its own coordinates; `unit` is a metre there."""
        chunk = replace(self._store.chunks.get(chunk_id), S_world_chunk=Sim3.identity())
        return chunk_views(chunk, self._store.keyframes.of(chunk_id), unit)
