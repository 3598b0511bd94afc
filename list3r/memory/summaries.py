"""What merging and gravity look at, derived once from each chunk and kept as long as the store is open."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from list3r.memory.colors import Reference, lab_from_rgb, scene_reference
from list3r.memory.geometry import Array, Sim3
from list3r.memory.planes import Planes, chunk_planes
from list3r.memory.records import ChunkRow, MotionTrack
from list3r.memory.shapes import ChunkShapes, ShapeSettings, chunk_shapes
from list3r.memory.store import Store

ROOM_DEPTH_M = 2.0
"""How far things are from the camera indoors, on the median: what lends a relative memory its notion of a metre."""


_COLORS = 1000
"""Points of a chunk whose colours tell the light."""


@dataclass(frozen=True)
class ChunkSummary:
    """One chunk without its masks and most of its points; chunk coordinates."""

    shapes: ChunkShapes
    planes: Planes
    cannot_link: NDArray[np.int32]
    """Pairs of local ids. Shape (P, 2)."""
    unit: float
    """What a metre is in chunk units: 1 for a metric chunk."""
    lab: Array
    """Colours of a sample of all its points, CIE L*a*b*. Shape (C, 3)."""
    motions: dict[int, MotionTrack | None]
    """The local instances that move, by local id, and where they were; what bounds a room never does."""


_cache: WeakKeyDictionary[Store, dict[int, tuple[int, ChunkSummary]]] = WeakKeyDictionary()


def chunk_summaries(store: Store, settings: ShapeSettings | None = None) -> dict[int, ChunkSummary]:
    """The summaries of all chunks by id. They depend on what the chunks measured, not on where they are placed."""
    checks = store.node_checksums()
    known = _cache.setdefault(store, {})
    for chunk_id in [k for k, (crc, _) in known.items() if checks.get(k) != crc]:
        del known[chunk_id]
    for chunk in store.chunks():
        if chunk.chunk_id not in known:
            known[chunk.chunk_id] = (checks[chunk.chunk_id], _summary(store, chunk, settings))
    return {k: summary for k, (_, summary) in sorted(known.items())}


def _summary(store: Store, chunk: ChunkRow, settings: ShapeSettings | None) -> ChunkSummary:
    nodes = store.local_nodes([chunk.chunk_id])
    planes = chunk_planes(nodes)
    unit = 1.0 if chunk.scale_kind == "metric" else _unit(planes, store, chunk)
    shapes = chunk_shapes(nodes, chunk.image_size, unit, settings, chunk_id=chunk.chunk_id, session_id=chunk.session_id)
    lab = lab_from_rgb(shapes.rgb[:: max(1, len(shapes.rgb) // _COLORS)])
    moves = [n.local_id for n in nodes if n.dynamic and not n.structure]
    motions = {n: store.motion_track(chunk.chunk_id, n) for n in moves}
    return ChunkSummary(shapes, planes, store.cannot_links(chunk.chunk_id), unit, lab, motions)


def _unit(planes: Planes, store: Store, chunk: ChunkRow) -> float:
    centers = [k.T_chunk_cam[:3, 3] for k in store.keyframes(chunk.chunk_id)] or [np.zeros(3)]
    if len(planes.points) == 0:
        return 1.0
    distance = np.linalg.norm(planes.points[:, None] - np.array(centers)[None], axis=2)
    return max(float(np.median(distance)) / ROOM_DEPTH_M, 1e-9)


def world_unit(chunks: Sequence[ChunkRow], summaries: Mapping[int, ChunkSummary]) -> float:
    """What a metre is about in world units: 1 for a metric memory, else told by the distances of things."""
    known = getattr(summaries, "metre", None)
    if known is not None:
        return float(known)
    units = [float(c.S_world_chunk.scale) * summaries[c.chunk_id].unit for c in chunks]
    return float(np.median(units)) if units else 1.0


def light_of(summaries: Mapping[int, ChunkSummary]) -> Reference:
    """The light of a memory, from the colours of all its chunks."""
    return scene_reference(np.concatenate([s.lab for s in summaries.values()] or [np.zeros((0, 3))]))


def cameras_of(store: Store, chunks: Sequence[ChunkRow]) -> Sim3:
    """Poses `S_world_cam` of all posed frames of these chunks, batched over frames."""
    placed = {c.chunk_id: c.S_world_chunk for c in chunks}
    frames = [f for f in store.frames() if f.state == "posed" and f.chunk_id in placed]
    if not frames:
        return Sim3(np.ones(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    T_chunk_cam: Array = np.array([f.T_chunk_cam for f in frames])
    owner = [placed[f.chunk_id] for f in frames]
    S_world_chunk = Sim3(
        np.array([float(S.scale) for S in owner]),
        np.array([S.rotation for S in owner]),
        np.array([S.translation for S in owner]),
    )
    return S_world_chunk @ Sim3(np.ones(len(frames)), T_chunk_cam[:, :3, :3], T_chunk_cam[:, :3, 3])
