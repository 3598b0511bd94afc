"""Revisits of the map of a whole video, as loops between its chunks."""

from __future__ import annotations

from list3r.association.overlap.camera_edge import ONE_FRAME
from list3r.association.whole_map.video_map import VideoMap
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge
from list3r.memory.store.store import Store


def write_revisits(store: Store, session: int, found: VideoMap, apart: int) -> None:
    """Write the revisits of a map as loops between its chunks, no two within `apart` frames of each other."""
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    for chunk in store.chunks.all(session):
        for frame in store.chunks.samples(chunk.chunk_id).camera_frames.tolist():
            first.setdefault(frame, chunk.chunk_id)
            last[frame] = chunk.chunk_id
    kept: list[tuple[int, int, int]] = []
    for a, b, count in sorted(found.revisits, key=lambda r: (-r[2], r)):
        if a not in first or b not in last or first[a] >= last[b]:
            continue
        if all(max(abs(a - c), abs(b - d)) > apart for c, d, _ in kept):
            kept.append((a, b, count))
    with store.transaction():
        store.edges.add(_loop(first[a], last[b], (a, b), count) for a, b, count in sorted(kept))


def _loop(u: int, v: int, frames: tuple[int, int], count: int) -> Edge:
    reason = f"{count} features of the map of the whole video are seen in both frames"
    return Edge(u, v, "loop", Sim3.identity(), 1.0, 1.0, count, 0.0, True, reason, dict(ONE_FRAME), frames)
