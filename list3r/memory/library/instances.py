"""Things of the library: derived from their members, and kept for the next chunk that comes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import Sim3
from list3r.memory.library.derivation import Member, Thing, derive_mover, derive_thing
from list3r.memory.library.rules import ConsolidationSettings, World
from list3r.memory.merging.moving import Mover
from list3r.memory.overlap.pair_scores import Key
from list3r.memory.overlap.summaries import cameras_of
from list3r.memory.overlap.voxels import ChunkShapes
from list3r.memory.records import ChunkRow
from list3r.memory.store.derived import LruCache
from list3r.memory.store.store import Store

_KEPT = 400
"""Things that are kept; more are derived again when they are asked for, so that memory does not grow with chunks."""


class InstanceCache(LruCache[tuple[object, ...], Thing]):
    """Instances as they were derived from their members."""

    def __init__(self) -> None:
        super().__init__(_KEPT)
        self.stamps = itertools.count(1)


def thing_of(
    store: Store,
    instance_id: int,
    group: Sequence[Key],
    shown_by: Sequence[Key],
    chunks: Mapping[int, tuple[ChunkShapes, Sim3, NDArray[np.bool_]]],
    component: int,
    s: ConsolidationSettings,
    world: World,
    mover: Mover | None = None,
) -> Thing:
    """A thing, derived from its members unless it was just so before. `chunks` are the shapes, the settled poses in the
    world and the dropped points of its chunks.
    """
    upright = world.upright and component == world.first
    members = [
        Member(chunks[k][0], int(np.searchsorted(chunks[k][0].local_id, n)), chunks[k][1], chunks[k][2])
        for k, n in shown_by
    ]
    poses = tuple((store.node_checksum(k), chunks[k][1].as_matrix().tobytes()) for k in sorted({k for k, _ in group}))
    cuts = b"".join(np.packbits(m.dropped[slice(*m.span)]).tobytes() for m in members)
    key: tuple[object, ...] = (instance_id, component, upright, tuple(group), tuple(shown_by), poses, cuts, mover)
    kept = store.derived.of(InstanceCache)
    found = kept.get(key)
    if found is not None:
        return found
    if mover is None:
        thing = derive_thing(instance_id, members, component, upright=upright, settings=s.derive)
    else:
        last = [m for m, k in zip(members, group, strict=True) if k in mover.last]
        thing = derive_mover(
            instance_id, members, last, component, resting=mover.resting, upright=upright, settings=s.derive
        )
    return kept.put(key, replace(thing, body=replace(thing.body, stamp=next(kept.stamps))))


def eye_level(store: Store, chunks: Sequence[ChunkRow]) -> float:
    """Height that 90 % of the cameras of some chunks lie below; without cameras everything is below."""
    heights = cameras_of(store, chunks).translation[:, 2]
    return float(np.quantile(heights, 0.9)) if len(heights) else np.inf
