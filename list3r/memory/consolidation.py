"""Local instances of all chunks to the global library (paper 3.3): merge, keep ids, derive, relate, log."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np

from list3r.memory.bodies import Body, aabb_gap
from list3r.memory.changes import ChangeSettings, across_sessions, as_events, find_changes
from list3r.memory.colors import Reference, color_words, main_color
from list3r.memory.constraints import Constraints
from list3r.memory.derive import DeriveSettings, Member, Thing, derive_mover, derive_thing, with_agreement
from list3r.memory.describe import describe
from list3r.memory.evidence import Evidence, EvidenceSettings, contested, weigh
from list3r.memory.geometry import Array, Sim3
from list3r.memory.gravity import floor_height
from list3r.memory.identities import Identities, assign_ids
from list3r.memory.merging import Key, MergeSettings, PairScores, merge_nodes, pair_scores
from list3r.memory.moving import Mover, MovingSettings, Tracks, join_movers, without_moving
from list3r.memory.planes import place_planes
from list3r.memory.records import ChunkRow, Instance, MergeDecision, MotionTrack, Observation, Relation
from list3r.memory.relation_scene import Measured, RelationSettings
from list3r.memory.relations import relations
from list3r.memory.settling import Settled, SettlingSettings, settle
from list3r.memory.store import Store
from list3r.memory.structure import StructureSettings, classify_structure, flagged_only
from list3r.memory.summaries import ChunkSummary, cameras_of, chunk_summaries, light_of, world_unit
from list3r.memory.uncertainty import position_sigma


@dataclass(frozen=True)
class ConsolidationSettings:
    """How the library is derived from the chunks."""

    merging: MergeSettings = field(default_factory=MergeSettings)
    moving: MovingSettings = field(default_factory=MovingSettings)
    derive: DeriveSettings = field(default_factory=DeriveSettings)
    structure: StructureSettings = field(default_factory=StructureSettings)
    relations: RelationSettings = field(default_factory=RelationSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    settling: SettlingSettings = field(default_factory=SettlingSettings)
    changes: ChangeSettings = field(default_factory=ChangeSettings)


@dataclass(frozen=True)
class ConsolidationReport:
    """What changed in the library."""

    instances: int
    """Things in the library now."""
    structure: int
    """Pieces of structure in it now."""
    new: tuple[int, ...]
    """Ids that appeared."""
    merged: tuple[tuple[int, int], ...]
    """(id that retired, id that it is an alias of)."""
    hidden: int
    """Groups of local instances that are not shown: seen too little, or fragments of a thing that is."""


def consolidate(
    store: Store, chunk_id: int | None = None, settings: ConsolidationSettings | None = None
) -> ConsolidationReport:
    """Derive the library from the chunks as they are placed now; call inside a transaction.

    `chunk_id` is the chunk that has just come in and names the entries of the merge log; None stands for the last
    one. The result depends on what the store holds alone, so a build that goes on after a crash comes to the same
    library: the partition on the local instances and on where the chunks lie, the ids on the observations before.
    """
    s = settings or ConsolidationSettings()
    summaries = chunk_summaries(store)
    if not summaries:
        return ConsolidationReport(0, 0, (), (), 0)
    settled = settle(store, summaries, s.settling)
    chunks = settled.chunks
    motions = {(k, n): track for k, v in summaries.items() for n, track in v.motions.items()}
    shapes = {k: v.shapes for k, v in summaries.items()}
    pairs = without_moving(_known_pairs(store, settled, summaries), shapes, motions)
    pairs = across_sessions(pairs, shapes, s.changes)
    word = store.constraints()
    groups, decisions = _partition(chunks, summaries, pairs, s.merging, word)
    groups, movers, joined = _with_movers(store, groups, chunks, summaries, motions, word, s)
    groups, movers = word.joined(groups, {c.chunk_id: c.component for c in chunks}, movers)
    posed = store.posed_count()
    evidence = weigh(groups, shapes, pairs, s.evidence)
    shown = word.shown(groups, [e.shown(s.evidence, posed) for e in evidence])
    changes = find_changes(store, groups, shown, frozenset(movers), chunks, summaries, s.changes)
    if changes.current:
        groups, evidence = changes.groups, weigh(changes.groups, shapes, pairs, s.evidence)
    decisions += joined + changes.decisions
    before = word.remembered(groups, {(o.chunk_id, o.local_id): o.instance_id for o in store.observations()})
    weights = {key: len(summaries[key[0]].shapes.frames[_at(summaries, key)]) for group in groups for key in group}
    told = {c.first for c in changes.events}
    shown = word.shown(
        groups, [e.shown(s.evidence, posed) or g[0] in told for e, g in zip(evidence, groups, strict=True)]
    )
    within = [next((w for w in e.within if shown[w]), None) for e in evidence]
    ids = assign_ids(groups, before, weights, shown, within, store.next_id())
    things = _things(store, groups, ids, evidence, chunks, summaries, s, movers, changes.current)
    things = _with_structure(store, things, chunks, summaries, s)
    states = {n: changes.states[g[0]] for g, n in zip(groups, ids.of_group, strict=True) if g[0] in changes.states}
    labels = {ids.of_group[n]: text for n, text in word.labels_of(groups, weights).items()}
    _write(store, things, groups, ids, summaries, settled, labels, states)
    store.replace_events(as_events(changes, {g[0]: n for g, n in zip(groups, ids.of_group, strict=True)}))
    here = [t for t in things if states.get(t.body.id) != "removed"]
    store.replace_relations(None, _relations(store, here, chunks, summaries, s))
    _log(store, chunk_id if chunk_id is not None else chunks[-1].chunk_id, decisions, before, ids)
    return ConsolidationReport(
        instances=sum(t.body.structure is None for t in things),
        structure=sum(t.body.structure is not None for t in things),
        new=ids.new,
        merged=ids.aliases,
        hidden=sum(n is None for n in ids.of_group),
    )


# ---------------------------------------------------------------------------------------------- merging


_scored: WeakKeyDictionary[Store, dict[tuple[int, int], tuple[bytes, PairScores]]] = WeakKeyDictionary()
_FAR_M = 0.5
"""Chunks whose points lie further apart than this share no thing."""


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
    known = _scored.setdefault(store, {})
    checks = {k: crc.to_bytes(4, "big") for k, crc in store.node_checksums().items()}
    chunks = settled.chunks
    slack = 0.5 * _FAR_M * world_unit(chunks, summaries)
    extent = {c.chunk_id: _extent(summaries[c.chunk_id], c.S_world_chunk, slack) for c in chunks}
    pose = {k: S.as_matrix().tobytes() for k, S in settled.S_graph_chunk.items()}
    out = {}
    for n, u in enumerate(chunks):
        for v in chunks[n:]:
            a, b = u.chunk_id, v.chunk_id
            if u.component != v.component or aabb_gap(extent[a], extent[b]) > 0.0:
                continue
            stamp = checks[a] + checks[b] + (b"" if a == b else pose[a] + pose[b])
            if (a, b) not in known or known[a, b][0] != stamp:
                S_a_b = settled.S_graph_chunk[a].inverse() @ settled.S_graph_chunk[b] if a != b else Sim3.identity()
                known[a, b] = (stamp, pair_scores(summaries[a].shapes, summaries[b].shapes, S_a_b))
            out[a, b] = known[a, b][1]
    return out


def _extent(summary: ChunkSummary, S_world_chunk: Sim3, slack: float) -> Array:
    """Axis-aligned box of a chunk's points in the world, grown. Shape (2, 3)."""
    if len(summary.shapes.points) == 0:
        return np.array([[np.inf] * 3, [-np.inf] * 3])
    p = S_world_chunk.apply(summary.shapes.points)
    return np.stack([p.min(axis=0) - slack, p.max(axis=0) + slack])


def _at(summaries: Mapping[int, ChunkSummary], key: Key) -> int:
    return int(np.searchsorted(summaries[key[0]].shapes.local_id, key[1]))


# ---------------------------------------------------------------------------------------------- deriving


_derived: WeakKeyDictionary[Store, dict[tuple[object, ...], Thing]] = WeakKeyDictionary()
_measured: WeakKeyDictionary[Store, dict[tuple[object, ...], object]] = WeakKeyDictionary()
_stamps = itertools.count(1)


def _things(
    store: Store,
    groups: Sequence[Sequence[Key]],
    ids: Identities,
    evidence: Sequence[Evidence],
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    s: ConsolidationSettings,
    movers: Mapping[Key, Mover],
    current: Mapping[Key, Sequence[Key]],
) -> list[Thing]:
    rows = {c.chunk_id: c for c in chunks}
    placed = {c.chunk_id: c.S_world_chunk for c in chunks}
    checks = store.node_checksums()
    upright = _gravity_known(store)
    first = min(c.component for c in chunks)
    shapes = {k: v.shapes for k, v in summaries.items()}
    dropped = contested(groups, shapes, placed, world_unit(chunks, summaries), s.evidence)
    before: dict[tuple[object, ...], Thing] = _derived.get(store, {})
    known: dict[tuple[object, ...], Thing] = {}
    out = []
    for group, instance_id, seen in zip(groups, ids.of_group, evidence, strict=True):
        if instance_id is None:
            continue
        component = rows[group[0][0]].component
        up = upright and component == first
        shown_by = current.get(group[0], group)
        members = [Member(shapes[k], _at(summaries, (k, n)), placed[k], dropped[k]) for k, n in shown_by]
        poses = tuple((checks[k], placed[k].as_matrix().tobytes()) for k in sorted({k for k, _ in group}))
        cuts = b"".join(np.packbits(m.dropped[slice(*m.span)]).tobytes() for m in members)
        mover = movers.get(group[0])
        key: tuple[object, ...] = (instance_id, component, up, tuple(group), tuple(shown_by), poses, cuts, mover)
        if key not in before:
            if mover is None:
                thing = derive_thing(instance_id, members, component, upright=up, settings=s.derive)
            else:
                last = [m for m, k in zip(members, group, strict=True) if k in mover.last]
                thing = derive_mover(
                    instance_id, members, last, component, resting=mover.resting, upright=up, settings=s.derive
                )
            known[key] = replace(thing, body=replace(thing.body, stamp=next(_stamps)))
        else:
            known[key] = before[key]
        out.append(with_agreement(known[key], seen.agreement))
    _derived[store] = known
    return sorted(out, key=lambda t: t.body.id)


def _with_structure(
    store: Store,
    things: Sequence[Thing],
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    s: ConsolidationSettings,
) -> list[Thing]:
    """The same things, told apart into structure and what stands in the room."""
    kinds: dict[int, str | None] = {}
    for component in sorted({c.component for c in chunks}):
        inside = [c for c in chunks if c.component == component]
        bodies = [t.body for t in things if t.body.component == component and not t.dynamic]
        if _gravity_known(store) and component == min(c.component for c in chunks):
            unit = world_unit(inside, summaries)
            cameras = cameras_of(store, inside).translation
            planes = place_planes([(summaries[c.chunk_id].planes, c.S_world_chunk) for c in inside])
            floor = floor_height(np.array([0.0, 0.0, 1.0]), planes, cameras, unit)
            found = classify_structure(bodies, floor, cameras, unit, s.structure)
        else:
            found = flagged_only(bodies)
        kinds.update(zip((b.id for b in bodies), found, strict=True))
    return [replace(t, body=replace(t.body, structure=kinds.get(t.body.id))) for t in things]


def _relations(
    store: Store,
    things: Sequence[Thing],
    chunks: Sequence[ChunkRow],
    summaries: Mapping[int, ChunkSummary],
    s: ConsolidationSettings,
) -> list[Relation]:
    first = min(c.component for c in chunks)
    unit = world_unit(chunks, summaries)
    out: list[Relation] = []
    cache = Measured(_measured.get(store, {}))
    for component in sorted({c.component for c in chunks}):
        bodies = [t.body for t in things if t.body.component == component and t.resting]
        vertical = _gravity_known(store) and component == first
        out += relations(bodies, gravity_known=vertical, unit=unit, settings=s.relations, measured=cache)
    _measured[store] = cache.used
    return out


def _gravity_known(store: Store) -> bool:
    return bool(store.get_value("gravity", "unknown") != "unknown")


# ---------------------------------------------------------------------------------------------- writing


def _write(
    store: Store,
    things: Sequence[Thing],
    groups: Sequence[Sequence[Key]],
    ids: Identities,
    summaries: Mapping[int, ChunkSummary],
    settled: Settled,
    edited: Mapping[int | None, str | None],
    states: Mapping[int | None, str],
) -> None:
    times = {(f.session_id, f.frame_index): f.time_s for f in store.frames()}
    metric = store.get_value("scale_kind", "metric") != "relative"
    unit = world_unit(store.chunks(), summaries)
    kept = {t.body.id for t in things}
    for old in [i.id for i in store.instances() if i.id not in kept]:
        store.drop_instance(old, dict(ids.aliases).get(old))
    labels: dict[int | None, str | None] = {i.id: i.label for i in store.instances()}
    labels.update(edited)
    light = light_of(summaries)
    rows = {c.chunk_id: c for c in store.chunks()}
    seen_in = {n: [rows[k] for k in sorted({k for k, _ in g})] for g, n in zip(groups, ids.of_group, strict=True)}
    records = [
        replace(
            _moved(
                _record(t, labels.get(t.body.id), times, unit, light, metric=metric), settled.S_exact_settled[t.anchor]
            ),
            state=states.get(t.body.id, "present"),
        )
        for t in things
    ]
    store.put_instances(replace(r, position_sigma_m=position_sigma(r.center, seen_in[r.id])) for r in records)
    store.clear_observations()
    store.set_observations(
        Observation(n, *key) for group, n in zip(groups, ids.of_group, strict=True) if n is not None for key in group
    )
    spaces = {store.feature_space(k) for k in summaries}
    if len(spaces) == 1 and things:
        space = spaces.pop()
        store.put_embeddings(space, [t.body.id for t in things], np.array([t.feature for t in things], np.float32))
        store.set_value("feature_space", space)
    store.set_value("last_id", ids.last_id)


def _record(
    thing: Thing,
    label: str | None,
    times: Mapping[tuple[int, int], float],
    unit: float,
    light: Reference,
    *,
    metric: bool,
) -> Instance:
    body: Body = thing.body
    seen = [times[f] for f in thing.frames if f in times] or [0.0]
    name, rgb = main_color(thing.swatches, light)
    color = color_words(thing.swatches, light)
    words = describe(thing.shape, color, body.box.size, unit, metric=metric, structure=body.structure)
    words = words if thing.resting else f"moving {words}"
    return Instance(
        id=body.id,
        label=label,
        description=words,
        center=body.box.center,
        aabb=body.aabb,
        box=body.box,
        confidence=body.confidence,
        observations=len(thing.frames),
        first_seen_s=min(seen),
        last_seen_s=max(seen),
        state="present",
        structure=body.structure,
        color_rgb=rgb,
        color_name=name,
        component=body.component,
        best_view=thing.best_view,
        dynamic=thing.dynamic,
    )


def _moved(instance: Instance, S_exact_settled: Sim3) -> Instance:
    """The instance where its chunk lies to the last digit, not where it was settled."""
    by = S_exact_settled.apply(instance.center[None])[0] - instance.center
    box = replace(instance.box, center=instance.box.center + by)
    return replace(instance, center=instance.center + by, aabb=instance.aabb + by, box=box)


def _log(
    store: Store, chunk_id: int, decisions: Sequence[MergeDecision], before: Mapping[Key, int], ids: Identities
) -> None:
    """Append what is new: unions that did not hold before, refusals never written, ids that retired or split."""
    written = {(d.kind, d.a, d.b) for d in store.decisions()}
    fresh = []
    for d in decisions:
        a, b = _key(d.a), _key(d.b)
        held = d.kind == "merge" and a in before and before[a] == before.get(b)
        if not held and (d.kind, d.a, d.b) not in written:
            fresh.append(d)
    for old, new in ids.aliases:
        reason = f"#{old} and #{new} are one thing; the older id stays"
        fresh.append(MergeDecision("alias", f"#{old}", f"#{new}", {}, reason))
    for old, new in ids.splits:
        reason = f"what was #{old} is more than one thing; the larger part keeps the id"
        fresh.append(MergeDecision("split", f"#{old}", f"#{new}", {}, reason))
    store.log_decisions(chunk_id, fresh)


def _key(name: str) -> Key:
    chunk, local = name.split(":")
    return int(chunk), int(local)
