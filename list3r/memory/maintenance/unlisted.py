"""Instances of groups that are not listed, because there is too little evidence for them, made on demand. As with
scraps, nothing else is derived from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.change.ledger import Group, read_ledger
from list3r.memory.library.grouping import Grouping
from list3r.memory.library.instances import Member, derive_instance
from list3r.memory.library.region import DirtySet, Region
from list3r.memory.library.rows import record_of
from list3r.memory.library.rules import WORLD, World, settings_of
from list3r.memory.library.weighing import Weighing
from list3r.memory.maintenance.scraps import Scrap
from list3r.memory.overlap.pair_scores import Key
from list3r.memory.overlap.summaries import chunk_summaries
from list3r.memory.records import FIRST_UNLISTED
from list3r.memory.store.store import Store


def derive_unlisted(store: Store) -> list[Scrap]:
    """Return the groups that are not listed: by id, which is the same as long as the chunks are.

    What lies within a listed instance is a view of that one, what the chunks take for structure in the main is that,
    and what an operator deleted stays away.
    """
    world = store.facts[WORLD]
    ledger = read_ledger(store, store.chunks.all())
    if world is None or ledger is None or not store.library.members.hidden_groups():
        return []
    settings = settings_of(store, None)
    region = Region(store, chunk_summaries(store, settings.shapes), world, settings)
    grouping = Grouping(region, DirtySet(frozenset(), frozenset(), {}, frozenset(), whole=False), ledger)
    groups = grouping.groups_in(region.rows)
    listed = {g for g in groups if grouping.shown_before.get(g, False)}
    allowed = grouping.constraints.shown(groups, [True] * len(groups))
    hidden = [g for g, may in zip(groups, allowed, strict=True) if may and g not in listed]
    hidden = [g for g in hidden if all(map(region.takes_part, g))]
    weighing = Weighing(grouping)
    weighed = weighing.weigh_only(hidden)
    rank = {key: n for n, key in enumerate(sorted(key for g in groups for key in g))}
    out = []
    for g in hidden:
        members = [
            Member(x, int(np.searchsorted(x.local_id, n)), region.pose(k), np.zeros(len(x.points), bool))
            for k, n, x in ((k, n, region.shapes(k)) for k, n in g)
        ]
        if weighing.inside(g, listed) or np.mean([m.shapes.structure[m.at] for m in members]) > 0.5:
            continue
        out.append(_instance(region, world, FIRST_UNLISTED + rank[g[0]], g, members, weighed.evidence[g].confidence))
    return sorted(out, key=lambda s: s.instance.id)


def _instance(
    region: Region, world: World, instance_id: int, group: Group, members: Sequence[Member], confidence: float
) -> Scrap:
    component = region.settled[group[0][0]].component
    upright = world.upright and component == world.first
    found = derive_instance(instance_id, members, component, upright=upright, settings=region.settings.derive)
    found = replace(found, geometry=replace(found.geometry, confidence=round(confidence, 4)))
    times = {f: t for k in sorted({k for k, _ in group}) for f, t in region.times_of(k).items()}
    metric = region.store.facts.scale_kind != "relative"
    keys: tuple[Key, ...] = tuple(group)
    return Scrap(record_of(found, None, times, world, metric=metric), keys, found.feature)
