"""What merging and gravity look at, derived once from each chunk and kept as long as the store is open."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.description.colors import Reference, lab_from_rgb, scene_reference
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import ChunkRow, MotionTrack
from list3r.memory.core.settings import stored_settings
from list3r.memory.library.overlap.metre import metre_by_sight
from list3r.memory.library.overlap.planes import Planes, chunk_planes, sampled_faces
from list3r.memory.library.overlap.voxels import ChunkShapes, ShapeSettings, chunk_shapes, read_every, with_samples
from list3r.memory.store.derived import KEPT_TURNS, LruCache
from list3r.memory.store.store import Store

T = TypeVar("T")


_ROUNDED = 1e-9
"""Products of rigid poses have a scale that differs from 1 by no more."""
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
    motions: dict[int, MotionTrack | None]
    """The local instances that move, by local id, and where they were; what bounds a room never does."""

    @cached_property
    def digest(self) -> bytes:
        """What tells it apart from any other: overlaps are kept by it."""
        digest, shapes = hashlib.blake2b(digest_size=16), self.shapes
        measured = (shapes.local_id, shapes.points, shapes.rgb, shapes.owner, shapes.occupied, shapes.truncated)
        parts: list[NDArray[Any]] = [*measured, *shapes.frames, *shapes.boxes_xyxy]
        for part in parts:
            digest.update(part.tobytes())
        digest.update(repr(sorted(self.motions)).encode())
        return digest.digest()

    @property
    def sampled(self) -> SampledChunk:
        """What is asked of it where it is one of those that tell what holds for the whole memory."""
        rgb = self.shapes.rgb
        return SampledChunk(self.planes, rgb[:: max(1, len(rgb) // _COLORS)].copy())


@dataclass(frozen=True)
class SampledChunk:
    """What one chunk tells of the whole memory: which way is up, and the light."""

    planes: Planes
    rgb: NDArray[np.uint8]
    """Colours of a sample of all its points. Shape (C, 3)."""


_KEPT_BYTES = 256 << 20
"""Summaries that are kept, by their size; more are derived again when they are asked for, so that memory does not grow
with chunks. Of a chunk with 12 instances it takes 0.2 MB, of one with 50 a megabyte."""
_SAMPLED = 64
"""Chunks of a long memory that tell what holds for all of it: its light, its scale, which way is up."""
_GOLDEN = (5.0**0.5 - 1.0) / 2.0
"""Multiples of it are spread most evenly over [0, 1) once whole numbers are taken off."""


def _bytes_of(summary: ChunkSummary) -> int:
    """Return what the arrays of a summary take, about."""
    parts: list[object] = [summary.cannot_link]
    for value in (*vars(summary.shapes).values(), *vars(summary.planes).values()):
        parts += value if isinstance(value, tuple) else [value]
    return sum(p.nbytes + 100 for p in parts if isinstance(p, np.ndarray))


class SummaryCache(LruCache[tuple[int, int, ShapeSettings | None], ChunkSummary]):
    """Summaries by chunk id, checksum of what the chunk measured, and settings."""

    def __init__(self) -> None:
        super().__init__(_KEPT_BYTES, _bytes_of, KEPT_TURNS)


class SampledCache(LruCache[tuple[int, int], SampledChunk]):
    """By chunk id and checksum of what the chunk measured: up to 64 chunks are asked for theirs with every new one."""

    def __init__(self) -> None:
        super().__init__(_SAMPLED * 2)


class Summaries(Mapping[int, ChunkSummary]):
    """The summaries of chunks by id, derived when first asked for.

    They depend on what the chunks measured, not on where they are placed.
    """

    def __init__(self, store: Store, settings: ShapeSettings | None = None) -> None:
        self._store = store
        self._settings = settings
        self._ids = [c.chunk_id for c in store.chunks.all()]
        self._known = store.derived.of(SummaryCache)
        self._checked: dict[int, int] = {}

    def __getitem__(self, chunk_id: int) -> ChunkSummary:
        key = chunk_id, self._checksum(chunk_id), self._settings
        found = self._known.get(key)
        return found or self._known.put(key, _summary(self._store, self._store.chunks.get(chunk_id), self._settings))

    def planes(self, chunk_id: int) -> Planes:
        """Return the planes of a chunk."""
        return self.sampled(chunk_id).planes

    def sampled(self, chunk_id: int) -> SampledChunk:
        """Return what a chunk tells of the whole memory."""
        known, key = self._store.derived.of(SampledCache), (chunk_id, self._checksum(chunk_id))
        return known.get(key) or known.put(key, self[chunk_id].sampled)

    def _checksum(self, chunk_id: int) -> int:
        if chunk_id not in self._checked:
            self._checked[chunk_id] = self._store.chunks.checksum(chunk_id)
        return self._checked[chunk_id]

    @property
    def metre(self) -> float | None:
        """What a metre is where the chunks lie now, of a memory whose scale was anchored; None where nobody knows."""
        metres = self._store.facts.metres_per_graph_unit
        if metres is None:
            return None
        scale = self._store.facts.S_world_graph.scale
        return float(scale) / float(metres)

    def __iter__(self) -> Iterator[int]:
        return iter(self._ids)

    def __len__(self) -> int:
        return len(self._ids)


class SomeSummaries(Mapping[int, ChunkSummary]):
    """The summaries of some chunks, for who goes through all of them; `metre` is what a metre is in world units."""

    def __init__(self, known: Mapping[int, ChunkSummary], chunk_ids: Iterable[int], metre: float) -> None:
        self._of, self._ids, self.metre = known, sorted(chunk_ids), metre

    def __getitem__(self, chunk_id: int) -> ChunkSummary:
        return self._of[chunk_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._ids)

    def __len__(self) -> int:
        return len(self._ids)


def chunk_summaries(store: Store, settings: ShapeSettings | None = None) -> Summaries:
    """Return the summaries of all chunks by id; without settings, by those that the memory was begun with."""
    return Summaries(store, settings or stored_settings(store, ShapeSettings, "library", "shapes"))


def sample_of(chunks: Sequence[T]) -> list[T]:
    """At most 64 chunks, spread evenly over those given: what holds for all of a long memory is decided by them.

    Of pairs one stays, the earlier or the later one by a sequence without a period, until there are so few. So a walk
    to and fro is not asked about one end alone, and of more chunks it is some of the same and later ones (decision
    0172).
    """
    kept = np.arange(len(chunks))
    while len(kept) > _SAMPLED:
        pairs = len(kept) // 2
        later = np.arange(1, pairs + 1) * _GOLDEN % 1.0 < 0.5
        kept = np.append(np.where(later, kept[1 : 2 * pairs : 2], kept[: 2 * pairs : 2]), kept[2 * pairs :])
    return [chunks[k] for k in kept.tolist()]


def _summary(store: Store, chunk: ChunkRow, settings: ShapeSettings | None) -> ChunkSummary:
    nodes = store.local_instances.nodes([chunk.chunk_id])
    planes = chunk_planes(nodes)
    unit = 1.0 if chunk.scale_kind == "metric" else _unit(store, chunk)
    shapes = chunk_shapes(nodes, chunk.image_size, unit, settings, chunk_id=chunk.chunk_id, session_id=chunk.session_id)
    shapes = read_every(shapes, store.sessions.get(chunk.session_id).depth_step or 1)
    if chunk.scale_kind != "metric":
        samples = store.chunks.samples(chunk.chunk_id)
        shapes, planes = with_samples(shapes, samples), replace(planes, faces=sampled_faces(samples))
    moves = [n.local_id for n in nodes if n.dynamic and not n.structure]
    motions = {n: store.local_instances.motion_track(chunk.chunk_id, n) for n in moves}
    return ChunkSummary(shapes, planes, store.chunks.cannot_links(chunk.chunk_id), unit, motions)


def _unit(store: Store, chunk: ChunkRow) -> float:
    """Return about what a metre is in chunk units, by what the cameras saw."""
    samples = store.chunks.samples(chunk.chunk_id)
    T_chunk_cam = samples.T_chunk_cam[np.searchsorted(samples.camera_frames, samples.frame)]
    depth = np.einsum("ni,ni->n", samples.points - T_chunk_cam[:, :3, 3], T_chunk_cam[:, :3, 2])
    return metre_by_sight(samples.points, depth, samples.T_chunk_cam)


def is_known(chunks: Iterable[ChunkRow], summaries: Mapping[int, ChunkSummary]) -> bool:
    """Return whether somebody knows what a metre is in world units: a sensor, or who gave an anchor."""
    if getattr(summaries, "metre", None) is not None:
        return True
    return all(c.scale_kind == "metric" and abs(float(c.S_world_chunk.scale) - 1.0) <= _ROUNDED for c in chunks)


def world_unit(chunks: Sequence[ChunkRow], summaries: Mapping[int, ChunkSummary]) -> float:
    """Return what a metre is in world units: 1 for a metric memory, what an anchor says, or what the distances tell."""
    known = getattr(summaries, "metre", None)
    if is_known(chunks, summaries):
        return 1.0 if known is None else float(known)
    told = [(c, summaries[c.chunk_id]) for c in sample_of(chunks)]
    seeing = [(c, s) for c, s in told if c.scale_kind == "metric" or len(s.shapes.samples)]
    units = [float(c.S_world_chunk.scale) * s.unit for c, s in seeing or told]
    return float(np.median(units)) if units else 1.0


def light_of(chunks: Sequence[ChunkRow], summaries: Mapping[int, ChunkSummary]) -> Reference:
    """Return the light of a memory, from the colours of its chunks."""
    ids = [c.chunk_id for c in sample_of(chunks)]
    told = [summaries.sampled(k) if isinstance(summaries, Summaries) else summaries[k].sampled for k in ids]
    return scene_reference(np.concatenate([lab_from_rgb(chunk.rgb) for chunk in told] or [np.zeros((0, 3))]))


def cameras_of(store: Store, chunks: Sequence[ChunkRow]) -> Sim3:
    """Return poses `S_world_cam` of all posed frames of these chunks, batched over frames."""
    placed = {c.chunk_id: c.S_world_chunk for c in chunks}
    frames = [f for c in chunks for f in store.frames.of(c) if f.state == "posed"]
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
