"""What has changed between sessions: found when a session ends, else as the ledger of changes says."""

from __future__ import annotations

from collections.abc import Sequence

from list3r.memory.change.detection import OverlapGroups, as_events, find_changes
from list3r.memory.change.ledger import ChangeLedger, Group
from list3r.memory.change.records import Changes
from list3r.memory.geometry import Array
from list3r.memory.library.grouping import Grouping, chunks_of
from list3r.memory.library.redundancy import superseded
from list3r.memory.library.rules import edited_since
from list3r.memory.library.weighing import Weighing
from list3r.memory.overlap.pair_scores import Key
from list3r.memory.overlap.summaries import SomeSummaries
from list3r.memory.records import MergeDecision
from list3r.memory.store.tables.library import RedundantInstance


class SessionChanges:
    """The groups of dirty chunks with those that moved between sessions joined, and the states that follow."""

    def __init__(self, grouping: Grouping, weighing: Weighing) -> None:
        self._g, self._weighing = grouping, weighing
        self._store, self._rows = grouping.region.store, grouping.region.rows
        self._found: Changes | None = None
        self._apart: frozenset[int] = frozenset()
        """Components of later sessions: what those could not see there is unseen."""
        self._compared: frozenset[Group] = frozenset()
        """The instances that they could tell about."""

    def stand(self) -> tuple[list[Group], list[MergeDecision]]:
        """Return the groups that dirty chunks touch, joined as the ledger says, and the decisions."""
        places, decisions = self._g.partition()
        groups, self._g.ledger = self._g.ledger.joined(places, self._g.region.components(k for g in places for k in g))
        return [tuple(g) for g in groups], decisions

    def find(self) -> tuple[list[Group], list[MergeDecision]]:
        """Find what has changed, among what dirty chunks touch and all that later sessions can tell about; return the
        groups and the decisions.
        """
        region = self._g.region
        rows = {k: self._store.chunks.get(k) for k in region.settled}
        first = min(c.session_id for c in rows.values())
        later = [k for k, c in rows.items() if c.session_id > first]
        if not later:
            self._g.ledger = ChangeLedger(first)
            return self.stand()
        self._apart = frozenset(rows[k].component for k in later)
        seeds = region.keys_of(region.within_sight(later)) | self._g.ledger.keys()
        self._g.ledger = ChangeLedger(max(rows[k].session_id for k in later))
        places, decisions = self._g.partition(seeds)
        self._g.adopt(places)
        weighed = self._weighing.weigh_only(places)
        still = {g for g in places if self._g.mover(g) is None}
        old = self._store.library.redundant.superseded()
        every = dict(sorted(zip(_with(places, old), places, strict=True)))
        names = chunks_of(every) | {min(k for k, c in rows.items() if c.component == region.world.first)}
        found = find_changes(
            self._store,
            OverlapGroups(
                list(every),
                [weighed.shown[g] for g in every.values()],
                frozenset(whole[0] for whole, g in every.items() if g not in still),
            ),
            [region.settled_chunk(k) for k in sorted(names)],
            SomeSummaries(region.summaries, names, region.world.unit),
            region.settings.changes,
        )
        fresh = superseded(region, still, edited_since(self._store, 0))
        region.supersede(fresh)
        self._g.left_out = fresh
        gone = {row.key for row in (*old, *fresh)}
        self._found = found.without(gone)
        places = [tuple(k for k in g if k not in gone) for g in places]
        self._g.ledger = ChangeLedger.of(self._found, places, self._g.ledger.session)
        groups = [tuple(g) for g in self._found.groups]
        self._compared = frozenset(groups)
        return groups, decisions + self._found.decisions

    def state(self, before: str | None, group: Group) -> str:
        """Return the state of a group, which was in the state `before`."""
        if self._found is None:
            return self._g.ledger.state(before, group, {k: self._store.chunks.get(k) for k in {k for k, _ in group}})
        if group[0] in self._found.states:
            return self._found.states[group[0]]
        unseen = group not in self._compared and self._rows[group[0][0]].component in self._apart
        return "unseen" if unseen else "present"

    def write(self, groups: Sequence[Group]) -> tuple[dict[int, str], dict[int, Array]]:
        """Write events, and the states of instances that are not written anew; return these states and the boxes of
        the instances that came or went.
        """
        if self._found is None:
            return {}, {}
        owner = self._store.observations.owners([g[0] for g in groups])
        self._store.events.replace(as_events(self._found, owner))
        states = {n: self._found.states.get(key, "present") for key, n in owner.items()}
        now = self._store.instances.states()
        for n, (_, component) in now.items():
            states.setdefault(n, "unseen" if component in self._apart else "present")
        fresh = {n: states[n] for n, (was, _) in now.items() if states[n] != was}
        self._store.instances.set_states(fresh)
        turned = [n for n, s in fresh.items() if "removed" in (s, now[n][0])]
        return fresh, {i.id: i.aabb for i in self._store.instances.of(sorted(turned))}


def _with(groups: Sequence[Group], old: Sequence[RedundantInstance]) -> list[Group]:
    """Return groups with the local instances of earlier sessions that belong to them, though nothing is grouped by
    those any more.
    """
    like: dict[Key, list[Key]] = {}
    for row in old:
        like.setdefault(row.like, []).append(row.key)
    return [tuple(sorted([*g, *(key for member in g for key in like.get(member, ()))])) for g in groups]
