"""A library that grows: one more chunk, or some that moved, and what they touch; all else keeps its rows.

The result is that of deriving the whole library anew, which `tests/test_growth.py` asks for. Why what lies further
away need not be looked at:

- Groups. Edges are joined best first, and whether two groups join depends on their members alone. So the groups of a
  set of local instances can be formed without the others, as long as no edge leaves the set from a group that came out
  other than before; where one does, the group at its other end is taken in and the set is formed again.
- Evidence. A group is weighed by the pairs of its own chunks.
- Points that belong to something else are told by the cells in which local instances lie that are new, moved or
  grouped otherwise.
- Structure and relations are told by what lies within a few metres, which the R*Tree finds; no thing is longer than
  `MergeSettings.most_span_m`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from list3r.memory.bodies import Body
from list3r.memory.derive import Thing, with_agreement
from list3r.memory.evidence import Evidence, claim_cells, contested, weigh
from list3r.memory.geometry import Array, Sim3
from list3r.memory.identities import Identities, assign_ids
from list3r.memory.library_rows import log_decisions, moved, pack_scores, record_of, unpack_scores
from list3r.memory.library_rules import ConsolidationReport, ConsolidationSettings, World
from list3r.memory.library_things import eye_level, measured_before, thing_of
from list3r.memory.library_verbs import Anchor, SettledRow
from list3r.memory.merging import Edge, Key, Nodes, PairScores, form_groups, local_edges, pair_scores
from list3r.memory.moving import Mover, Tracks, join_movers, tied_movers, without_moving
from list3r.memory.records import MergeDecision, MotionTrack, Observation
from list3r.memory.relation_scene import Measured
from list3r.memory.relations import relations
from list3r.memory.settling import neighbours, settle
from list3r.memory.shapes import ChunkShapes, Ints
from list3r.memory.store import Store
from list3r.memory.structure import classify_structure, flagged_only
from list3r.memory.summaries import Summaries
from list3r.memory.uncertainty import position_sigma

Group = tuple[Key, ...]


def grow(
    store: Store, summaries: Summaries, world: World, chunk_id: int, s: ConsolidationSettings, *, exact: bool
) -> ConsolidationReport | None:
    """Bring the library up to date with the chunks that are new or have moved; None where that would be most of them.

    For memories of one session. `exact` also puts the things of chunks that trembled where they
    lie to the last digit.
    """
    known = store.settled()
    asked = store.touched if store.touched is not None else {c.chunk_id for c in store.chunks()}
    before = {k: known[k] for k in asked if k in known}
    asked = asked | {c.chunk_id for c in store.chunks()[-1:] if c.chunk_id not in known}
    settled = settle(store, summaries, s.settling, asked)
    if len(settled.moved) > max(2, s.whole_share * len(known)):
        return None
    if world.space and any(store.feature_space(k) != world.space for k in settled.moved):
        return None
    growth = _Growth(store, summaries, world, s, settled.moved, before)
    report = growth.run(chunk_id)
    _put_exactly(store, settled.S_exact_settled, growth.written, everywhere=exact)
    store.set_value("library", world.as_dict())
    return report


def _put_exactly(store: Store, S_exact_settled: dict[int, Sim3], written: Collection[int], *, everywhere: bool) -> None:
    """Move the boxes of things whose chunks trembled, by less than makes them be derived anew."""
    if not everywhere:
        return
    fresh: dict[int, Anchor] = {}
    records = []
    for n, anchor in store.anchors().items():
        now = S_exact_settled.get(anchor.chunk_id)
        if now is None or n in written or np.array_equal(now.as_matrix(), anchor.S_exact_settled.as_matrix()):
            continue
        (instance,) = store.instances_of([n])
        there = moved(moved(instance, anchor.S_exact_settled.inverse()), now)
        seen_in = [store.chunk(k) for k in sorted({o.chunk_id for o in store.observations(n)})]
        records.append(replace(there, position_sigma_m=position_sigma(there.center, seen_in)))
        fresh[n] = Anchor(anchor.chunk_id, now)
    store.put_instances(records)
    store.put_anchors(fresh)


@dataclass
class _Weighed:
    """Groups whose evidence was weighed, and what came of it."""

    evidence: dict[Group, Evidence] = field(default_factory=dict)
    shown: dict[Group, bool] = field(default_factory=dict)


class _Growth:
    """One step of growing."""

    def __init__(
        self,
        store: Store,
        summaries: Summaries,
        world: World,
        s: ConsolidationSettings,
        dirty: Collection[int],
        before: dict[int, SettledRow],
    ) -> None:
        self._store, self._summaries, self._world, self._s = store, summaries, world, s
        self._dirty = sorted(dirty)
        self._before = before
        self._rows = store.settled()
        self._T_world_graph = Sim3.from_matrix(store.get_value("T_world_graph", np.eye(4).tolist()))
        self._placed: dict[int, Sim3] = {}
        self._word = store.constraints()
        self._pairs: dict[tuple[int, int], PairScores] = {}
        self._paired: set[int] = set()
        self._edges: dict[tuple[int, int], tuple[list[Edge], dict[tuple[Key, Key], float]]] = {}
        self._nodes: dict[int, Nodes] = {}
        self._within: dict[Group, list[Group]] = {}
        self._left: set[Key] = set()
        """Local instances that lay on, or under, one of a chunk that has moved."""
        self._old: dict[Key, Group] = {}
        self._old_shown: dict[Group, bool] = {}
        self._home: dict[Key, Group] = {}
        self._known: set[int] = set()
        self._dropped: dict[int, np.ndarray] = {}
        self._things: dict[int, Thing] = {}
        self._moving = store.has_moving()
        self._movers: dict[Group, Mover] = {}
        self._spans: dict[int, tuple[float, float]] = {}
        self.written: set[int] = set()
        """Instances that were written anew."""

    def run(self, chunk_id: int) -> ConsolidationReport:
        """All that follows from the chunks that are new or moved."""
        if not self._dirty:
            return self._report(Identities((), (), (), (), 0))
        self._compare()
        groups, decisions = self._partition()
        changed = [g for g in groups if self._has_changed(g)]
        for g in groups:
            self._home.update(dict.fromkeys(g, g))
        weighed = self._weigh(changed)
        contested_by = self._contest(changed)
        ids, listed, before = self._identify(weighed)
        self._store.put_groups((g, weighed.shown[g]) for g in weighed.evidence)
        touched = self._write(ids, listed, weighed, contested_by)
        self._relate(touched)
        log_decisions(self._store, chunk_id, decisions, before, ids)
        return self._report(ids)

    def _report(self, ids: Identities) -> ConsolidationReport:
        things, structure = self._store.instance_count()
        return ConsolidationReport(things, structure, ids.new, ids.aliases, self._store.hidden_groups())

    # ------------------------------------------------------------------ what is known of chunks

    def _shapes(self, chunk_id: int) -> ChunkShapes:
        return self._summaries[chunk_id].shapes

    def _pose(self, chunk_id: int) -> Sim3:
        """Settled, in the world."""
        if chunk_id not in self._placed:
            self._placed[chunk_id] = self._T_world_graph @ self._rows[chunk_id].S_graph_chunk
        return self._placed[chunk_id]

    def _compare(self) -> None:
        """Score the pairs of the chunks that are new or moved with those near them, and forget the others of theirs."""
        stored = self._store.overlaps(self._dirty)
        fresh: dict[tuple[int, int], bytes] = {}
        for k in self._dirty:
            for other in neighbours(self._rows, k):
                u, v = sorted((k, other))
                if (u, v) not in fresh:
                    S_u_v = self._rows[u].S_graph_chunk.inverse() @ self._rows[v].S_graph_chunk
                    S_u_v = S_u_v if u != v else Sim3.identity()
                    fresh[u, v] = pack_scores(pair_scores(self._shapes(u), self._shapes(v), S_u_v))
        self._store.drop_overlaps(stored.keys() - fresh.keys())
        self._store.put_overlaps(fresh)
        self._look_up({*self._dirty, *(k for pair in stored for k in pair)})
        for (u, v), blob in stored.items():
            p = unpack_scores(blob)
            most = np.maximum(p.i_on_j, p.j_on_i) >= self._s.evidence.swallowed
            self._left.update((u, int(self._shapes(u).local_id[i])) for i in p.i[most])
            self._left.update((v, int(self._shapes(v).local_id[j])) for j in p.j[most])

    def _pairs_of(self, chunks: Iterable[int]) -> dict[tuple[int, int], PairScores]:
        """Scores of all pairs of which one is among these chunks, in order."""
        wanted = set(chunks)
        missing = sorted(wanted - self._paired)
        for pair, blob in self._store.overlaps(missing).items() if missing else ():
            if pair not in self._pairs:
                shapes = {k: self._shapes(k) for k in pair}
                self._pairs |= without_moving({pair: unpack_scores(blob)}, shapes, self._motions(pair))
        self._paired |= wanted
        return {p: self._pairs[p] for p in sorted(self._pairs) if p[0] in wanted or p[1] in wanted}

    def _look_up(self, chunks: Iterable[int]) -> None:
        """Read how the local instances of chunks were grouped before; new ones stand alone."""
        missing = sorted(set(chunks) - self._known)
        if not missing:
            return
        self._known.update(missing)
        found = self._store.members_in(missing)
        for first, shown in sorted({v for v in found.values()}):
            group = tuple(self._store.group_of(first))
            if group and group[0] not in self._old:
                self._old.update(dict.fromkeys(group, group))
                self._old_shown[group] = shown
                for key in group:
                    self._home.setdefault(key, group)
        for k in missing:
            for n in self._shapes(k).local_id.tolist():
                self._home.setdefault((k, n), ((k, n),))

    # ------------------------------------------------------------------ things that move

    def _motions(self, chunks: Iterable[int]) -> dict[Key, MotionTrack | None]:
        """The local instances of chunks that move."""
        return {(k, n): track for k in chunks for n, track in self._summaries[k].motions.items()}

    def _tracks(self, chunks: Iterable[int]) -> Tracks:
        chunks = sorted(set(chunks))
        times = {f: t for k in chunks for f, t in self._store.frame_times(self._store.chunk(k)).items()}
        return Tracks(self._motions(chunks), times)

    def _at_that_time(self, chunks: Collection[int]) -> set[int]:
        """Chunks seen so shortly before or after one of these that what moves may be the same."""
        rows = sorted((c for c in self._store.chunks() if c.chunk_id in self._rows), key=lambda c: c.first_frame)
        at = {c.chunk_id: n for n, c in enumerate(rows)}
        out = set(chunks)
        for k in chunks:
            low, high = self._span_s(k)
            for way in (range(at[k] - 1, -1, -1), range(at[k] + 1, len(rows))):
                for n in way:
                    other = self._span_s(rows[n].chunk_id)
                    if max(other[0] - high, low - other[1]) > self._s.moving.most_gap_s:
                        break
                    out.add(rows[n].chunk_id)
        return {k for k in out if any(self._rows[k].component == self._rows[j].component for j in chunks)}

    def _span_s(self, chunk_id: int) -> tuple[float, float]:
        if chunk_id not in self._spans:
            times = list(self._store.frame_times(self._store.chunk(chunk_id)).values()) or [0.0]
            self._spans[chunk_id] = min(times), max(times)
        return self._spans[chunk_id]

    def _along(self, keys: Collection[Key], inside: Collection[Key]) -> set[Key]:
        """Local instances outside that one of these may be, because one of the two moves."""
        if not self._moving:
            return set()
        chunks = self._at_that_time({k for k, _ in keys})
        moving = self._motions(chunks)
        if not moving:
            return set()
        others = {(k, n) for k in chunks for n in self._shapes(k).local_id.tolist()} - set(inside)
        if moving.keys().isdisjoint(keys):
            others &= moving.keys()
        shapes, placed = {k: self._shapes(k) for k in chunks}, {k: self._pose(k) for k in chunks}
        return tied_movers(sorted(keys), sorted(others), shapes, placed, self._tracks(chunks), self._s.moving)

    def _mover(self, group: Group) -> Mover | None:
        """What is known of a group that moves."""
        if not self._moving or self._motions({k for k, _ in group}).keys().isdisjoint(group):
            return None
        if group not in self._movers:
            self._form(set(group))
        return self._movers.get(group)

    # ------------------------------------------------------------------ groups

    def _partition(self) -> tuple[list[Group], list[MergeDecision]]:
        """The groups of all local instances that the chunks touch, formed anew, and the decisions."""
        region = {(k, n) for k in self._dirty for n in self._shapes(k).local_id.tolist()}
        region |= {k for k in (*self._word.touched, *(k for d in self._word.deletions for k in d.keys))}
        region = self._closed(region)
        region = self._closed(region | self._across(region, region) | self._along(region, region))
        while True:
            groups, decisions = self._form(region)
            changed = {k for g in groups if self._has_changed(g) for k in g}
            left = self._closed(self._across(changed, region) | self._along(changed, region)) - region
            if not left:
                return groups, decisions
            region |= left

    def _closed(self, keys: Collection[Key]) -> set[Key]:
        """All local instances that were in one group with any of these."""
        self._look_up({k for k, _ in keys})
        return {m for key in keys for m in (*self._old.get(key, ()), key) if m[0] in self._rows}

    def _has_changed(self, group: Group) -> bool:
        return self._old.get(group[0]) != group or any(k in self._dirty for k, _ in group)

    def _across(self, keys: Collection[Key], inside: Collection[Key]) -> set[Key]:
        """Local instances outside that an edge ties to one of these."""
        chunks = {k for k, _ in keys}
        pairs = self._pairs_of(chunks)
        self._look_up({k for pair in pairs for k in pair})
        out = set()
        for edges, _ in (self._edges_of(p) for p in pairs):
            for e in edges:
                for here, there in ((e.a, e.b), (e.b, e.a)):
                    if here in keys and there not in inside:
                        out.add(there)
        return out

    def _edges_of(self, pair: tuple[int, int]) -> tuple[list[Edge], dict[tuple[Key, Key], float]]:
        if pair not in self._edges:
            u, v = (self._nodes_of(k) for k in pair)
            self._edges[pair] = local_edges(u, v, self._pairs[pair], self._s.merging)
        return self._edges[pair]

    def _nodes_of(self, chunk_id: int) -> Nodes:
        if chunk_id not in self._nodes:
            self._nodes[chunk_id] = Nodes.of([self._shapes(chunk_id)], {chunk_id: self._pose(chunk_id)})
        return self._nodes[chunk_id]

    def _form(self, region: Collection[Key]) -> tuple[list[Group], list[MergeDecision]]:
        chunks = sorted({k for k, _ in region})
        edges: list[Edge] = []
        overlap: dict[tuple[Key, Key], float] = {}
        for pair in self._pairs_of(chunks):
            if pair[0] in chunks and pair[1] in chunks:
                found = self._edges_of(pair)
                edges += [e for e in found[0] if e.a in region and e.b in region]
                overlap |= found[1]
        links = [((k, int(a)), (k, int(b))) for k in chunks for a, b in self._summaries[k].cannot_link]
        nodes = Nodes.join([self._nodes_of(k) for k in chunks]).only(region)
        found_groups, decisions = form_groups(nodes, edges, overlap, links, self._s.merging, self._word)
        components = {k: self._rows[k].component for k in chunks}
        movers: dict[Key, Mover] = {}
        motions = self._motions(chunks) if self._moving else {}
        if motions:
            shapes, placed = {k: self._shapes(k) for k in chunks}, {k: self._pose(k) for k in chunks}
            apart, tracks = links + self._word.pairs_apart(motions), self._tracks(chunks)
            found_groups, movers, joins = join_movers(
                found_groups, shapes, placed, components, apart, tracks, self._s.moving
            )
            decisions = decisions + joins
        joined, movers = self._word.joined(found_groups, components, movers)
        self._movers |= {tuple(g): movers[g[0]] for g in joined if g[0] in movers}
        return [tuple(g) for g in joined], decisions

    # ------------------------------------------------------------------ evidence and ids

    def _weigh(self, changed: Sequence[Group]) -> _Weighed:
        """Evidence for the groups that changed and for those that have one of them, or a chunk that is new or moved,
        against them; as long as one of them comes to be shown or not, also for those that lie within it.
        """
        out = _Weighed()
        wanted = {*changed, *self._against(changed), *(self._home[k] for k in self._left)}
        while True:
            fresh = sorted(wanted - out.evidence.keys())
            if not fresh:
                return out
            self._weigh_some(fresh, out)
            flipped = [g for g in fresh if self._old_shown.get(g) != out.shown[g]]
            wanted |= self._against(flipped)

    def _weigh_some(self, wanted: Sequence[Group], out: _Weighed) -> None:
        pairs = self._pairs_of({k for g in wanted for k, _ in g})
        scope = {k for pair in pairs for k in pair} | {k for g in wanted for k, _ in g}
        self._look_up(scope)
        nodes = [(k, n) for k in scope for n in self._shapes(k).local_id.tolist()]
        groups = sorted({self._home[key] for key in nodes})
        at = {g: n for n, g in enumerate(groups)}
        shapes = {k: self._shapes(k) for k in scope}
        found = weigh(groups, shapes, pairs, self._s.evidence, {at[g] for g in wanted})
        seen = [found[at[g]] for g in wanted]
        shown = self._word.shown(wanted, [e.shown(self._s.evidence, self._world.posed) for e in seen])
        for g, e, show in zip(wanted, seen, shown, strict=True):
            self._within[g] = [groups[w] for w in e.within]
            out.evidence[g] = e
            out.shown[g] = show

    def _against(self, groups: Collection[Group]) -> set[Group]:
        """Groups of which a member lies on a member of one of these."""
        keys = {k for g in groups for k in g}
        pairs = self._pairs_of({k for k, _ in keys})
        self._look_up({k for pair in pairs for k in pair})
        out: set[Group] = set()
        for (u, v), p in pairs.items():
            a, b = self._shapes(u).local_id, self._shapes(v).local_id
            most = np.maximum(p.i_on_j, p.j_on_i)
            for e in np.flatnonzero(most >= self._s.evidence.swallowed):
                i, j = (u, int(a[p.i[e]])), (v, int(b[p.j[e]]))
                if i in keys or j in keys:
                    out |= {self._home[i], self._home[j]}
        return out

    def _identify(self, weighed: _Weighed) -> tuple[Identities, list[Group], dict[Key, int]]:
        """Ids of the groups that were weighed, and of those that they lie within; what they were before."""
        shown = {**self._old_shown, **weighed.shown}
        inner = {g: next((w for w in self._within[g] if shown.get(w, False)), None) for g in weighed.evidence}
        listed = sorted({*weighed.evidence, *(w for w in inner.values() if w is not None)})
        at = {g: n for n, g in enumerate(listed)}
        keys = [k for g in listed for k in g]
        before = self._word.remembered(listed, self._store.observed_as(keys))
        weights = {(k, n): len(self._frames_of((k, n))) for k, n in keys}
        within = [at.get(inner[g]) if inner.get(g) is not None else None for g in listed]  # type: ignore[arg-type]
        ids = assign_ids(listed, before, weights, [shown.get(g, False) for g in listed], within, self._store.next_id())
        return ids, listed, before

    def _frames_of(self, key: Key) -> Ints:
        shapes = self._shapes(key[0])
        return shapes.frames[int(np.searchsorted(shapes.local_id, key[1]))]

    # ------------------------------------------------------------------ points that belong to something else

    def _contest(self, changed: Sequence[Group]) -> set[Group]:
        """Look again at the cells of what is new, moved or grouped otherwise; the groups that lost or won points."""
        cells = [self._cells_of(keys) for keys in self._regrouped(changed).items()]
        cells += [self._cells_before(k) for k in self._dirty if k in self._before]
        near = np.unique(np.concatenate(cells)) if cells else np.zeros(0, np.int64)
        if not len(near):
            return set()
        chunks = sorted(
            {n for k, _ in self._regrouped(changed).items() for n in neighbours(self._rows, k)}
            | {n for k in self._dirty for n in self._beside_before(k)}
        )
        self._look_up(chunks)
        groups = sorted({self._home[k, n] for k in chunks for n in self._shapes(k).local_id.tolist()})
        shapes = {k: self._shapes(k) for k in chunks}
        placed = {k: self._pose(k) for k in chunks}
        found = contested(groups, shapes, placed, self._world.unit, self._s.evidence, near)
        out: set[Group] = set()
        for k, (asked, drop) in found.items():
            bits = self._dropped_of(k).copy()
            other = asked[bits[asked] != drop]
            bits[asked] = drop
            if len(other):
                self._dropped[k] = bits
                out |= {self._home[k, int(shapes[k].local_id[n])] for n in np.unique(shapes[k].owner[other])}
        self._store.set_dropped({k: self._dropped[k] for k in found if k in self._dropped})
        return out

    def _regrouped(self, changed: Sequence[Group]) -> dict[int, list[int]]:
        """Local instances, by chunk, whose place may be claimed otherwise now: all of a group, but of a large one that
        only grew those that came to it.
        """
        out: dict[int, list[int]] = {}
        for g in changed:
            old = {self._old[k] for k in g if k in self._old}
            grown = len(old) == 1 and set(next(iter(old))) <= set(g)
            large = grown and len({k for k, _ in next(iter(old))}) >= _LARGE
            for k, n in g:
                if k in self._dirty or not large or (k, n) not in self._old:
                    out.setdefault(k, []).append(n)
        return out

    def _cells_of(self, found: tuple[int, list[int]]) -> Ints:
        k, local = found
        shapes = self._shapes(k)
        cells = claim_cells(shapes, self._pose(k), self._world.unit, self._s.evidence)
        return cells[np.isin(shapes.local_id[shapes.owner], local)]

    def _cells_before(self, k: int) -> Ints:
        """Cells that a chunk that moved has left."""
        pose = self._T_world_graph @ self._before[k].S_graph_chunk
        return claim_cells(self._shapes(k), pose, self._world.unit, self._s.evidence)

    def _beside_before(self, k: int) -> list[int]:
        return neighbours({**self._rows, k: self._before[k]}, k) if k in self._before else []

    def _dropped_of(self, k: int) -> np.ndarray:
        if k not in self._dropped:
            self._dropped[k] = self._store.dropped(k, len(self._shapes(k).points))
        return self._dropped[k]

    # ------------------------------------------------------------------ things

    def _thing(self, instance_id: int, group: Group, structure: str | None = None) -> Thing:
        """A thing, with its agreement still to be said."""
        chunks = {k: (self._shapes(k), self._pose(k), self._dropped_of(k)) for k in {k for k, _ in group}}
        component = self._rows[group[0][0]].component
        mover = self._mover(group)
        thing = thing_of(self._store, instance_id, group, group, chunks, component, self._s, self._world, mover)
        return replace(thing, body=replace(thing.body, structure=structure))

    def _stored(self, ids: Iterable[int]) -> list[Body]:
        """Bodies of instances as they are in the store."""
        for instance in self._store.instances_of(sorted(n for n in ids if n not in self._things)):
            group = self._group_of(instance.id)
            if group:
                thing = self._thing(instance.id, group, instance.structure)
                body = replace(thing.body, confidence=instance.confidence)
                self._things[instance.id] = replace(thing, body=body)
        return [self._things[n].body for n in sorted(ids) if n in self._things]

    def _write(
        self, ids: Identities, listed: Sequence[Group], weighed: _Weighed, recut: Collection[Group]
    ) -> dict[int, Array]:
        """Write the things of groups that changed; boxes, old and new, of all that relations must look at again."""
        store = self._store
        of = {g: n for g, n in zip(listed, ids.of_group, strict=True)}
        fresh = {n: g for g, n in of.items() if n is not None and g in weighed.evidence}
        for g in recut - weighed.evidence.keys():
            found = store.observed_as(g[:1])
            fresh |= {n: g for n in found.values()}
        keys = [k for g in weighed.evidence for k in g]
        gone = sorted(set(store.observed_as(keys).values()) - fresh.keys() - set(of.values()))
        boxes = {i.id: i.aabb for i in store.instances_of([*sorted(fresh), *gone])}
        labels = {i.id: i.label for i in store.instances_of(sorted(fresh))}
        kinds = {i.id: i.structure for i in store.instances_of(sorted(fresh))}
        for n in gone:
            store.drop_instance(n, dict(ids.aliases).get(n))
        store.forget_observations(keys)
        store.set_observations(Observation(n, *key) for n, g in sorted(fresh.items()) for key in g)
        weights = {k: len(self._frames_of(k)) for g in fresh.values() for k in g} if self._word.labels else {}
        order = sorted(fresh)
        said = self._word.labels_of([fresh[n] for n in order], weights)
        labels |= {order[at]: text for at, text in said.items()}
        confidence = {i.id: i.confidence for i in store.instances_of(order)}
        for n in order:
            thing = self._thing(n, fresh[n], kinds.get(n))
            seen = weighed.evidence.get(fresh[n])
            body = replace(thing.body, confidence=confidence.get(n, 1.0))
            self._things[n] = replace(thing, body=body) if seen is None else with_agreement(thing, seen.agreement)
        self._put(order, fresh, labels)
        again = self._classify(order, boxes)
        if again:
            groups = {n: self._group_of(n) for n in again}
            self._put(sorted(again), groups, {i.id: i.label for i in store.instances_of(sorted(again))})
        store.set_value("last_id", max(ids.last_id, int(store.get_value("last_id", 0))))
        self.written.update(order, again)
        touched = {n: self._things[n].body.aabb for n in (*order, *again)}
        return {n: _around(touched.get(n), boxes.get(n)) for n in {*touched, *gone}}

    def _group_of(self, n: int) -> Group:
        return tuple((o.chunk_id, o.local_id) for o in self._store.observations(n))

    def _put(self, ids: Sequence[int], groups: dict[int, Group], labels: dict[int, str | None]) -> None:
        store = self._store
        metric = store.get_value("scale_kind", "metric") != "relative"
        anchors, records = {}, []
        for n in ids:
            thing = self._things[n]
            rows = [store.chunk(k) for k in sorted({k for k, _ in groups[n]})]
            times = {f: t for row in rows for f, t in store.frame_times(row).items()}
            exact = store.chunk(thing.anchor).S_world_chunk @ self._pose(thing.anchor).inverse()
            record = moved(record_of(thing, labels.get(n), times, self._world, metric=metric), exact)
            records.append(replace(record, position_sigma_m=position_sigma(record.center, rows)))
            anchors[n] = Anchor(thing.anchor, exact)
        store.put_instances(records)
        store.put_anchors(anchors)
        if self._world.space and ids:
            store.put_embeddings(
                self._world.space, list(ids), np.array([self._things[n].feature for n in ids], np.float32)
            )

    # ------------------------------------------------------------------ structure and relations

    def _near(self, box: Array, reach: Array) -> list[int]:
        """Ids of the instances whose boxes come within `reach` of a box, along each axis."""
        slack = reach + _SLACK_M * self._world.unit
        return self._store.ids_in_box(box[0] - slack, box[1] + slack)

    def _classify(self, ids: Sequence[int], before: dict[int, Array]) -> list[int]:
        """Tell structure from things again near what changed; the ids that became something else."""
        reach = np.full(3, self._s.structure.near_m * self._world.unit)
        near = {m for n in ids for m in self._near(_around(self._things[n].body.aabb, before.get(n)), reach)}
        changed = []
        for body in self._stored(near | set(ids)):
            kind = None if self._things[body.id].dynamic else self._kind(body, reach)
            if kind != body.structure:
                changed.append(body.id)
                thing = self._things[body.id]
                self._things[body.id] = replace(thing, body=replace(thing.body, structure=kind))
        return changed

    def _kind(self, body: Body, reach: Array) -> str | None:
        if not (self._world.upright and body.component == self._world.first):
            return flagged_only([body])[0]
        if body.normal is None:
            return None
        near = [b for b in self._stored(self._near(body.aabb, reach)) if b.component == body.component]
        around = [b for b in near if not self._things[b.id].dynamic]
        return classify_structure(
            [body], self._world.floor, self._eye_level, self._world.unit, self._s.structure, around
        )[0]

    def _eye_level(self, body: Body) -> float:
        rows = [replace(self._store.chunk(k), S_world_chunk=self._pose(k)) for k, _ in self._group_of(body.id)]
        return eye_level(self._store, list({r.chunk_id: r for r in rows}.values()))

    def _relate(self, touched: dict[int, Array]) -> None:
        """Relations of what changed and of what is near it, looked at again with all that is near those."""
        unit, s = self._world.unit, self._s.relations
        reach = np.array([_REACH_M, _REACH_M, max(_REACH_M, s.above_m)]) * unit
        near = self._stored({n for box in touched.values() for n in self._near(box, reach)})
        subjects = {*touched, *(b.id for b in near if b.structure is None)}
        scene, ring = set(subjects), set(subjects)
        for _ in range(_RINGS):
            ring = {
                n
                for b in self._stored(ring)
                if b.id in subjects or b.structure is None
                for n in self._near(b.aabb, reach)
            } - scene
            scene |= ring
        cache = Measured(measured_before.get(self._store, {}))
        found = []
        bodies = [b for b in self._stored(scene) if self._things[b.id].resting]
        for component in sorted({b.component for b in bodies}):
            inside = [b for b in bodies if b.component == component]
            vertical = self._world.upright and component == self._world.first
            found += relations(inside, gravity_known=vertical, unit=unit, settings=s, measured=cache)
        measured_before[self._store] = cache.used
        self._store.replace_relations(
            sorted(subjects), [r for r in found if r.subject in subjects or r.object in subjects]
        )


_LARGE = 3
"""Chunks from which a group is large, see `evidence.contested`."""
_SLACK_M = 0.05
"""Boxes in the R*Tree are rounded and lie where the chunks lie to the last digit."""
_REACH_M = 0.85
"""Beyond it nothing stands on, in or beside a thing; above a thing, see `RelationSettings.above_m`."""
_RINGS = 3
"""Whether two things are related is told by what holds them, and by what holds that."""


def _around(a: Array | None, b: Array | None) -> Array:
    """The box round one or two boxes."""
    boxes = [x for x in (a, b) if x is not None]
    return np.stack([np.min([x[0] for x in boxes], axis=0), np.max([x[1] for x in boxes], axis=0)])
