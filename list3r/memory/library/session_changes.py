"""What has changed between sessions: found when a session ends, else as the ledger of changes says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

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
from list3r.memory.records import ChunkRow, MergeDecision
from list3r.memory.store.tables.library import RedundantInstance


class SessionChanges:
    """The groups of dirty chunks with those that moved between sessions joined, and the states that follow."""

    def __init__(self, grouping: Grouping, weighing: Weighing) -> None:
        self._g, self._weighing = grouping, weighing
        self._store, self._rows = grouping.region.store, grouping.region.rows
        self._found: Changes | None = None
        self._told = ChangeLedger(0)
        """What stands of sessions before those that are matched."""
        self._apart: frozenset[int] = frozenset()
        """Components of the sessions that are matched: what those could not see there is unseen."""
        self._compared: frozenset[Group] = frozenset()
        """The instances that they could tell about."""

    def stand(self) -> tuple[list[Group], list[MergeDecision]]:
        """Return the groups that dirty chunks touch, joined as the ledger says, and the decisions."""
        places, decisions = self._g.partition()
        groups, self._g.ledger = self._joined(places)
        return groups, decisions

    def _joined(self, places: Sequence[Group]) -> tuple[list[Group], ChangeLedger]:
        """Return groups by overlap joined as the ledger says, and the ledger as it is of these."""
        groups, ledger = self._g.ledger.joined(places, self._g.region.components(k for g in places for k in g))
        stands = self._stands() and not self._regrouped(groups) and not self._at_two_places(ledger)
        return [tuple(g) for g in groups], replace(ledger, stands=stands)

    def _stands(self) -> bool:
        """Return whether what sessions told before stands: nothing that they told of has moved or was edited."""
        ledger, dirty = self._g.ledger, self._g.dirty
        again = any(self._session((k, 0)) <= ledger.session for k in dirty.chunks)
        return ledger.stands and not (dirty.whole or dirty.edited or again)

    def _regrouped(self, groups: Sequence[Sequence[Key]]) -> bool:
        """Return whether instances that sessions told of before are one now, or one of them has come apart."""
        before, shown, told = self._g.before, self._g.shown_before, self._g.ledger.session
        parts = [{before[k] for k in g if k in before and self._session(k) <= told} for g in groups]
        counts = Counter(was for part in parts for was in part if shown[was])
        return any(sum(shown[was] for was in part) > 1 for part in parts) or any(n > 1 for n in counts.values())

    def _at_two_places(self, ledger: ChangeLedger) -> bool:
        """Return whether a session that nothing is told of yet found what had moved at two of its places."""
        for m in ledger.moved:
            seen = Counter(session for place in m.places for session in {self._session(k) for k in place})
            if any(n > 1 and session > ledger.session for session, n in seen.items()):
                return True
        return False

    def _session(self, key: Key) -> int:
        return self._store.chunks.get(key[0]).session_id

    def find(self) -> tuple[list[Group], list[MergeDecision]]:
        """Find what has changed, among what dirty chunks touch and all that the sessions can tell about of which
        nothing stands; return the groups and the decisions.
        """
        region = self._g.region
        rows = {k: self._store.chunks.get(k) for k in region.settled}
        sessions = sorted({c.session_id for c in rows.values()})
        if len(sessions) < 2:
            self._g.ledger = ChangeLedger(sessions[0])
            return self.stand()
        places, decisions = self._places(rows)
        self._apart = frozenset(c.component for c in rows.values() if c.session_id > self._told.session)
        self._g.adopt(places)
        weighed = self._weighing.weigh_only(places)
        still = {g for g in places if self._g.mover(g) is None}
        old = self._store.library.redundant.superseded(k for g in places for k in g)
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
            self._told,
        )
        fresh = superseded(region, still, edited_since(self._store, 0))
        self._g.uncovered = region.supersede(fresh)
        self._g.left_out = fresh
        like = {row.key: row.like for row in (*old, *fresh)}
        self._found = found.without(like)
        places = [tuple(k for k in g if k not in like) for g in places]
        groups = [tuple(g) for g in self._found.groups]
        self._g.ledger = ChangeLedger.of(self._found, places, sessions[-1]).beside(self._told, groups, like)
        self._compared = frozenset(groups)
        return groups, decisions + self._found.decisions

    def _places(self, rows: Mapping[int, ChunkRow]) -> tuple[list[Group], list[MergeDecision]]:
        """Return the groups by overlap in which is looked for changes, and the decisions: of the sessions that have
        ended since the last time, where what was told before stands, else of all but the first.
        """
        before = self._g.ledger
        if self._stands() and any(c.session_id > before.session for c in rows.values()):
            found = self._g.partition(before.gone | self._in_sight(rows, before.session))
            self._told = self._joined(found[0])[1]
        if not self._told.stands:
            self._told = ChangeLedger(min(c.session_id for c in rows.values()))
            self._g.ledger = self._told  # what had moved is not one instance any more
            found = self._g.partition(before.keys() | self._in_sight(rows, self._told.session))
        return found

    def _in_sight(self, rows: Mapping[int, ChunkRow], told: int) -> set[Key]:
        """Return the local instances about which sessions after one can tell."""
        region = self._g.region
        return region.keys_of(region.within_sight(k for k, c in rows.items() if c.session_id > told))

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
        self._store.events.replace(as_events(self._found, owner), after=self._told.session)
        states = {n: self._found.states.get(key, "present") for key, n in owner.items()}
        now = self._store.instances.states()
        for n, (was, component) in now.items():
            states.setdefault(n, "unseen" if component in self._apart else was if self._told.stands else "present")
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
