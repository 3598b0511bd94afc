"""The things of a region: derived, written, told apart from structure, related to what is near (`memory.growth`)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.geometry import Array
from list3r.memory.library.derivation import Thing, with_agreement
from list3r.memory.library.growth_evidence import Weighed, Weighing
from list3r.memory.library.growth_region import Group, Occasion
from list3r.memory.library.identities import Identities
from list3r.memory.library.instances import eye_level, thing_of
from list3r.memory.library.rows import moved, record_of
from list3r.memory.library.uncertainty import position_sigma
from list3r.memory.records import Observation
from list3r.memory.relations.bodies import Body
from list3r.memory.relations.predicates import relations
from list3r.memory.relations.scene import Measured
from list3r.memory.relations.structure import classify_structure, flagged_only
from list3r.memory.store.tables.library import Anchor

_SLACK_M = 0.05
"""Boxes in the R*Tree are rounded and lie where the chunks lie to the last digit."""
_REACH_M = 0.85
"""Beyond it nothing stands on, in or beside a thing; above a thing, see `RelationSettings.above_m`."""
_RINGS = 3
"""Whether two things are related is told by what holds them, and by what holds that."""


class Writing(Weighing):
    """The region with its things."""

    def __init__(self, occasion: Occasion) -> None:
        super().__init__(occasion)
        self._things: dict[int, Thing] = {}
        self._states: dict[int, str] = {}
        """Of the things, by id."""
        self.written: set[int] = set()
        """Instances that were written anew."""

    def _state(self, before: str | None, group: Group) -> str:
        """The state of a thing that is written, which was in the state `before`."""
        rows = {k: self._store.chunk(k) for k in {k for k, _ in group}}
        return self._tale.state(before, group, rows)

    def _thing(self, instance_id: int, group: Group, structure: str | None = None) -> Thing:
        """A thing, with its agreement still to be said."""
        chunks = {k: (self._shapes(k), self._pose(k), self._dropped_of(k)) for k in {k for k, _ in group}}
        component = self._rows[group[0][0]].component
        mover = self._mover(group)
        here = group if mover is not None else self._tale.current(group)
        thing = thing_of(self._store, instance_id, group, here, chunks, component, self._s, self._world, mover)
        return replace(thing, body=replace(thing.body, structure=structure))

    def _stored(self, ids: Iterable[int]) -> list[Body]:
        """Bodies of instances as they are in the store."""
        for instance in self._store.instances_of(sorted(n for n in ids if n not in self._things)):
            group = self._group_of(instance.id)
            if group:
                thing = self._thing(instance.id, group, instance.structure)
                body = replace(thing.body, confidence=instance.confidence)
                self._things[instance.id] = replace(thing, body=body)
                self._states[instance.id] = instance.state
        return [self._things[n].body for n in sorted(ids) if n in self._things]

    def _write(
        self, ids: Identities, listed: Sequence[Group], weighed: Weighed, recut: Collection[Group]
    ) -> dict[int, Array]:
        """Write the things of groups that changed; boxes, old and new, of all that relations must look at again."""
        store = self._store
        of = {g: n for g, n in zip(listed, ids.of_group, strict=True)}
        fresh = {n: g for g, n in of.items() if n is not None and g in weighed.evidence}
        for g in recut - weighed.evidence.keys():
            found = store.observed_as(g[:1])
            fresh |= {n: g for n in found.values()}
        before = store.observed_as([k for g in weighed.evidence for k in g])
        gone = sorted(set(before.values()) - fresh.keys() - set(of.values()))
        was = {i.id: i for i in store.instances_of([*sorted(fresh), *gone])}
        boxes = {n: i.aabb for n, i in was.items()}
        labels = {n: i.label for n, i in was.items()} | self._said(fresh)
        self._states |= {n: self._state(was[n].state if n in was else None, g) for n, g in fresh.items()}
        for n in gone:
            store.drop_instance(n, dict(ids.aliases).get(n))
        now = {key: n for n, g in fresh.items() for key in g}
        store.forget_observations(before.keys() - now.keys())
        store.set_observations(Observation(n, *key) for key, n in now.items() if before.get(key) != n)
        order = sorted(fresh)
        for n in order:
            thing = self._thing(n, fresh[n], was[n].structure if n in was else None)
            seen = weighed.evidence.get(fresh[n])
            body = replace(thing.body, confidence=was[n].confidence if n in was else 1.0)
            self._things[n] = replace(thing, body=body) if seen is None else with_agreement(thing, seen.agreement)
        self._put(order, fresh, labels)
        again = self._classify(order, boxes)
        if again:
            groups = {n: self._group_of(n) for n in again}
            self._put(sorted(again), groups, {i.id: i.label for i in store.instances_of(sorted(again))})
        store.set_value("last_id", max(ids.last_id, int(store.get_value("last_id", 0))))
        self.written.update(order, again)
        touched = {n: self._things[n].body.aabb for n in (*order, *again)}
        return {n: around(touched.get(n), boxes.get(n)) for n in {*touched, *gone}}

    def _put_members(self, shown: Mapping[Group, bool]) -> None:
        """Write who is grouped with whom, where that was otherwise."""
        self._store.put_members(
            (key, g[0], show)
            for g, show in shown.items()
            for key in g
            if key not in self._old or (self._old[key][0], self._old_shown[self._old[key]]) != (g[0], show)
        )

    def _said(self, fresh: Mapping[int, Group]) -> dict[int, str | None]:
        """What operators called things that are written: a name goes to the group with most of what it was given to,
        be that written or not.
        """
        here = {k: n for n, g in fresh.items() for k in g}
        spoken = {k for keys, _ in self._word.labels if not keys.isdisjoint(here) for k in keys if k[0] in self._rows}
        if not spoken:
            return {}
        self._look_up({k for k, _ in spoken})
        groups = sorted({*fresh.values(), *(self._home[k] for k in spoken if k in self._home)})
        weights = {k: len(self._frames_of(k)) for g in groups for k in g}
        of = {g: n for n, g in fresh.items()}
        return {of[groups[at]]: text for at, text in self._word.labels_of(groups, weights).items() if groups[at] in of}

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
            record = replace(record, state=self._states[n])
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
        near = {m for n in ids for m in self._near(around(self._things[n].body.aabb, before.get(n)), reach)}
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
        still = [b for b in near if not self._things[b.id].dynamic]
        return classify_structure(
            [body], self._world.floor, self._eye_level, self._world.unit, self._s.structure, still
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
        measured = self._store.derived.of(Measured)
        measured.begin()
        found = []
        there = [b for b in self._stored(scene) if self._states[b.id] != "removed"]
        bodies = [b for b in there if self._things[b.id].resting]
        for component in sorted({b.component for b in bodies}):
            inside = [b for b in bodies if b.component == component]
            vertical = self._world.upright and component == self._world.first
            found += relations(inside, gravity_known=vertical, unit=unit, settings=s, measured=measured)
        self._store.replace_relations(
            sorted(subjects), [r for r in found if r.subject in subjects or r.object in subjects]
        )


def around(a: Array | None, b: Array | None) -> Array:
    """The box round one or two boxes."""
    boxes = [x for x in (a, b) if x is not None]
    return np.stack([np.min([x[0] for x in boxes], axis=0), np.max([x[1] for x in boxes], axis=0)])
