"""Settings of consolidation, what it reports, and what holds for the whole of a memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from list3r.memory.core.records import ChunkRow
from list3r.memory.core.settings import stored_settings
from list3r.memory.library.change.detection import ChangeSettings
from list3r.memory.library.evidence import EvidenceSettings
from list3r.memory.library.instances import DeriveSettings
from list3r.memory.library.labels import LabelSettings
from list3r.memory.library.merging.movers import MovingSettings
from list3r.memory.library.merging.settings import MergeSettings
from list3r.memory.library.overlap.metre import metre_by_height
from list3r.memory.library.overlap.planes import place_planes
from list3r.memory.library.overlap.summaries import Summaries, cameras_of, is_known, light_of, sample_of, world_unit
from list3r.memory.library.overlap.voxels import ShapeSettings
from list3r.memory.library.relations.settings import RelationSettings
from list3r.memory.library.relations.structure import StructureSettings
from list3r.memory.library.scores import RoundingSettings
from list3r.memory.library.world.gravity import GravitySettings, floor_height, sure_of_up
from list3r.memory.library.world.world import World
from list3r.memory.store.store import Store

_POSED = 80
"""Posed frames from which it does not matter any more how many there are, see `EvidenceSettings.min_share`."""


@dataclass(frozen=True)
class RedundancySettings:
    """When a local instance adds nothing to what other chunks saw."""

    chunks: int = 12
    """Earlier chunks of its session that must have seen its surface, as one thing or in pieces; 0: none is so."""
    covered: float = 0.75
    """Share of its surface that they must have seen."""


@dataclass(frozen=True)
class ConsolidationSettings:
    """How the library is derived from the chunks."""

    merging: MergeSettings = field(default_factory=MergeSettings)
    moving: MovingSettings = field(default_factory=MovingSettings)
    derive: DeriveSettings = field(default_factory=DeriveSettings)
    structure: StructureSettings = field(default_factory=StructureSettings)
    relations: RelationSettings = field(default_factory=RelationSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    rounding: RoundingSettings = field(default_factory=RoundingSettings)
    changes: ChangeSettings = field(default_factory=ChangeSettings)
    labels: LabelSettings = field(default_factory=LabelSettings)
    shapes: ShapeSettings = field(default_factory=ShapeSettings)
    gravity: GravitySettings = field(default_factory=GravitySettings)
    redundancy: RedundancySettings = field(default_factory=RedundancySettings)


def settings_of(store: Store, settings: ConsolidationSettings | None) -> ConsolidationSettings:
    """Return the settings for a memory, those it was begun with unless others are given.

    What no sensor measured is less exact.
    """
    s = settings or stored_settings(store, ConsolidationSettings, "library")
    if store.facts.scale_kind == "metric":
        return s
    noise, band = s.relations.computed_noise_m, s.structure.computed_floor_band_m
    return replace(
        s,
        evidence=replace(s.evidence, odds=s.evidence.computed_odds),
        relations=replace(s.relations, noise_m=max(s.relations.noise_m, noise)),
        structure=replace(s.structure, floor_band_m=max(s.structure.floor_band_m, band), least_flagged=0.0),
    )


@dataclass(frozen=True)
class ConsolidationReport:
    """What changed in the library."""

    instances: int
    """Instances in the library now."""
    structure: int
    """Pieces of structure in it now."""
    new: tuple[int, ...]
    """Ids that appeared."""
    merged: tuple[tuple[int, int], ...]
    """(id that retired, id that it is an alias of)."""
    hidden: int
    """Groups of local instances that are not shown: seen too little, or fragments of an instance that is."""
    written: frozenset[int] | None = None
    """Ids to which something came; None where the library was derived."""


def look_at_world(store: Store, chunks: list[ChunkRow], summaries: Summaries, s: ConsolidationSettings) -> World:
    """Return what holds for the whole memory now; by a sample of at most 64 chunks."""
    first = min(c.component for c in chunks)
    upright = _upright(store)
    inside = [c for c in chunks if c.component == first]
    unit = world_unit(chunks, summaries)
    floor = _floor(store, inside, summaries, unit) if upright else None
    unit = unit if is_known(chunks, summaries) else _by_cameras(store, inside, floor, unit)
    spaces = {store.chunks.feature_space(c.chunk_id) for c in chunks}
    return World(
        unit=unit,
        light=light_of(chunks, summaries),
        floor_seen=floor is not None,
        upright=upright,
        first=first,
        chunks=len(chunks),
        posed=store.frames.posed_count(_POSED),
        space=spaces.pop() if len(spaces) == 1 else "",
        sure_of_up=sure_of_up(store),
        guessed=store.facts.scale_kind == "guessed",
        upright_parts=store.facts.upright_parts,
    )


def _upright(store: Store) -> bool:
    return store.facts.gravity != "unknown"


def _floor(store: Store, inside: list[ChunkRow], summaries: Summaries, unit: float) -> float | None:
    """0 where the world was laid on its floor, else the height at which the planes show one."""
    estimate = store.facts.gravity_estimate
    if estimate is not None:
        return None if estimate.floor_height is None else 0.0
    some = sample_of(inside)
    cameras = cameras_of(store, some).translation
    planes = place_planes([(summaries.planes(c.chunk_id), c.S_world_chunk) for c in some])
    return floor_height(np.array([0.0, 0.0, 1.0]), planes, cameras, unit) if len(cameras) else None


def _by_cameras(store: Store, inside: list[ChunkRow], floor: float | None, unit: float) -> float:
    """Return what a metre is by the depths, which tell `unit`, and by how high over the floor the cameras were."""
    heights = cameras_of(store, sample_of(inside)).translation[:, 2]
    height = float(np.median(heights)) - floor if floor is not None and len(heights) else 0.0
    return metre_by_height(height, unit)
