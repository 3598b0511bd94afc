"""Where chunks lie for the purpose of consolidation: each graph trembles a little with every chunk that comes, and what
is derived from a chunk need not be derived again for a millimetre.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from list3r.memory.geometry import Sim3
from list3r.memory.records import ChunkRow
from list3r.memory.store import Store
from list3r.memory.summaries import ChunkSummary


@dataclass(frozen=True)
class SettlingSettings:
    """How far a chunk may move before what was derived from it is derived anew."""

    move_m: float = 0.004
    """A fraction of the noise of depth at arm's length and of the tolerance within which surfaces meet."""
    turn_deg: float = 0.12
    """The same at two metres."""
    scale: float = 0.002


@dataclass(frozen=True)
class Settled:
    """The chunks as consolidation sees them."""

    chunks: list[ChunkRow]
    """In the world, at their settled poses."""
    S_graph_chunk: dict[int, Sim3]
    """The same poses in the frame of the graph, which do not change when the world is turned upright."""
    S_exact_settled: dict[int, Sim3]
    """In the world: from where a chunk is settled to where it lies."""


def settle(store: Store, summaries: Mapping[int, ChunkSummary], settings: SettlingSettings | None = None) -> Settled:
    """The settled poses of all chunks: the one kept in the store unless the chunk has moved on, then its own.

    Writes to the key-value table (`settled_poses`), so that a build that goes on takes up the same poses.
    """
    s = settings or SettlingSettings()
    chunks = store.chunks()
    T_world_graph = Sim3.from_matrix(store.get_value("T_world_graph", np.eye(4).tolist()))
    before = store.get_value("settled_poses", {})
    kept: dict[str, list[list[float]]] = {}
    for c in chunks:
        S_graph_chunk = T_world_graph.inverse() @ c.S_world_chunk
        name = str(c.chunk_id)
        unit = summaries[c.chunk_id].unit * float(c.S_world_chunk.scale)
        if name in before and _near(Sim3.from_matrix(before[name]), S_graph_chunk, unit, s):
            kept[name] = before[name]
        else:
            kept[name] = S_graph_chunk.as_matrix().tolist()
    if kept != before:
        store.set_value("settled_poses", kept)
    graph = {c.chunk_id: Sim3.from_matrix(kept[str(c.chunk_id)]) for c in chunks}
    moved = [replace(c, S_world_chunk=T_world_graph @ graph[c.chunk_id]) for c in chunks]
    return Settled(moved, graph, _corrections(chunks, moved))


def _corrections(exact: Sequence[ChunkRow], settled: Sequence[ChunkRow]) -> dict[int, Sim3]:
    return {e.chunk_id: e.S_world_chunk @ s.S_world_chunk.inverse() for e, s in zip(exact, settled, strict=True)}


def _near(a: Sim3, b: Sim3, unit: float, s: SettlingSettings) -> bool:
    turn = np.arccos(np.clip((np.trace(a.rotation.T @ b.rotation) - 1.0) / 2.0, -1.0, 1.0))
    moved = float(np.linalg.norm(a.translation - b.translation))
    grown = abs(float(a.scale) / float(b.scale) - 1.0)
    return bool(moved <= s.move_m * unit and np.degrees(turn) <= s.turn_deg and grown <= s.scale)
