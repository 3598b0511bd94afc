"""Local instances of all chunks to the global library (paper 3.3): group, keep ids, derive, relate, log.

There is one path (decision 0020). What has to be derived anew is a set of chunks (`DirtySet`): the one that came in and
those that moved, or all of them where something changed that holds for the whole memory. What lies further away need
not be looked at:

- Groups are formed of a set that no edge leaves (`Grouping.partition`).
- A group is weighed by the pairs of its own chunks.
- Points that belong to something else are decided by the cells of local instances that are new, moved or regrouped.
- Structure and relations are decided by what lies within a few metres, which the R*Tree finds; no instance is longer
  than `MergeSettings.most_span_m`.
- What has changed between sessions is found when one ends, of the chunks that it saw and of those that see the same
  places; what sessions before told stands, unless chunks of theirs have moved or what they saw was edited.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from list3r.memory.change.ledger import ChangeLedger, Group, read_ledger, write_ledger
from list3r.memory.geometry import Array
from list3r.memory.library.grouping import Grouping
from list3r.memory.library.identities import Identities
from list3r.memory.library.redundancy import cull, follow
from list3r.memory.library.region import DirtySet, Region
from list3r.memory.library.rows import carry_instances, in_light, log_decisions, put_exactly
from list3r.memory.library.rules import (
    WORLD,
    ConsolidationReport,
    ConsolidationSettings,
    World,
    edited_since,
    known_world,
    last_edit,
    look_at_world,
    obeys,
    settings_of,
)
from list3r.memory.library.session_changes import SessionChanges
from list3r.memory.library.settled_poses import Carried, CarrySettings, carry, extent_of, settle, settled_chunks
from list3r.memory.library.weighing import Weighing
from list3r.memory.library.writing import Writer
from list3r.memory.overlap.summaries import Summaries, chunk_summaries
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import SettledRow

__all__ = ["ConsolidationReport", "ConsolidationSettings", "consolidate"]

_LOOKED_AT = 64
"""Chunks up to which it is looked again, each time they have doubled, what holds for the whole memory; later that is
done when a session ends, for what changes it makes all instances be derived anew."""


def consolidate(
    store: Store, chunk_id: int | None = None, settings: ConsolidationSettings | None = None
) -> ConsolidationReport:
    """Bring the library up to date with the chunks as they are placed now; call inside a transaction.

    `chunk_id` is the chunk that has just come in and names the entries of the merge log. None stands for the last one
    and for the end of a session: instances are put where their chunks lie to the last digit, and what has changed
    between sessions is found. The result depends on what the store holds alone, so a build that goes on after a crash
    comes to the same library.
    """
    s = settings_of(store, settings)
    chunks = store.chunks.all()
    if not chunks:
        return ConsolidationReport(0, 0, (), (), 0)
    ended, last = chunk_id is None, chunks[-1].chunk_id if chunk_id is None else chunk_id
    summaries, before = chunk_summaries(store, s.shapes, hold=True), store.library.settled.all()
    if not ended:
        summaries.keep_sample()
        store.derived.end_turn()
    ledger = read_ledger(store, chunks)
    carried = _carry(store, summaries, s) if ended and ledger is not None else None
    if ledger is not None and carried is not None:
        ledger = replace(ledger, stands=False)
    known = store.facts[WORLD]
    world = _standing_world(store, summaries, s, ended=ended)
    moved = settle(store, summaries, s.hysteresis, None if ended or world is None else _replaced(store, before))
    if carried is not None:
        moved, before = moved | carried.dirty, {**carried.rows, **carried.before}
    whole = False
    if ledger is None or world is None or _most_moved(store, moved, len(before), world, s):
        moved |= settle(store, summaries, s.hysteresis)
        store.library.settled.rest()
        world, whole = look_at_world(store, settled_chunks(store), summaries, s), True
    region = Region(store, summaries, world, s)
    edited = edited_since(store, 0 if whole else world.edits)
    culled = cull(region, moved, edited)
    if whole:
        dirty = DirtySet(frozenset(region.rows), culled.settled, before, frozenset(), whole=True)
    else:
        dirty = DirtySet(culled.settled, culled.settled, before, edited, whole=False)
    report = _derive(region, dirty, ledger, last, ended=ended)
    followed = follow(region, moved, culled, report.written or ())
    report = report if report.written is None else replace(report, written=report.written | followed)
    if not whole and known is not None and world.light != known.light:
        _describe_anew(region)
    if ended and not dirty.whole and carried is None:
        put_exactly(store, {k: region.pose(k) for k in region.settled}, report.written or ())
    store.facts[WORLD] = replace(world, edits=last_edit(store))
    store.library.touched = set()
    return report


def _carry(store: Store, summaries: Summaries, s: ConsolidationSettings) -> Carried | None:
    """Carry what was derived to where its chunks lie now, where several have moved and most of them as their neighbours
    did; return what was carried.
    """
    chunks, known = store.chunks.all(), store.facts[WORLD]
    rows = store.library.settled.all()
    if known is None or len(rows) <= s.whole_chunks or not obeys(known, store, chunks, s):
        return None
    T_world_graph = store.facts.S_world_graph
    if abs(float(known.T_world_graph.scale / T_world_graph.scale) - 1.0) > s.hysteresis.scale:
        return None
    upright = known.first if known.upright else None
    metre = known.unit / float(T_world_graph.scale)
    settings = CarrySettings(s.hysteresis, s.gravity.hysteresis_deg, metre, upright)
    found = carry(store, known.T_world_graph, settings)
    if found is None or len(found.dirty) > max(2, s.whole_share * len(rows)):
        return None
    store.library.settled.carry({k: row for k, row in found.rows.items() if k not in found.dirty})
    store.library.settled.put(
        {
            k: SettledRow(row.component, row.S_graph_chunk, extent_of(summaries[k], row.S_graph_chunk))
            for k, row in found.rows.items()
            if k in found.dirty
        }
    )
    store.library.overlaps.drop(found.apart)
    store.library.overlaps.put(dict.fromkeys(found.together, b""))
    carry_instances(store, found.moves, upright)
    store.facts[WORLD] = replace(known, T_world_graph=T_world_graph)
    return found


def _standing_world(store: Store, summaries: Summaries, s: ConsolidationSettings, *, ended: bool) -> World | None:
    """Return what the instances were derived with, where that still holds; None for a short memory."""
    chunks = store.chunks.all()
    world = known_world(store, chunks, s) if len(chunks) > s.whole_chunks else None
    if world is None or len(chunks) < 2 * world.chunks or not (ended or len(chunks) <= _LOOKED_AT):
        return world
    now = look_at_world(store, chunks, summaries, s)
    if replace(world, light=now.light).near(now) and store.library.looks.count() == sum(store.instances.count()):
        return replace(world, chunks=now.chunks, light=world.light if world.near(now) else now.light)
    return None


def _replaced(store: Store, settled: Collection[int]) -> set[int] | None:
    """Return chunks that were placed since the last derivation; None where that is not known."""
    if store.library.touched is None:
        return None
    return store.library.touched | {c.chunk_id for c in store.chunks.all()[-1:] if c.chunk_id not in settled}


def _most_moved(store: Store, moved: Collection[int], known: int, world: World, s: ConsolidationSettings) -> bool:
    """Return whether so many chunks have moved that all are derived anew, or one has another feature space."""
    other_space = world.space and any(store.chunks.feature_space(k) != world.space for k in moved)
    return bool(other_space) or len(moved) > max(2, s.whole_share * known)


def _derive(
    region: Region, dirty: DirtySet, ledger: ChangeLedger | None, chunk_id: int, *, ended: bool
) -> ConsolidationReport:
    """Derive what follows from the dirty chunks and the edits; without a ledger, or when a session has `ended`, also
    what has changed between sessions.
    """
    store, ids, touched = region.store, Identities((), (), (), (), 0), dict[int, Array]()
    if dirty.chunks or dirty.edited or ended:
        left = region.measure_overlaps(dirty)
        grouping = Grouping(region, dirty, ledger or ChangeLedger(0))
        weighing = Weighing(grouping)
        sessions = SessionChanges(grouping, weighing)
        groups, decisions = sessions.find() if ended or ledger is None else sessions.stand()
        grouping.adopt(groups)
        now = grouping.ledger
        changed = [g for g in groups if grouping.has_changed(g) or _told_otherwise(g, ledger or now, now)]
        weighed = weighing.weigh(changed, left)
        recut = weighing.contest(changed)
        named = weighing.name(weighed)
        writer = Writer(grouping, weighing, sessions)
        touched = writer.write(named, weighed, recut)
        states, came_or_went = sessions.write(groups)
        writer.set_states(states)
        touched |= came_or_went
        if now != ledger or dirty.whole:
            write_ledger(store, now)
        writer.relate(touched)
        log_decisions(store, chunk_id, decisions, named.before, named.ids)
        ids = named.ids
    instances, structure = store.instances.count()
    written = None if dirty.whole else frozenset(touched)
    return ConsolidationReport(
        instances, structure, ids.new, ids.aliases, store.library.members.hidden_groups(), written
    )


def _told_otherwise(group: Group, before: ChangeLedger, now: ChangeLedger) -> bool:
    """Return whether an instance has moved, or come to have events, or the other way round."""
    return before.current(group) != now.current(group) or before.shows(group) != now.shows(group)


def _describe_anew(region: Region) -> None:
    """Write the words for instances in the light of the world as it is now, where they are others."""
    store, metric = region.store, region.store.facts.scale_kind != "relative"
    for known in store.library.looks.all():
        instances = store.instances.of(sorted(known))
        told = (in_light(i, known[i.id], region.world, metric=metric) for i in instances)
        store.instances.put(i for i in told if i is not None)
