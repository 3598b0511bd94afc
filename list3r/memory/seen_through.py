"""How much of each local instance the frames of another session see through: what stayed, and what did not.

Two local instances of two sessions at one place are one thing only if neither session sees through the surface of the
other. That is asked of depth alone, so it holds for two things that look alike and for one thing in another light.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from list3r.memory.merging import PairScores
from list3r.memory.records import ChunkRow
from list3r.memory.store import Store
from list3r.memory.summaries import ChunkSummary, world_unit
from list3r.memory.visibility import View, VisibilitySettings, seen_through_share, views_of

Through = dict[tuple[int, int, int], float]
"""By chunk, position in it, and other session: share of its points that are seen through, of those it tells about."""


def seen_through(
    store: Store,
    chunks: Sequence[ChunkRow],
    pairs: Mapping[tuple[int, int], PairScores],
    summaries: Mapping[int, ChunkSummary],
    settings: VisibilitySettings,
    least_overlap: float = 0.2,
) -> Through:
    """Ask the chunks of other sessions that hold something at the place of an instance about that instance.

    Only instances that meet one of another session are asked about, and only in the chunks where it was found, so the
    cost depends on what two sessions share. An instance of which nothing is told has no entry.
    """
    rows = {c.chunk_id: c for c in chunks}
    asked: dict[tuple[int, int, int], set[int]] = {}
    for (u, v), p in pairs.items():
        if rows[u].session_id == rows[v].session_id:
            continue
        meet = np.maximum(p.i_on_j, p.j_on_i) >= least_overlap
        for i, j in zip(p.i[meet].tolist(), p.j[meet].tolist(), strict=True):
            asked.setdefault((u, i, rows[v].session_id), set()).add(v)
            asked.setdefault((v, j, rows[u].session_id), set()).add(u)
    unit = world_unit(chunks, summaries)
    views: dict[int, list[View]] = {}
    out: Through = {}
    for key, others in sorted(asked.items()):
        shapes = summaries[key[0]].shapes
        if shapes.structure[key[1]]:
            continue
        start, stop = np.searchsorted(shapes.owner, [key[1], key[1] + 1])
        points = rows[key[0]].S_world_chunk.apply(shapes.points[start:stop])
        for other in sorted(others):
            if other not in views:
                views[other] = views_of([rows[other]], {other: store.keyframes(other)}, unit)
        share = seen_through_share(points, [v for other in sorted(others) for v in views[other]], settings)
        if share is not None:
            out[key] = share
    return out
