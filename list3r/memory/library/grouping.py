"""How local instances are grouped into instances: those of dirty chunks, and all that an edge ties to them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from list3r.memory.change.ledger import ChangeLedger, Group
from list3r.memory.library.region import DirtySet, Region
from list3r.memory.merging.edges import NONE, form_groups
from list3r.memory.merging.movers import Mover, join_movers, tied_movers
from list3r.memory.overlap.pair_scores import Key
from list3r.memory.records import MergeDecision
from list3r.memory.store.tables.library import RedundantInstance


class Grouping:
    """The groups of local instances as they were at the last derivation, and as they are now."""

    def __init__(self, region: Region, dirty: DirtySet, ledger: ChangeLedger) -> None:
        self.region, self.dirty, self.ledger = region, dirty, ledger
        self.constraints = region.store.edits.constraints()
        self.home: dict[Key, Group] = {}
        """The group of each local instance of the chunks that were looked up, as it is now."""
        self.before: dict[Key, Group] = {}
        """The same at the last derivation."""
        self.shown_before: dict[Group, bool] = {}
        self.left_out: Sequence[RedundantInstance] = ()
        """What is in no group from now on, since later sessions saw it again."""
        self.uncovered: Collection[Key] = ()
        """Local instances of which much lay on one of those."""
        self._known: set[int] = set()
        self._movers: dict[Group, Mover] = {}

    def look_up(self, chunk_ids: Iterable[int]) -> None:
        """Read how the local instances of chunks were grouped; new ones stand alone."""
        missing = sorted(set(chunk_ids) - self._known)
        if not missing:
            return
        self._known.update(missing)
        found = self.region.store.library.members.of(missing)
        for first, shown in sorted({(m.first, m.shown) for m in found.values()}):
            group = tuple(self.region.store.library.members.group(first))
            if group and group[0] not in self.before:
                self.before.update(dict.fromkeys(group, group))
                self.shown_before[group] = shown
                for key in group:
                    self.home.setdefault(key, group)
        for key in self.region.keys_of(missing):
            self.home.setdefault(key, (key,))

    def groups_in(self, chunk_ids: Iterable[int]) -> list[Group]:
        """Return the groups, as they are now, of all local instances of some chunks."""
        chunk_ids = list(chunk_ids)
        self.look_up(chunk_ids)
        return sorted({self.home[key] for key in self.region.keys_of(chunk_ids)})

    def adopt(self, groups: Iterable[Group]) -> None:
        """Take groups as they are now."""
        for g in groups:
            self.home.update(dict.fromkeys(g, g))

    def has_changed(self, group: Group) -> bool:
        """Return whether a group is new, was edited, or has a member of a dirty chunk."""
        edited = not self.dirty.edited.isdisjoint(group)
        return self.before.get(group[0]) != group or edited or any(k in self.dirty.chunks for k, _ in group)

    def mover(self, group: Group) -> Mover | None:
        """Return what is known of a group that moves."""
        region = self.region
        if not region.has_motion or region.motions({k for k, _ in group}).keys().isdisjoint(group):
            return None
        if group not in self._movers:
            self._form(set(group))
        return self._movers.get(group)

    def partition(self, seeds: Collection[Key] = ()) -> tuple[list[Group], list[MergeDecision]]:
        """Form the groups of all local instances that dirty chunks, or these seeds, touch; return them and the
        decisions.

        Edges are joined best first, and whether two groups join depends on their members alone. So a set of local
        instances can be grouped without the others, as long as no edge leaves it from a group that came out other
        than before; where one does, the group at its other end is taken in and the set is grouped again.
        """
        keys = self.region.keys_of(self.dirty.chunks)
        keys |= {k for k in (*self.dirty.edited, *seeds) if self.region.takes_part(k)}
        keys = self._closed(keys)
        keys = self._closed(keys | self._tied(keys, keys))
        while True:
            groups, decisions = self._form(keys)
            joined = self.ledger.joined(groups, self.region.components(keys))[0]
            changed = {k for g in joined if self.has_changed(tuple(g)) for k in g}
            left = self._closed(self._tied(changed, keys)) - keys
            if not left:
                return groups, decisions
            keys |= left

    def _closed(self, keys: Collection[Key]) -> set[Key]:
        """Return all local instances that were in one group with any of these."""
        self.look_up({k for k, _ in keys})
        return {m for key in keys for m in (*self.before.get(key, ()), key) if m[0] in self.region.rows}

    def _tied(self, keys: Collection[Key], inside: Collection[Key]) -> set[Key]:
        """Return local instances outside that an edge, or motion, ties to one of these."""
        numbering, links = self.region.links_of(self.region.pairs_of({k for k, _ in keys}))
        here, outside = numbering.flags(keys), ~numbering.flags(inside)
        tied = links.kind != NONE
        found = [y[tied & here[x] & outside[y]] for x, y in ((links.a, links.b), (links.b, links.a))]
        return {numbering.keys[n] for n in np.unique(np.concatenate(found))} | self._tied_by_motion(keys, inside)

    def _tied_by_motion(self, keys: Collection[Key], inside: Collection[Key]) -> set[Key]:
        region = self.region
        chunks = region.near_in_time({k for k, _ in keys}) if region.has_motion else set()
        moving = region.motions(chunks)
        if not moving:
            return set()
        others = region.keys_of(chunks) - set(inside)
        if moving.keys().isdisjoint(keys):
            others &= moving.keys()
        placed, tracks = region.placed(chunks), region.tracks(chunks)
        return tied_movers(sorted(keys), sorted(others), placed, tracks, region.settings.moving)

    def _form(self, keys: Collection[Key]) -> tuple[list[Group], list[MergeDecision]]:
        """Return the groups of some local instances alone, and the decisions."""
        if not keys:
            return [], []
        region = self.region
        chunks = sorted({k for k, _ in keys})
        apart = [((k, int(a)), (k, int(b))) for k in chunks for a, b in region.summary(k).cannot_link]
        tables, links = {k: region.nodes_of(k) for k in chunks}, region.links_inside(set(chunks))
        groups, decisions = form_groups(tables, links, keys, apart, region.settings.merging, self.constraints)
        components = region.components(keys)
        movers: dict[Key, Mover] = {}
        motions = region.motions(chunks) if region.has_motion else {}
        if motions:
            apart, tracks = apart + self.constraints.pairs_apart(motions), region.tracks(chunks)
            groups, movers, joins = join_movers(groups, region.placed(chunks), apart, tracks, region.settings.moving)
            decisions = decisions + joins
        joined, movers = self.constraints.joined(groups, components, movers)
        self._movers |= {tuple(g): movers[g[0]] for g in joined if g[0] in movers}
        return [tuple(g) for g in joined], decisions


def chunks_of(groups: Iterable[Sequence[Key]]) -> set[int]:
    """Return the chunks that hold a member of some groups."""
    return {k for g in groups for k, _ in g}
