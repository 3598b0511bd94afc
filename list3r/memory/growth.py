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
from numpy.typing import NDArray

from list3r.memory.bodies import Body
from list3r.memory.derive import Thing, with_agreement
from list3r.memory.evidence import Evidence, claim_cells, contested, weigh
from list3r.memory.geometry import Array, Sim3
from list3r.memory.growth_region import Group, Region
from list3r.memory.identities import Identities, assign_ids
from list3r.memory.library_rows import log_decisions, moved, record_of
from list3r.memory.library_rules import ConsolidationReport, ConsolidationSettings, World
from list3r.memory.library_things import eye_level, measured_before, thing_of
from list3r.memory.library_verbs import Anchor, SettledRow
from list3r.memory.merging import Key
from list3r.memory.records import Observation
from list3r.memory.relation_scene import Measured
from list3r.memory.relations import relations
from list3r.memory.settling import neighbours, settle
from list3r.memory.shapes import Ints
from list3r.memory.store import Store
from list3r.memory.structure import classify_structure, flagged_only
from list3r.memory.summaries import Summaries
from list3r.memory.uncertainty import position_sigma


def grow(
    store: Store, summaries: Summaries, world: World, chunk_id: int, s: ConsolidationSettings, *, exact: bool
) -> ConsolidationReport | None:
    """Bring the library up to date with the chunks that are new or have moved; None where that would be most of them.

    For memories of one session. `exact` also puts the things of chunks that trembled where they lie to the last digit.
    """
    known = store.settled()
    asked = {c.chunk_id for c in store.chunks()} if exact or store.touched is None else store.touched
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


class _Growth(Region):
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
        super().__init__(store, summaries, world, s, dirty)
        self._before = before
        self._within: dict[Group, list[Group]] = {}
        self._dropped: dict[int, NDArray[np.bool_]] = {}
        self._things: dict[int, Thing] = {}
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
            {n for k, _ in self._regrouped(changed).items() for n in self._beside(k)}
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

    def _beside(self, k: int) -> list[int]:
        return neighbours(self._rows, k, None, self._extents)

    def _beside_before(self, k: int) -> list[int]:
        return neighbours(self._rows, k, self._before[k], self._extents) if k in self._before else []

    def _dropped_of(self, k: int) -> NDArray[np.bool_]:
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
