"""Instances of groups that are not listed, because there is too little evidence for them, made on demand. As with
scraps, nothing else is derived from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.core.records import FIRST_UNLISTED
from list3r.memory.library.derivation import form
from list3r.memory.library.grouping import Group
from list3r.memory.library.instances import Member, derive_instance
from list3r.memory.library.maintenance.scraps import Scrap
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.summaries import chunk_summaries
from list3r.memory.library.rows import record_of
from list3r.memory.library.rules import WORLD, World, settings_of
from list3r.memory.library.scene import Scene
from list3r.memory.store.store import Store


def derive_unlisted(store: Store) -> list[Scrap]:
    """Return the groups that are not listed: by id, which is the same as long as the chunks are.

    What lies within a listed instance is a view of that one, what the chunks take for structure in the main is that,
    and what an operator deleted stays away.
    """
    world = store.facts[WORLD]
    if world is None:
        return []
    settings = settings_of(store, None)
    scene = Scene(store, chunk_summaries(store, settings.shapes), world, settings)
    formed = form(scene, ended=all(session.state == "complete" for session in store.sessions.all()))
    groups = list(formed.weighed)
    owners = store.observations.owners([key for g in groups for key in g])
    allowed = scene.constraints.shown(groups, [True] * len(groups))
    rank = {key: n for n, key in enumerate(sorted(key for g in groups for key in g))}
    out = []
    for (g, evidence), may in zip(formed.weighed.items(), allowed, strict=True):
        if not may or any(key in owners for key in g) or any(formed.shown[groups[w]] for w in evidence.within):
            continue
        members = [
            Member(x, int(np.searchsorted(x.local_id, n)), scene.pose(k), np.zeros(len(x.points), bool))
            for k, n, x in ((k, n, scene.shapes(k)) for k, n in g)
        ]
        if np.mean([m.shapes.structure[m.at] for m in members]) <= 0.5:
            out.append(_instance(scene, world, FIRST_UNLISTED + rank[g[0]], g, members, evidence.confidence))
    return sorted(out, key=lambda s: s.instance.id)


def _instance(
    scene: Scene, world: World, instance_id: int, group: Group, members: Sequence[Member], confidence: float
) -> Scrap:
    component = scene.component(group[0][0])
    upright = world.stands(component)
    found = derive_instance(instance_id, members, component, upright=upright, settings=scene.settings.derive)
    found = replace(found, geometry=replace(found.geometry, confidence=round(confidence, 4)))
    times = scene.times_of({k for k, _ in group})
    metric = scene.store.facts.scale_kind != "relative"
    keys: tuple[Key, ...] = tuple(group)
    return Scrap(record_of(found, None, times, world, metric=metric), keys, found.feature)
