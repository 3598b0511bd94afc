"""The instances of groups: derived, written, told apart from structure, and related to what is near."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.change.ledger import Group
from list3r.memory.geometry import Array
from list3r.memory.library.grouping import Grouping
from list3r.memory.library.instances import DerivedInstance, Members, derived_instance
from list3r.memory.library.redundancy import followers, sightings
from list3r.memory.library.rows import looks_of, moved, record_of
from list3r.memory.library.session_changes import SessionChanges
from list3r.memory.library.uncertainty import position_sigma
from list3r.memory.library.weighing import Named, Weighed, Weighing
from list3r.memory.overlap.summaries import cameras_of
from list3r.memory.records import Observation
from list3r.memory.relations.instance_geometry import InstanceGeometry
from list3r.memory.relations.predicates import relations
from list3r.memory.relations.scene import PairMeasures
from list3r.memory.relations.structure import classify_structure, flagged_only, is_level
from list3r.memory.store.tables.library import Anchor, GroupMember
from list3r.memory.world.floor import floor_near

_SLACK_M = 0.05
"""Boxes in the R*Tree are rounded and lie where the chunks lie to the last digit."""
_REACH_M = 0.85
"""Beyond it nothing stands on, in or beside an instance; above one, see `RelationSettings.above_m`."""
_RINGS = 3
"""Whether two instances are related is decided by what holds them, and by what holds that."""

_TOGETHER, _PLACE_M = 256, 8.0
"""Most instances whose relations are found at once, and the edge of the places by which those are chosen."""


class Writer:
    """Derives and writes the instances of one derivation."""

    def __init__(self, grouping: Grouping, weighing: Weighing, sessions: SessionChanges) -> None:
        self._g, self._weighing, self._sessions = grouping, weighing, sessions
        self._region, self._store = grouping.region, grouping.region.store
        self._world, self._s = grouping.region.world, grouping.region.settings
        self._derived: dict[int, DerivedInstance] = {}
        self._states: dict[int, str] = {}
        self.written: set[int] = set()
        """Instances that were written anew."""

    def write(self, named: Named, weighed: Weighed, recut: Collection[Group]) -> dict[int, Array]:
        """Write the instances of groups that were weighed or `recut`; return the boxes, old and new together, of all
        whose relations must be looked at again.
        """
        store, ids = self._store, named.ids
        self._put_members(weighed.shown)
        of = {g: n for g, n in zip(named.groups, ids.of_group, strict=True)}
        fresh = {n: g for g, n in of.items() if n is not None and g in weighed.evidence}
        for g in recut - weighed.evidence.keys():
            fresh |= dict.fromkeys(store.observations.owners(g[:1]).values(), g)
        before = store.observations.owners([k for g in weighed.evidence for k in g])
        known = store.instances.states().keys() if self._g.dirty.whole else set(before.values())
        gone = sorted(known - fresh.keys() - set(of.values()))
        was = {i.id: i for i in store.instances.of([*sorted(fresh), *gone])}
        boxes = {n: i.aabb for n, i in was.items()}
        labels = {n: i.label for n, i in was.items()} | self._edited_labels(fresh)
        self._states |= {n: self._sessions.state(was[n].state if n in was else None, g) for n, g in fresh.items()}
        for n in gone:
            store.instances.drop(n, dict(ids.aliases).get(n))
        now = {key: n for n, g in fresh.items() for key in g}
        turned = {key for key in {*before, *now} if before.get(key) != now.get(key)}
        like = followers(store, sorted(turned | {row.like for row in self._g.left_out}))
        before |= store.observations.owners([row.key for row in like])
        for row in like:
            now |= {row.key: now[row.like]} if row.like in now else {}
        store.observations.forget(before.keys() - now.keys())
        store.observations.set(Observation(n, *key) for key, n in now.items() if before.get(key) != n)
        order = sorted(fresh)
        for n in order:
            found = self._derive(n, fresh[n], was[n].structure if n in was else None)
            seen = weighed.evidence.get(fresh[n])
            kept = was[n].confidence if n in was else 1.0
            sure = kept if seen is None else round(seen.confidence, 4)
            self._derived[n] = replace(found, geometry=replace(found.geometry, confidence=sure))
        self._put(order, fresh, labels)
        again = sorted(self._classify(order, boxes))
        if again:
            self._put(again, {n: self._group_of(n) for n in again}, {i.id: i.label for i in store.instances.of(again)})
        store.facts.last_id = max(ids.last_id, store.facts.last_id)
        self.written.update(order, again)
        touched = {n: self._derived[n].geometry.aabb for n in (*order, *again)}
        return {n: around(touched.get(n), boxes.get(n)) for n in {*touched, *gone}}

    def set_states(self, states: Mapping[int, str]) -> None:
        """Take over states of instances that were not written anew."""
        self._states |= {n: s for n, s in states.items() if n in self._states}

    def _derive(self, instance_id: int, group: Group, structure: str | None = None) -> DerivedInstance:
        """Return an instance, with its confidence still to be said."""
        region = self._region
        chunks = {k: (region.shapes(k), region.pose(k), self._weighing.dropped_of(k)) for k in {k for k, _ in group}}
        mover, here = self._g.mover(group), self._here(group)
        component = region.rows[group[0][0]].component
        upright = self._world.upright and component == self._world.first
        marks = {k: region.mark(k) for k in chunks}
        members = Members(group, here, chunks, marks, component, upright, mover)
        found = derived_instance(self._store, instance_id, members, self._s.derive)
        return replace(found, geometry=replace(found.geometry, structure=structure))

    def _here(self, group: Group) -> Group:
        """Return the members of a group that show it where it is now."""
        return group if self._g.mover(group) is not None else self._g.ledger.current(group)

    def _stored(self, ids: Iterable[int]) -> list[InstanceGeometry]:
        """Return geometries of instances as they are in the store."""
        for instance in self._store.instances.of(sorted(n for n in ids if n not in self._derived)):
            group = self._group_of(instance.id)
            if group:
                found = self._derive(instance.id, group, instance.structure)
                geometry = replace(found.geometry, confidence=instance.confidence)
                self._derived[instance.id] = replace(found, geometry=geometry)
                self._states[instance.id] = instance.state
        return [self._derived[n].geometry for n in sorted(ids) if n in self._derived]

    def _put_members(self, shown: Mapping[Group, bool]) -> None:
        """Write who is grouped with whom, where that was otherwise."""
        before, shown_before = self._g.before, self._g.shown_before
        self._store.library.members.put(
            GroupMember(key, g[0], show)
            for g, show in shown.items()
            for key in g
            if key not in before or (before[key][0], shown_before[before[key]]) != (g[0], show)
        )

    def _edited_labels(self, fresh: Mapping[int, Group]) -> dict[int, str | None]:
        """Return labels that edits gave to instances that are written: each goes to the group with most of what it was
        given to, be that written or not.
        """
        here = {k: n for n, g in fresh.items() for k in g}
        labels, rows = self._g.constraints.labels, self._region.rows
        named = {k for keys, _ in labels if not keys.isdisjoint(here) for k in keys if k[0] in rows}
        if not named:
            return {}
        self._g.look_up({k for k, _ in named})
        groups = sorted({*fresh.values(), *(self._g.home[k] for k in named if k in self._g.home)})
        weights = {k: self._region.seen_for(k) for g in groups for k in g}
        of = {g: n for n, g in fresh.items()}
        found = self._g.constraints.labels_of(groups, weights)
        return {of[groups[at]]: text for at, text in found.items() if groups[at] in of}

    def _group_of(self, n: int) -> Group:
        return tuple(key for key in self._store.library.members.group_of(n) if self._region.takes_part(key))

    def _put(self, ids: Sequence[int], groups: Mapping[int, Group], labels: Mapping[int, str | None]) -> None:
        store = self._store
        metric = store.facts.scale_kind != "relative"
        anchors, records = {}, []
        for n in ids:
            found = self._derived[n]
            chunks = sorted({k for k, _ in groups[n]})
            times = {f: t for k in chunks for f, t in self._region.times_of(k).items()}
            exact = store.chunks.get(found.anchor).S_world_chunk @ self._region.pose(found.anchor).inverse()
            record = moved(record_of(found, labels.get(n), times, self._world, metric=metric), exact)
            if self._store.library.redundant.any():
                seen = sightings(self._region, self._here(groups[n]))
                record = record if seen is None else seen.on(record)
            sigma = position_sigma(record.center, [store.chunks.get(k) for k in chunks])
            records.append(replace(record, state=self._states[n], position_sigma_m=sigma))
            anchors[n] = Anchor(found.anchor, exact)
        store.instances.put(records)
        store.library.anchors.put(anchors)
        store.library.looks.put(looks_of(self._derived[n]) for n in ids)
        if self._world.space and ids:
            features = np.array([self._derived[n].feature for n in ids], np.float32)
            store.embeddings.put(self._world.space, list(ids), features)

    # ------------------------------------------------------------------ structure and relations

    def _near(self, box: Array, reach: Array) -> list[int]:
        """Return ids of the instances whose boxes come within `reach` of a box, along each axis."""
        slack = reach + _SLACK_M * self._world.unit
        return self._store.instances.ids_in_box(box[0] - slack, box[1] + slack)

    def _classify(self, ids: Sequence[int], before: Mapping[int, Array]) -> list[int]:
        """Tell structure from what stands in the room near what changed; the ids that became something else."""
        reach = np.full(3, self._s.structure.near_m * self._world.unit)
        near = {m for n in ids for m in self._near(around(self._derived[n].geometry.aabb, before.get(n)), reach)}
        changed = []
        for geometry in self._stored(near | set(ids)):
            kind = None if self._derived[geometry.id].dynamic else self._kind(geometry, reach)
            if kind != geometry.structure:
                changed.append(geometry.id)
                found = self._derived[geometry.id]
                self._derived[geometry.id] = replace(found, geometry=replace(found.geometry, structure=kind))
        return changed

    def _kind(self, geometry: InstanceGeometry, reach: Array) -> str | None:
        upright = self._world.upright and geometry.component == self._world.first
        if not upright or geometry.normal is None:
            return flagged_only([geometry])[0]
        near = [b for b in self._stored(self._near(geometry.aabb, reach)) if b.component == geometry.component]
        still = [b for b in near if not self._derived[b.id].dynamic]
        world, s = self._world, self._s.structure
        rows = [self._region.settled_chunk(k) for k in dict.fromkeys(k for k, _ in self._group_of(geometry.id))]
        cameras = cameras_of(self._store, rows).translation
        eyes = float(np.quantile(cameras[:, 2], s.eye_level)) if len(cameras) else np.inf
        floor = None
        if world.floor_seen and is_level(geometry, s):
            low = replace(self._s.gravity, floor_low_cameras=s.low_cameras)
            floor = floor_near(still, cameras, world.unit, low)
        return classify_structure([geometry], floor, lambda _: eyes, world.unit, s, still)[0]

    def relate(self, touched: Mapping[int, Array]) -> None:
        """Find the relations of what changed and of what is near it again, among all that is near those.

        A scene takes memory by the square of its instances, so many are looked at place by place.
        """
        order = sorted(touched, key=lambda n: (*np.floor(touched[n].mean(axis=0) / (_PLACE_M * self._world.unit)), n))
        for first in range(0, len(order), _TOGETHER):
            self._relate({n: touched[n] for n in order[first : first + _TOGETHER]})

    def _relate(self, touched: Mapping[int, Array]) -> None:
        unit, s = self._world.unit, self._s.relations
        reach = np.array([_REACH_M, _REACH_M, max(_REACH_M, s.above_m)]) * unit
        near = self._stored({n for box in touched.values() for n in self._near(box, reach)})
        subjects = {*touched, *(b.id for b in near if b.structure is None)}
        scene, ring = set(subjects), set(subjects)
        for _ in range(_RINGS):
            there = [b for b in self._stored(ring) if b.id in subjects or b.structure is None]
            ring = {n for b in there for n in self._near(b.aabb, reach)} - scene
            scene |= ring
        measured = self._store.derived.of(PairMeasures)
        measured.begin(unit, s)
        found = []
        there = [b for b in self._stored(scene) if self._states[b.id] != "removed" and self._derived[b.id].resting]
        for component in sorted({b.component for b in there}):
            inside = [b for b in there if b.component == component]
            vertical = self._world.upright and component == self._world.first
            sure = self._world.sure_of_up
            found += relations(
                inside, gravity_known=vertical, unit=unit, settings=s, measured=measured, sure_of_up=sure
            )
        kept = [r for r in found if r.subject in subjects or r.object in subjects]
        self._store.relations.replace(sorted(subjects), kept)


def around(a: Array | None, b: Array | None) -> Array:
    """Return the box round one or two boxes."""
    boxes = [x for x in (a, b) if x is not None]
    return np.stack([np.min([x[0] for x in boxes], axis=0), np.max([x[1] for x in boxes], axis=0)])
