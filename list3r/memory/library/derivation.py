"""The library of a memory (paper 3.3), derived from what chunks saw and from their poses.

`derive` is a function: of the chunks with their poses, of the edits of operators, and, for ids alone, of who was who.
It is the same whenever and however often it is called, and depends on nothing that was derived before. What takes most
of its time, how pairs of chunks overlap, is kept (`library.scores`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.records import Instance, MergeDecision, Relation
from list3r.memory.library.evidence import Evidence, contested, weigh, without_missed
from list3r.memory.library.grouping import Group, Groups, chunks_of, group
from list3r.memory.library.identities import Identities, assign_ids
from list3r.memory.library.instances import DerivedInstance, derived_instance
from list3r.memory.library.overlap.pair_scores import Key, PairScores
from list3r.memory.library.redundancy import Redundant, find_redundant
from list3r.memory.library.relating import relate, with_structure
from list3r.memory.library.rooms.derivation import Rooms, find_rooms
from list3r.memory.library.rows import record_of
from list3r.memory.library.scene import Scene
from list3r.memory.library.scores import Pair
from list3r.memory.library.session_changes import SessionChanges, find_session_changes
from list3r.memory.library.uncertainty import position_sigmas


@dataclass(frozen=True)
class Known:
    """What was there before, for ids that last."""

    owners: Mapping[Key, int]
    """The instance of each local instance that belonged to one."""
    labels: Mapping[int, str | None]
    """What instances were called."""
    next_id: int
    """The smallest id that was never used."""
    rooms: Rooms


@dataclass(frozen=True)
class Library:
    """The instances of a memory, and all that is said of them."""

    instances: Mapping[int, Instance]
    features: Mapping[int, NDArray[np.float32]]
    """Unit length, by id. Shape (D,) each."""
    owners: Mapping[Key, int]
    """The instance of each local instance that belongs to one."""
    relations: Sequence[Relation]
    changes: SessionChanges
    ids: Identities
    of_first: Mapping[Key, int]
    """By first member of a group, its id."""
    decisions: Sequence[MergeDecision]
    hidden: int
    """Groups that are not shown."""
    rooms: Rooms | None
    """None while a session goes on: rooms are found when it has ended."""


def derive(scene: Scene, known: Known, *, ended: bool) -> Library:
    """Derive the library; `ended` says that the last session has, so that its changes are found."""
    formed = form(scene, ended=ended)
    changes, weighed = formed.changes, formed.weighed
    ids = _named(scene, formed, known)
    members = {n: g for g, n in zip(weighed, ids.of_group, strict=True) if n is not None}
    instances = with_structure(scene, _instances(scene, members, formed), members)
    states = {n: changes.states.get(g[0], "present") for n, g in members.items()}
    like = _like(formed.redundant, members)
    there = {n: i.geometry for n, i in instances.items() if states[n] != "removed"}
    return Library(
        instances=_records(scene, instances, members, like, changes, states, _labels(scene, members, known)),
        features={n: i.feature for n, i in instances.items()},
        owners={key: n for n, g in members.items() for key in (*g, *like[n])},
        relations=relate(scene, (i for n, i in instances.items() if states[n] != "removed")),
        changes=changes,
        ids=ids,
        of_first={g[0]: n for n, g in members.items()},
        decisions=[*formed.places.decisions, *changes.decisions],
        hidden=len(weighed) - len(members),
        rooms=find_rooms(scene, there, known.rooms) if ended else None,
    )


# ---------------------------------------------------------------------------------------------- which there are


@dataclass(frozen=True)
class Formed:
    """The groups of local instances, and which of them are shown."""

    redundant: Redundant
    overlaps: Mapping[Pair, PairScores]
    places: Groups
    """By overlap, and by what was seen of their motion."""
    changes: SessionChanges
    """With those joined that are one instance at several places."""
    weighed: Mapping[Group, Evidence]
    """What speaks for and against each, in their order."""
    shown: Mapping[Group, bool]


def form(scene: Scene, *, ended: bool) -> Formed:
    """Group the local instances, find what sessions have changed, and weigh what came of that."""
    scene.scores.prepare(scene.pairs(scene.rows.keys()), every=True)
    redundant = find_redundant(scene)
    overlaps = scene.overlaps(scene.pairs(scene.rows.keys() - redundant.whole), redundant.like)
    places = group(scene, overlaps, redundant.like)
    weighed = _weighed(scene, places.groups, overlaps)
    found = [*_shown(scene, weighed).values()]
    changes = find_session_changes(scene, places.groups, found, [*places.movers], ended=ended)
    if changes.groups != places.groups:
        weighed = _weighed(scene, changes.groups, overlaps)
    shown = _shown(scene, weighed, {first for first, _ in changes.events})
    return Formed(redundant, overlaps, places, changes, weighed, shown)


def _weighed(scene: Scene, groups: Sequence[Group], overlaps: Mapping[Pair, PairScores]) -> dict[Group, Evidence]:
    """Return what speaks for and against groups, in their order."""
    chunks = {k: scene.shapes(k) for k in sorted({k for pair in overlaps for k in pair})}
    return dict(zip(groups, weigh(groups, chunks, overlaps, scene.settings.evidence), strict=True))


def _shown(scene: Scene, weighed: Mapping[Group, Evidence], with_events: set[Key] | None = None) -> dict[Group, bool]:
    """Return which groups are shown: by the evidence, because they have an event, or because an operator says so."""
    settings, posed, told = scene.settings.evidence, scene.world.posed, with_events or set()
    groups = list(weighed)
    enough = [e.shown(settings, posed) or g[0] in told for g, e in weighed.items()]
    return dict(zip(groups, scene.constraints.shown(groups, enough), strict=True))


def _named(scene: Scene, formed: Formed, known: Known) -> Identities:
    """Give ids to the groups that are shown."""
    groups = list(formed.weighed)
    evidence, visible = [*formed.weighed.values()], [formed.shown[g] for g in groups]
    inside = {key for g in groups for key in g}
    before = {key: n for key, n in known.owners.items() if key in inside}
    before = without_missed(scene.constraints.remembered(groups, before), groups, evidence, visible)
    within = [next((w for w in e.within if visible[w]), None) for e in evidence]
    weights = {key: scene.seen_for(key) for key in before}
    return assign_ids(groups, before, weights, visible, within, known.next_id)


def _labels(scene: Scene, members: Mapping[int, Group], known: Known) -> dict[int, str | None]:
    """Return what instances are called: what they were, and what edits say, which goes to the group with most of what
    it was given to.
    """
    labels = {n: known.labels.get(n) for n in members}
    groups, ids = list(members.values()), list(members)
    named = {key for keys, _ in scene.constraints.labels for key in keys}
    weights = {key: scene.seen_for(key) for group in groups for key in group if key in named}
    return labels | {ids[at]: text for at, text in scene.constraints.labels_of(groups, weights).items()}


# ---------------------------------------------------------------------------------------------- what they are


def _instances(scene: Scene, members: Mapping[int, Group], formed: Formed) -> dict[int, DerivedInstance]:
    """Return the instances of groups, by id, without the points that belong to something else."""
    world, groups, settings = scene.world, list(formed.weighed), scene.settings.derive
    chunks = {k: scene.shapes(k) for k in chunks_of(groups)}
    poses = {k: scene.pose(k) for k in chunks}
    dropped = contested(groups, chunks, poses, world.unit, scene.settings.evidence)
    out = {}
    for n, g in members.items():
        of = {k: (chunks[k], poses[k], dropped[k]) for k, _ in g}
        mover = formed.places.movers.get(g[0])
        here = g if mover is not None else formed.changes.current.get(g[0], g)
        component = scene.component(g[0][0])
        upright = world.stands(component)
        derived = partial(derived_instance, n, chunks=of, component=component, upright=upright, settings=settings)
        found = derived(here)
        if mover is not None:
            now = derived([key for key in g if key in mover.last])
            found = replace(found, geometry=now.geometry, box=now.box, shape=now.shape)
            found = replace(found, dynamic=True, resting=mover.resting)
        out[n] = replace(found, geometry=replace(found.geometry, confidence=round(formed.weighed[g].confidence, 4)))
    return out


def _like(redundant: Redundant, members: Mapping[int, Group]) -> dict[int, dict[Key, Key]]:
    """Return the redundant local instances of each instance, with the members that they are like."""
    home = {key: n for n, g in members.items() for key in g}
    out: dict[int, dict[Key, Key]] = {n: {} for n in members}
    for key, like in redundant.like.items():
        if like in home:
            out[home[like]][key] = like
    return out


def _records(
    scene: Scene,
    instances: Mapping[int, DerivedInstance],
    members: Mapping[int, Group],
    like: Mapping[int, Mapping[Key, Key]],
    changes: SessionChanges,
    states: Mapping[int, str],
    labels: Mapping[int, str | None],
) -> dict[int, Instance]:
    metric = scene.store.facts.scale_kind != "relative"
    seen = {n: chunks_of([g]) for n, g in members.items()}
    order = {k: at for at, k in enumerate(scene.rows)}
    owner = np.repeat(np.arange(len(seen)), [len(c) for c in seen.values()])
    centers = np.array([i.box.center for i in instances.values()]).reshape(-1, 3)
    by = np.array([order[k] for c in seen.values() for k in c], np.int64)
    sigmas = position_sigmas(centers, owner, by, list(scene.rows.values()))
    out = {}
    for (n, found), sigma in zip(instances.items(), sigmas, strict=True):
        g = members[n]
        here = set(changes.current.get(g[0], g))
        more = [key for key, member in like[n].items() if member in here]
        times = scene.times_of(dict.fromkeys([*seen[n], *(k for k, _ in more)]))
        frames = [(scene.session(k), f) for k, m in more for f in scene.frames_of((k, m)).tolist()]
        record = record_of(found, labels[n], times, scene.world, frames, metric=metric)
        out[n] = replace(record, state=states[n], position_sigma_m=sigma)
    return out
