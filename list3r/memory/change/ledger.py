"""The changes as found when a session last ended, in terms of local instances, which never change.

Until the next session ends it stands: its chunks come to the library by overlap alone, what had moved stays one
instance whose box is where it was last, and what had events stays shown. Then it is found what that session has changed
(`change.detection`). What sessions before have told stands, as long as nothing was moved or edited that they told of;
else all of it is found again.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from list3r.memory.change.records import Changes
from list3r.memory.overlap.pair_scores import Key
from list3r.memory.records import ChunkRow
from list3r.memory.store.facts import Fact
from list3r.memory.store.store import Store

Group = tuple[Key, ...]


@dataclass(frozen=True)
class MovedInstance:
    """An instance that was at several places."""

    places: tuple[Group, ...]
    """Groups by overlap."""
    now: int
    """Which of them is where it is now."""


@dataclass(frozen=True)
class ChangeLedger:
    """The matching of the sessions that have ended."""

    session: int
    """The last session that it covers."""
    moved: tuple[MovedInstance, ...] = ()
    with_events: frozenset[Key] = frozenset()
    """A local instance of every instance that has an event."""
    gone: frozenset[Key] = frozenset()
    """A local instance of every instance that is gone,"""
    told_gone: frozenset[Key] = frozenset()
    """and of every one that any session told to be gone."""
    displaced: frozenset[Key] = frozenset()
    """A local instance at every place where something was found in the place of something else, and of that."""
    stands: bool = False
    """Whether the next session can be matched with what this says of those before."""

    @staticmethod
    def of(changes: Changes, places: Sequence[Sequence[Key]], session: int) -> ChangeLedger:
        """Return what was found, given the groups by overlap that it was found for."""
        home = {key: tuple(g) for g in places for key in g}
        moved = []
        for group in changes.groups:
            if group[0] in changes.current:
                parts = sorted({home[key] for key in group})
                moved.append(MovedInstance(tuple(parts), parts.index(home[changes.current[group[0]][0]])))
        here = {g[0]: changes.current.get(g[0], g)[0] for g in changes.groups}
        gone = frozenset(here[key] for key, state in changes.states.items() if state == "removed")
        told_gone = frozenset(here[key] for key in changes.told_gone)
        with_events = frozenset(e.first for e in changes.events)
        displaced = frozenset(home[key][0] for key in changes.displaced)
        return ChangeLedger(session, tuple(moved), with_events, gone, told_gone, displaced, stands=True)

    def beside(self, before: ChangeLedger, groups: Sequence[Sequence[Key]], like: Mapping[Key, Key]) -> ChangeLedger:
        """Return it with what an earlier ledger says of instances that are not among these groups, and with the events
        of sessions before. `like` leads from local instances that are in no group any more to those that stand for
        them.
        """
        first = _first_members(groups)
        found = first.keys() | like.keys()
        moved = [m for m in before.moved if found.isdisjoint(m.places[m.now])]
        with_events = (like.get(key, key) for key in before.with_events)
        return replace(
            self,
            moved=tuple(sorted([*moved, *self.moved], key=lambda m: min(m.places))),
            with_events=self.with_events | {first.get(key, key) for key in with_events},
            gone=self.gone | (before.gone - found),
            told_gone=self.told_gone | (before.told_gone - found),
            displaced=self.displaced | (before.displaced - found),
        )

    def shows(self, group: Collection[Key]) -> bool:
        """Return whether a group has an event, so that it is shown however little was seen of it."""
        return not self.with_events.isdisjoint(group)

    def current(self, group: Sequence[Key]) -> tuple[Key, ...]:
        """Return the members of an instance that show it where it is now; all, but for what has moved."""
        here = set(group)
        for m in self.moved:
            if not here.isdisjoint(m.places[m.now]):
                return tuple(k for k in group if k in m.places[m.now])
        return tuple(group)

    def keys(self) -> set[Key]:
        """Return all local instances that it concerns."""
        return {k for m in self.moved for place in m.places for k in place} | self.with_events

    def joined(
        self, groups: Sequence[Sequence[Key]], components: Mapping[int, int]
    ) -> tuple[list[list[Key]], ChangeLedger]:
        """Return groups by overlap with those joined that are the places of one instance, and the ledger with the
        places as they have become; what it says of instances that are not among the groups stands. `components` by
        chunk id.
        """
        from scipy.cluster.hierarchy import DisjointSet

        home = {key: n for n, group in enumerate(groups) for key in group}
        sets = DisjointSet(range(len(groups)))
        owners: list[tuple[int, MovedInstance]] = []
        absent = []
        for m in self.moved:
            found = sorted({home[k] for place in m.places for k in place if k in home})
            here = sorted({home[k] for k in m.places[m.now] if k in home})
            if not found or not here:
                absent += [m] if not found else []
                continue
            component = components[groups[here[0]][0][0]]
            same = [n for n in found if components[groups[n][0][0]] == component]
            for n in same[1:]:
                sets.merge(same[0], n)
            owners.append((same[0], m))
        owner = {sets[n]: m for n, m in owners}
        parts = {sets[ns[0]]: ns for ns in map(sorted, sets.subsets())}
        renewed = [_renewed([groups[n] for n in ns], owner.get(first)) for first, ns in parts.items()]
        out = sorted(sorted(k for n in ns for k in groups[n]) for ns in parts.values())
        moved = sorted([*absent, *(m for m in renewed if m is not None)], key=lambda m: min(m.places))
        first = _first_members(out)
        with_events = frozenset(first.get(key, key) for key in self.with_events)
        return out, replace(self, moved=tuple(moved), with_events=with_events)

    def state(self, before: str | None, group: Sequence[Key], rows: Mapping[int, ChunkRow]) -> str:
        """Return the state of an instance: the one that was told, until a later session sees it."""
        later = any(rows[k].session_id > self.session for k in {k for k, _ in group})
        return "present" if before is None or later else before


def _first_members(groups: Iterable[Sequence[Key]]) -> dict[Key, Key]:
    return {key: g[0] for g in groups for key in g}


def _renewed(groups: Sequence[Sequence[Key]], before: MovedInstance | None) -> MovedInstance | None:
    """Return the places of one instance as groups have become; nothing where they are one by overlap."""
    if before is None or len(groups) < 2:
        return None
    there = set(before.places[before.now])
    here = [g for g in groups if not there.isdisjoint(g)]
    rest = [tuple(sorted(g)) for g in groups if there.isdisjoint(g)]
    now = tuple(sorted(k for g in here for k in g))
    places = sorted([now, *rest])
    return MovedInstance(tuple(places), places.index(now)) if here and rest else None


def read_ledger(store: Store, chunks: Sequence[ChunkRow]) -> ChangeLedger | None:
    """Return what stands of changes; None where several sessions have ended and nothing is written down of them."""
    stored = store.facts[_LEDGER]
    if stored is not None:
        return stored
    complete = {s.session_id for s in store.sessions.all() if s.state == "complete"}
    ended = sorted({c.session_id for c in chunks} & complete)
    return ChangeLedger(ended[0] if ended else 0) if len(ended) < 2 else None


def write_ledger(store: Store, ledger: ChangeLedger) -> None:
    """Keep it; call inside `transaction()`."""
    store.facts[_LEDGER] = ledger


_LEDGER = Fact[ChangeLedger | None]("change_ledger", ChangeLedger, None)
