"""Local instances of all chunks to the global library (paper 3.3): merge, keep ids, derive, relate, log.

A chunk that comes in changes what it touches (`memory.growth`). What holds for the whole memory (the light, the unit,
which way is up, the word of operators, several sessions) makes all of it be derived here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.change.detection import Changes, across_sessions, as_events, find_changes
from list3r.memory.change.free_space import SeenThrough
from list3r.memory.change.ledger import Tale, read_tale, write_tale
from list3r.memory.constraints import Constraints
from list3r.memory.geometry import Sim3
from list3r.memory.library.derivation import Thing, with_agreement
from list3r.memory.library.evidence import Evidence, contested, weigh, without_missed
from list3r.memory.library.growth import grow
from list3r.memory.library.identities import Identities, assign_ids
from list3r.memory.library.instances import eye_level, thing_of
from list3r.memory.library.rows import log_decisions, moved, pack_scores, record_of, unpack_scores
from list3r.memory.library.rules import (
    ConsolidationReport,
    ConsolidationSettings,
    World,
    known_world,
    look_at_world,
    settings_of,
)
from list3r.memory.library.settling import Settled, neighbours, settle
from list3r.memory.library.uncertainty import position_sigma
from list3r.memory.merging.edges import merge_nodes
from list3r.memory.merging.moving import Mover, Tracks, join_movers, without_moving
from list3r.memory.merging.settings import MergeSettings
from list3r.memory.overlap.pair_scores import Key, PairScores, pair_scores
from list3r.memory.overlap.summaries import ChunkSummary, SomeSummaries, Summaries, chunk_summaries
from list3r.memory.records import ChunkRow, MergeDecision, MotionTrack, Observation, Relation
from list3r.memory.relations.predicates import relations
from list3r.memory.relations.scene import Measured
from list3r.memory.relations.structure import classify_structure, flagged_only
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import Anchor

__all__ = ["ConsolidationReport", "ConsolidationSettings", "consolidate"]


def consolidate(
    store: Store, chunk_id: int | None = None, settings: ConsolidationSettings | None = None
) -> ConsolidationReport:
    """Derive the library from the chunks as they are placed now; call inside a transaction.

    `chunk_id` is the chunk that has just come in and names the entries of the merge log; None stands for the last
    one. The result depends on what the store holds alone, so a build that goes on after a crash comes to the same
    library: the partition on the local instances and on where the chunks lie, the ids on the observations before.
    """
    s = settings_of(store, settings)
    chunks = store.chunks()
    if not chunks:
        return ConsolidationReport(0, 0, (), (), 0)
    last = chunk_id if chunk_id is not None else chunks[-1].chunk_id
    summaries = chunk_summaries(store)
    world = known_world(store, chunks, s)
    tale = read_tale(store, chunks)
    report = None
    if world is not None and tale is not None and len(chunks) > s.whole_chunks:
        again = len(chunks) <= _LOOKED_AT or chunk_id is None
        if again and len(chunks) >= 2 * world.chunks:
            now = look_at_world(store, chunks, summaries, s)
            world = replace(world, chunks=now.chunks) if world.near(now) else None
        if world is not None:
            report = grow(store, summaries, world, last, s, tale, exact=chunk_id is None)
    if report is None:
        report = _derive_whole(store, summaries, last, s, None if chunk_id is None else tale)
    store.touched = set()
    return report


_LOOKED_AT = 64
"""Chunks up to which it is looked again, each time they have doubled, what holds for the whole memory; later that is
done when a session ends, for what changes it makes all things be derived anew."""


def _derive_whole(
    store: Store, summaries: Summaries, chunk_id: int, s: ConsolidationSettings, tale: Tale | None
) -> ConsolidationReport:
    """All of it. What has changed between sessions stands as `tale` says, or is told anew."""
    settled = settle(store, summaries, s.settling)
    chunks = settled.chunks
    world = look_at_world(store, chunks, summaries, s)
    held = dict(summaries.items())
    motions = {(k, n): track for k, v in held.items() for n, track in v.motions.items()}
    shapes = {k: v.shapes for k, v in held.items()}
    pairs = without_moving(_known_pairs(store, settled, held), shapes, motions)
    seen = SeenThrough(store, s.changes.visibility)
    pairs = across_sessions(pairs, shapes, settled.S_graph_chunk, seen, s.changes)
    word = store.constraints()
    groups, decisions = _partition(chunks, held, pairs, s.merging, word)
    groups, movers, joined = _with_movers(store, groups, chunks, held, motions, word, s)
    groups, movers = word.joined(groups, {c.chunk_id: c.component for c in chunks}, movers)
    evidence = weigh(groups, shapes, pairs, s.evidence)
    shown = word.shown(groups, [e.shown(s.evidence, world.posed) for e in evidence])
    story, groups, tale = _story(store, groups, shown, frozenset(movers), chunks, held, s, world, tale)
    decisions += joined + (story.decisions if story is not None else [])
    if tale.moved:
        evidence = weigh(groups, shapes, pairs, s.evidence)
    before = word.remembered(groups, {(o.chunk_id, o.local_id): o.instance_id for o in store.observations()})
    weights = {key: len(shapes[key[0]].frames[_at(held, key)]) for group in groups for key in group}
    counts = [e.shown(s.evidence, world.posed) or tale.shows(g) for e, g in zip(evidence, groups, strict=True)]
    shown = word.shown(groups, counts)
    within = [next((w for w in e.within if shown[w]), None) for e in evidence]
    before = without_missed(before, groups, evidence, shown)
    ids = assign_ids(groups, before, weights, shown, within, store.next_id())
    things = _things(store, groups, ids, evidence, chunks, held, s, movers, tale, world)
    things = _with_structure(store, things, chunks, groups, ids, s, world)
    states = _states(store, groups, ids, chunks, tale, story)
    labels = {ids.of_group[n]: text for n, text in word.labels_of(groups, weights).items()}
    _write(store, things, groups, ids, settled, labels, states, world)
    store.put_groups(zip(groups, shown, strict=True))
    store.set_value("library", world.as_dict())
    write_tale(store, tale)
    if story is not None:
        store.replace_events(as_events(story, {g[0]: n for g, n in zip(groups, ids.of_group, strict=True)}))
    here = [t for t in things if states.get(t.body.id) != "removed"]
    store.replace_relations(None, _relations(store, here, s, world))
    log_decisions(store, chunk_id, decisions, before, ids)
    return ConsolidationReport(
        instances=sum(t.body.structure is None for t in things),
        structure=sum(t.body.structure is not None for t in things),
        new=ids.new,
        merged=ids.aliases,
        hidden=sum(n is None for n in ids.of_group),
    )


def _story(
    store: Store,
    groups: list[list[Key]],
    shown: Sequence[bool],
    movers: frozenset[Key],
    chunks: Sequence[ChunkRow],
    held: Mapping[int, ChunkSummary],
    s: ConsolidationSettings,
    world: World,
    tale: Tale | None,
) -> tuple[Changes | None, list[list[Key]], Tale]:
    """What has changed between sessions, unless that stands as it was told; the groups, those that moved joined."""
    if tale is not None:
        return None, *tale.joined(groups, {c.chunk_id: c.component for c in chunks})
    found = find_changes(store, groups, shown, movers, chunks, SomeSummaries(held, held, world.unit), s.changes)
    return found, found.groups, Tale.of(found, groups, max(c.session_id for c in chunks))


# ---------------------------------------------------------------------------------------------- merging


def _partition(
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    pairs: Mapping[tuple[int, int], PairScores],
    settings: MergeSettings,
    word: Constraints,
) -> tuple[list[list[Key]], list[MergeDecision]]:
    """Groups and decisions of all components, each merged on its own."""
    groups: list[list[Key]] = []
    decisions: list[MergeDecision] = []
    for component in sorted({c.component for c in chunks}):
        inside = [c for c in chunks if c.component == component]
        placed = {c.chunk_id: c.S_world_chunk for c in inside}
        links = [
            ((c.chunk_id, int(a)), (c.chunk_id, int(b))) for c in inside for a, b in summaries[c.chunk_id].cannot_link
        ]
        found = merge_nodes([summaries[c.chunk_id].shapes for c in inside], placed, links, settings, pairs, word)
        groups += found[0]
        decisions += found[1]
    return sorted(groups), decisions


def _with_movers(
    store: Store,
    groups: list[list[Key]],
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    motions: Mapping[Key, MotionTrack | None],
    word: Constraints,
    s: ConsolidationSettings,
) -> tuple[list[list[Key]], dict[Key, Mover], list[MergeDecision]]:
    """The groups with those that move joined over time, and what is known of them by their first member."""
    if not motions:
        return groups, {}, []
    times = {(f.session_id, f.frame_index): f.time_s for f in store.frames()}
    return join_movers(
        groups,
        {k: v.shapes for k, v in summaries.items()},
        {c.chunk_id: c.S_world_chunk for c in chunks},
        {c.chunk_id: c.component for c in chunks},
        [((k, int(a)), (k, int(b))) for k, v in summaries.items() for a, b in v.cannot_link]
        + word.pairs_apart(motions),
        Tracks(motions, times),
        s.moving,
    )


def _known_pairs(
    store: Store, settled: Settled, summaries: Mapping[int, ChunkSummary]
) -> dict[tuple[int, int], PairScores]:
    """Scores of all pairs of chunks of one component that lie near each other; what stays is not compared again."""
    stored = store.overlaps()
    rows = store.settled()
    out, fresh = {}, {}
    for u in rows:
        for v in (v for v in neighbours(rows, u) if v >= u):
            if (u, v) in stored and u not in settled.moved and v not in settled.moved:
                out[u, v] = unpack_scores(stored[u, v])
                continue
            S_u_v = settled.S_graph_chunk[u].inverse() @ settled.S_graph_chunk[v] if u != v else Sim3.identity()
            out[u, v] = pair_scores(summaries[u].shapes, summaries[v].shapes, S_u_v)
            fresh[u, v] = pack_scores(out[u, v])
    store.drop_overlaps(stored.keys() - out.keys())
    store.put_overlaps(fresh)
    return out


def _at(summaries: Mapping[int, ChunkSummary], key: Key) -> int:
    return int(np.searchsorted(summaries[key[0]].shapes.local_id, key[1]))


# ---------------------------------------------------------------------------------------------- deriving


def _things(
    store: Store,
    groups: Sequence[Sequence[Key]],
    ids: Identities,
    evidence: Sequence[Evidence],
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    s: ConsolidationSettings,
    movers: Mapping[Key, Mover],
    tale: Tale,
    world: World,
) -> list[Thing]:
    rows = {c.chunk_id: c for c in chunks}
    placed = {c.chunk_id: c.S_world_chunk for c in chunks}
    shapes = {k: v.shapes for k, v in summaries.items()}
    found = contested(groups, shapes, placed, world.unit, s.evidence)
    dropped = {k: bits for k, (_, bits) in found.items()}
    store.set_dropped(dropped)
    out = []
    for group, instance_id, seen in zip(groups, ids.of_group, evidence, strict=True):
        if instance_id is None:
            continue
        mover = movers.get(group[0])
        thing = thing_of(
            store,
            instance_id,
            group,
            group if mover is not None else tale.current(group),
            {k: (shapes[k], placed[k], dropped[k]) for k in {k for k, _ in group}},
            rows[group[0][0]].component,
            s,
            world,
            mover,
        )
        out.append(with_agreement(thing, seen.agreement))
    return sorted(out, key=lambda t: t.body.id)


def _states(
    store: Store,
    groups: Sequence[Sequence[Key]],
    ids: Identities,
    chunks: Sequence[ChunkRow],
    tale: Tale,
    story: Changes | None,
) -> dict[int | None, str]:
    """The state of each thing, by id: what the story says, or what stands."""
    rows, before = {c.chunk_id: c for c in chunks}, store.states()
    out: dict[int | None, str] = {}
    for group, n in zip(groups, ids.of_group, strict=True):
        if n is not None and story is not None:
            out[n] = story.states.get(group[0], "present")
        elif n is not None:
            out[n] = tale.state(before[n][0] if n in before else None, group, rows)
    return out


def _with_structure(
    store: Store,
    things: Sequence[Thing],
    chunks: Sequence[ChunkRow],
    groups: Sequence[Sequence[Key]],
    ids: Identities,
    s: ConsolidationSettings,
    world: World,
) -> list[Thing]:
    """The same things, told apart into structure and what stands in the room."""
    rows = {c.chunk_id: c for c in chunks}
    saw = {n: [rows[k] for k in sorted({k for k, _ in g})] for g, n in zip(groups, ids.of_group, strict=True)}
    kinds: dict[int, str | None] = {}
    for component in sorted({c.component for c in chunks}):
        bodies = [t.body for t in things if t.body.component == component and not t.dynamic]
        if world.upright and component == world.first:
            found = classify_structure(
                bodies, world.floor, lambda b: eye_level(store, saw[b.id]), world.unit, s.structure
            )
        else:
            found = flagged_only(bodies)
        kinds.update(zip((b.id for b in bodies), found, strict=True))
    return [replace(t, body=replace(t.body, structure=kinds.get(t.body.id))) for t in things]


def _relations(store: Store, things: Sequence[Thing], s: ConsolidationSettings, world: World) -> list[Relation]:
    out: list[Relation] = []
    measured = store.derived.of(Measured)
    measured.begin()
    for component in sorted({t.body.component for t in things}):
        bodies = [t.body for t in things if t.body.component == component and t.resting]
        vertical = world.upright and component == world.first
        out += relations(bodies, gravity_known=vertical, unit=world.unit, settings=s.relations, measured=measured)
    return out


# ---------------------------------------------------------------------------------------------- writing


def _write(
    store: Store,
    things: Sequence[Thing],
    groups: Sequence[Sequence[Key]],
    ids: Identities,
    settled: Settled,
    edited: Mapping[int | None, str | None],
    states: Mapping[int | None, str],
    world: World,
) -> None:
    times = {(f.session_id, f.frame_index): f.time_s for f in store.frames()}
    metric = store.get_value("scale_kind", "metric") != "relative"
    kept = {t.body.id for t in things}
    for old in [i.id for i in store.instances() if i.id not in kept]:
        store.drop_instance(old, dict(ids.aliases).get(old))
    labels: dict[int | None, str | None] = {i.id: i.label for i in store.instances()}
    labels.update(edited)
    rows = {c.chunk_id: c for c in store.chunks()}
    seen_in = {n: [rows[k] for k in sorted({k for k, _ in g})] for g, n in zip(groups, ids.of_group, strict=True)}
    records = [
        replace(
            moved(record_of(t, labels.get(t.body.id), times, world, metric=metric), settled.S_exact_settled[t.anchor]),
            state=states.get(t.body.id, "present"),
        )
        for t in things
    ]
    store.put_instances(replace(r, position_sigma_m=position_sigma(r.center, seen_in[r.id])) for r in records)
    store.put_anchors({t.body.id: Anchor(t.anchor, settled.S_exact_settled[t.anchor]) for t in things})
    store.clear_observations()
    store.set_observations(
        Observation(n, *key) for group, n in zip(groups, ids.of_group, strict=True) if n is not None for key in group
    )
    if world.space and things:
        features = np.array([t.feature for t in things], np.float32)
        store.put_embeddings(world.space, [t.body.id for t in things], features)
        store.set_value("feature_space", world.space)
    store.set_value("last_id", ids.last_id)
