"""What has changed between sessions: instances seen again, moved, removed, added (design 3.9).

Instances of two sessions are one where their surfaces meet, they look alike, and neither session sees through the
surface of the other. An instance of an earlier session that the new one did not find is asked about in the new
session's frames: only where they see through its place, or measure there the surface of something new, is it gone, and
what no frame could see stays unseen. What is new is asked about in the frames of the sessions before in the same way.
What is gone from one place and new at another is one instance that moved if it looks and measures the same, one to one,
decided for all of them together. So is what an earlier session found gone and, less likely, what the frames tell
nothing of although they come near, where earlier frames see through the new place. An instance that moved keeps what
earlier sessions saw of it, but its box is that of the place where it is now.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import ChangeEvent, ChunkRow
from list3r.memory.library.change.free_space_carving import FreeSpaceCarving
from list3r.memory.library.change.matching import ChangeMatching
from list3r.memory.library.change.places import Places
from list3r.memory.library.change.records import Change, Changes, ChangeSettings, OverlapGroups
from list3r.memory.library.change.surface_colors import other_surfaces
from list3r.memory.library.overlap.pair_scores import PairScores
from list3r.memory.library.overlap.summaries import ChunkSummary
from list3r.memory.library.overlap.voxels import ChunkShapes
from list3r.memory.store.store import Store

__all__ = ["Change", "ChangeSettings", "Changes", "OverlapGroups", "across_sessions", "as_events", "find_changes"]

_LIGHTNESS = np.array([0.5, 1.0, 1.0])


def across_sessions(
    pairs: Mapping[tuple[int, int], PairScores],
    shapes: Mapping[int, ChunkShapes],
    S_graph_chunk: Mapping[int, Sim3],
    seen: FreeSpaceCarving,
    settings: ChangeSettings,
) -> dict[tuple[int, int], PairScores]:
    """Return scores of pairs without those that plainly are two instances of two sessions at one place."""
    if len({s.session_id for s in shapes.values()}) < 2:
        return dict(pairs)
    out = {}
    for (u, v), p in pairs.items():
        a, b = shapes[u], shapes[v]
        if a.session_id == b.session_id:
            out[u, v] = p
            continue
        size_a, size_b = a.size[p.i] / a.unit, b.size[p.j] / b.unit
        whole = (a.truncated[p.i] < settings.most_truncated) & (b.truncated[p.j] < settings.most_truncated)
        whole &= np.maximum(size_a, size_b) < settings.small_m
        color = np.linalg.norm((a.lab[p.i] - b.lab[p.j]) * _LIGHTNESS, axis=1)
        ratio = np.maximum(size_a, size_b) / np.maximum(np.minimum(size_a, size_b), 1e-9)
        S_v_u = S_graph_chunk[v].inverse() @ S_graph_chunk[u]
        changed = seen.shares(a, b, p, S_v_u)
        keep = ~other_surfaces(a, b, p, S_v_u, settings)
        keep &= ~(whole & ((color > settings.other_color) | (ratio > settings.other_size)))
        one, both = np.maximum(*changed), np.minimum(*changed)
        keep &= (one < settings.seen_through) | (~whole & (both < settings.seen_through / 2))
        # What the other session sees through does not lie on a surface that it saw.
        i_on_j, j_on_i = np.minimum(p.i_on_j, 1.0 - changed[0]), np.minimum(p.j_on_i, 1.0 - changed[1])
        out[u, v] = PairScores(p.i[keep], p.j[keep], i_on_j[keep], j_on_i[keep], p.shared[keep], p.frame_iou[keep])
    return out


def find_changes(
    store: Store,
    found: OverlapGroups,
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    settings: ChangeSettings,
) -> Changes:
    """Go through the sessions after the first, in order, and find what each has changed."""
    groups = [list(g) for g in found.groups]
    places = Places(store, groups, chunks, summaries, settings)
    matching = ChangeMatching(places, found, store.edits.constraints(), settings)
    for session in sorted({c.session_id for c in chunks})[1:]:
        matching.match(session)
    return matching.result()


def as_events(changes: Sequence[tuple[int | None, Change]]) -> list[ChangeEvent]:
    """Return the events of instances that have an id, each given with that, by session and id."""
    found = (
        ChangeEvent(c.session_id, n, c.kind, c.from_box, c.to_box, c.frames, c.confidence, c.reason)
        for n, c in changes
        if n is not None
    )
    return sorted(found, key=lambda e: (e.session_id, e.instance_id))
