"""A library that grows: one more chunk, or some that moved, and what they touch; all else keeps its rows.

The result is that of deriving the whole library anew, which `tests/test_growth.py` asks for. Why what lies further
away need not be looked at:

- Groups. Edges are joined best first, and whether two groups join depends on their members alone. So the groups of a
  set of local instances can be formed without the others, as long as no edge leaves the set from a group that came out
  other than before; where one does, the group at its other end is taken in and the set is formed again.
- Sessions. Two chunks of two sessions are compared like any others. What has changed between sessions is told when one
  ends (`memory.tale`), of the chunks that later sessions saw and of those that see the same places: what no frame of
  theirs can see is unseen.
- Evidence. A group is weighed by the pairs of its own chunks.
- Points that belong to something else are told by the cells in which local instances lie that are new, moved or
  grouped otherwise.
- Structure and relations are told by what lies within a few metres, which the R*Tree finds; no thing is longer than
  `MergeSettings.most_span_m`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.change.detection import Changes, as_events, find_changes
from list3r.memory.change.ledger import Tale, write_tale
from list3r.memory.geometry import Array, Sim3
from list3r.memory.library.growth_region import Group, Occasion
from list3r.memory.library.growth_things import Writing
from list3r.memory.library.identities import Identities
from list3r.memory.library.rows import log_decisions, moved
from list3r.memory.library.rules import ConsolidationReport, ConsolidationSettings, World, spoken_of
from list3r.memory.library.settling import settle
from list3r.memory.library.uncertainty import position_sigma
from list3r.memory.overlap.summaries import SomeSummaries, Summaries
from list3r.memory.records import ChunkRow, MergeDecision
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import Anchor


def grow(
    store: Store,
    summaries: Summaries,
    world: World,
    chunk_id: int,
    s: ConsolidationSettings,
    tale: Tale,
    *,
    exact: bool,
) -> ConsolidationReport | None:
    """Bring the library up to date with the chunks that are new or have moved and with what operators said; None where
    that would be most of it.

    `exact` also puts the things of chunks that trembled where they lie to the last digit, and tells what has changed
    between sessions.
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
    spoken = spoken_of(store, world.edits)
    growth = _Growth(Occasion(store, summaries, world, s, tale, before, settled.moved, spoken))
    report = growth.run(chunk_id, telling=exact)
    _put_exactly(store, settled.S_exact_settled, growth.written, everywhere=exact)
    store.set_value("library", replace(world, edits=max((e.entry for e in store.edits()), default=0)).as_dict())
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


class _Growth(Writing):
    """One step of growing."""

    def __init__(self, occasion: Occasion) -> None:
        super().__init__(occasion)
        self._chunk_rows = {c.chunk_id: c for c in self._store.chunks() if c.chunk_id in self._rows}
        self._changes: Changes | None = None
        self._apart: frozenset[int] = frozenset()
        """Components of sessions that came later, when changes are told: what they could not see there is unseen."""
        self._seen: frozenset[Group] = frozenset()
        """The things that they could tell about."""

    def run(self, chunk_id: int, *, telling: bool) -> ConsolidationReport:
        """All that follows from the chunks that are new or moved and from what was said; with `telling` also from what
        has changed between sessions.
        """
        if not (self._dirty or self._spoken or telling):
            return self._report(Identities((), (), (), (), 0), ())
        self._compare()
        before = self._tale
        groups, decisions = self._told() if telling else self._joined()
        for g in groups:
            self._home.update(dict.fromkeys(g, g))
        changed = [g for g in groups if self._has_changed(g) or _told_otherwise(g, before, self._tale)]
        weighed = self._weigh(changed)
        contested_by = self._contest(changed)
        ids, listed, owned = self._identify(weighed)
        self._put_members(weighed.shown)
        touched = self._write(ids, listed, weighed, contested_by)
        if self._changes is not None:
            touched |= self._write_changes(groups, self._changes)
        if self._tale != before:
            write_tale(self._store, self._tale)
        self._relate(touched)
        log_decisions(self._store, chunk_id, decisions, owned, ids)
        return self._report(ids, touched)

    def _report(self, ids: Identities, touched: Iterable[int]) -> ConsolidationReport:
        things, structure = self._store.instance_count()
        hidden = self._store.hidden_groups()
        return ConsolidationReport(things, structure, ids.new, ids.aliases, hidden, frozenset(touched))

    def _joined(self) -> tuple[list[Group], list[MergeDecision]]:
        """The groups of what was touched, what has moved joined as it was told last."""
        places, decisions = self._partition()
        groups, self._tale = self._tale.joined(places, self._components(k for g in places for k in g))
        return [tuple(g) for g in groups], decisions

    # ------------------------------------------------------------------ changes between sessions

    def _told(self) -> tuple[list[Group], list[MergeDecision]]:
        """The groups of what was touched and of all that later sessions can tell about, and what has changed there."""
        first = min(c.session_id for c in self._chunk_rows.values())
        later = [c for c in self._chunk_rows.values() if c.session_id > first]
        if not later:
            self._tale = Tale(first)
            return self._joined()
        self._apart = frozenset(c.component for c in later)
        seeds = {(k, n) for k in self._in_reach(later) for n in self._shapes(k).local_id.tolist()}
        seeds |= self._tale.keys()
        self._tale = Tale(max(c.session_id for c in later))
        places, decisions = self._partition(seeds)
        for g in places:
            self._home.update(dict.fromkeys(g, g))
        weighed = self._weigh_only(places)
        names = {k for g in places for k, _ in g}
        names |= {min(k for k, c in self._chunk_rows.items() if c.component == self._world.first)}
        self._changes = find_changes(
            self._store,
            places,
            [weighed.shown[g] for g in places],
            frozenset(g[0] for g in places if self._mover(g) is not None),
            [replace(self._chunk_rows[k], S_world_chunk=self._pose(k)) for k in sorted(names)],
            SomeSummaries(self._summaries, names, self._world.unit),
            self._s.changes,
        )
        self._tale = Tale.of(self._changes, places, self._tale.session)
        groups = [tuple(g) for g in self._changes.groups]
        self._seen = frozenset(groups)
        return groups, decisions + self._changes.decisions

    def _in_reach(self, later: Sequence[ChunkRow]) -> list[int]:
        """Chunks of later sessions, those that their frames can tell about, and those whose frames can tell about what
        they saw.
        """
        ids = sorted(self._chunk_rows)
        boxes = np.array([self._span(k) for k in ids])
        part = np.array([self._rows[k].component for k in ids])
        depth = self._s.changes.visibility.most_depth_m * self._world.unit / float(self._T_world_graph.scale)
        found = np.zeros(len(ids), bool)
        for row in later:
            low, high = boxes[ids.index(row.chunk_id)]
            meet = np.all((boxes[:, 0] <= high + depth) & (boxes[:, 1] >= low - depth), axis=1)
            found |= meet & (part == self._rows[row.chunk_id].component)
        return [k for k, near in zip(ids, found, strict=True) if near]

    def _span(self, chunk_id: int) -> Array:
        """Box round the points and the cameras of a chunk, in the frame of the graph. Shape (2, 3)."""
        row, extent = self._chunk_rows[chunk_id], self._rows[chunk_id].extent
        frames = [f.T_chunk_cam[:3, 3] for f in self._store.frames_of(row) if f.state == "posed"]
        if not frames:
            return extent
        at = self._rows[chunk_id].S_graph_chunk.apply(np.array(frames))
        return np.stack([np.minimum(extent[0], at.min(axis=0)), np.maximum(extent[1], at.max(axis=0))])

    def _state(self, before: str | None, group: Group) -> str:
        if self._changes is None:
            return super()._state(before, group)
        if group[0] in self._changes.states:
            return self._changes.states[group[0]]
        unseen = group not in self._seen and self._rows[group[0][0]].component in self._apart
        return "unseen" if unseen else "present"

    def _write_changes(self, groups: Sequence[Group], changes: Changes) -> dict[int, Array]:
        """Events, and the states of all things that are not written anew; boxes of those that came or went."""
        owner = self._store.observed_as([g[0] for g in groups])
        self._store.replace_events(as_events(changes, owner))
        states = {n: changes.states.get(key, "present") for key, n in owner.items()}
        now = self._store.states()
        for n, (_, component) in now.items():
            states.setdefault(n, "unseen" if component in self._apart else "present")
        fresh = {n: states[n] for n, (was, _) in now.items() if states[n] != was}
        self._store.set_states(fresh)
        self._states |= {n: s for n, s in fresh.items() if n in self._states}
        turned = [n for n, s in fresh.items() if "removed" in (s, now[n][0])]
        return {i.id: i.aabb for i in self._store.instances_of(sorted(turned))}


def _told_otherwise(group: Group, before: Tale, now: Tale) -> bool:
    """Whether a thing has moved, or come to have events, or the other way round."""
    return before.current(group) != now.current(group) or before.shows(group) != now.shows(group)
