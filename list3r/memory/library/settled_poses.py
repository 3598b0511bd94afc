"""Settled poses: where chunks lie for the purpose of consolidation, with hysteresis. Every chunk that comes moves all
others by a little, and what is derived from a chunk need not be derived again for a millimetre.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from list3r.memory.geometry import Array, Sim3
from list3r.memory.overlap.summaries import ChunkSummary
from list3r.memory.records import ChunkRow
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import SettledRow

_FAR_M = 0.5
"""Chunks whose points lie further apart than this share no instance."""


@dataclass(frozen=True)
class HysteresisSettings:
    """How far a chunk may move before what was derived from it is derived anew."""

    move_m: float = 0.004
    """A fraction of the noise of depth at arm's length and of the tolerance within which surfaces meet."""
    turn_deg: float = 0.12
    """The same at two metres."""
    scale: float = 0.002


def settle(
    store: Store,
    summaries: Mapping[int, ChunkSummary],
    settings: HysteresisSettings | None = None,
    among: Iterable[int] | None = None,
) -> frozenset[int]:
    """Settle all chunks, or those `among` them, and return those that were settled anew: a chunk keeps its settled pose
    unless it has moved on or belongs to another component.

    Writes to the table `settled`, so that a build that goes on takes up the same poses.
    """
    s = settings or HysteresisSettings()
    chunks = store.chunks.all() if among is None else [store.chunks.get(k) for k in sorted(among)]
    T_graph_world = _world_of_graph(store).inverse()
    before = store.library.settled.all()
    fresh: dict[int, SettledRow] = {}
    for c in chunks:
        S_graph_chunk, row = T_graph_world @ c.S_world_chunk, before.get(c.chunk_id)
        unit = float(S_graph_chunk.scale) * (1.0 if c.scale_kind == "metric" else summaries[c.chunk_id].unit)
        if row is None or row.component != c.component or not _near(row.S_graph_chunk, S_graph_chunk, unit, s):
            fresh[c.chunk_id] = SettledRow(c.component, S_graph_chunk, extent_of(summaries[c.chunk_id], S_graph_chunk))
    if fresh:
        store.library.settled.put(fresh)
    return frozenset(fresh)


def settled_chunks(store: Store) -> list[ChunkRow]:
    """Return all chunks, which must be settled, at their settled poses in the world."""
    T_world_graph, rows = _world_of_graph(store), store.library.settled.all()
    return [replace(c, S_world_chunk=T_world_graph @ rows[c.chunk_id].S_graph_chunk) for c in store.chunks.all()]


def _world_of_graph(store: Store) -> Sim3:
    return store.facts.S_world_graph


def _near(a: Sim3, b: Sim3, unit: float, s: HysteresisSettings) -> bool:
    turn = np.arccos(np.clip((np.trace(a.rotation.T @ b.rotation) - 1.0) / 2.0, -1.0, 1.0))
    moved = float(np.linalg.norm(a.translation - b.translation))
    grown = abs(float(a.scale) / float(b.scale) - 1.0)
    return bool(moved <= s.move_m * unit and np.degrees(turn) <= s.turn_deg and grown <= s.scale)


def extent_of(summary: ChunkSummary, S_graph_chunk: Sim3) -> Array:
    """Return the axis-aligned box of a summary's points in the graph's frame, grown by half of what lies near. Shape
    (2, 3).
    """
    slack = 0.5 * _FAR_M * float(S_graph_chunk.scale) * summary.unit
    if len(summary.shapes.points) == 0:
        return np.array([[np.inf] * 3, [-np.inf] * 3])
    p = S_graph_chunk.apply(summary.shapes.points)
    return np.stack([p.min(axis=0) - slack, p.max(axis=0) + slack])


def neighbours(
    rows: Mapping[int, SettledRow], chunk_id: int, here: SettledRow | None = None, extents: Array | None = None
) -> list[int]:
    """Return ids of the chunks of one component that lie near a chunk, itself among them, in order.

    `here` is where the chunk lies, where that is not what `rows` says; `extents` are those of the rows, (N, 2, 3), for
    who asks often.
    """
    ids = np.fromiter(rows, np.int64, len(rows))
    extents = np.array([r.extent for r in rows.values()]) if extents is None else extents
    here = here or rows[chunk_id]
    meet = np.all((extents[:, 0] <= here.extent[1]) & (extents[:, 1] >= here.extent[0]), axis=1)
    found = [int(k) for k in ids[meet] if rows[int(k)].component == here.component]
    return sorted({chunk_id, *found})
