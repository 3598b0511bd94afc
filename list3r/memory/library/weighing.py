"""Which of the groups that were formed anew are shown, whose id they bear, and which points they lose."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.memory.change.ledger import Group
from list3r.memory.geometry import Sim3
from list3r.memory.library.evidence import Evidence, claim_cells, contested, covered, weigh, without_missed
from list3r.memory.library.grouping import Grouping, chunks_of
from list3r.memory.library.identities import Identities, assign_ids
from list3r.memory.overlap.missed import frames_beside
from list3r.memory.overlap.pair_scores import Key, Numbering, PairTable
from list3r.memory.overlap.voxels import Ints

_LARGE = 3
"""Chunks from which a group is large, see `evidence.contested`."""
_UNWEIGHED = Evidence(0, 0, 0, ())


@dataclass
class Weighed:
    """Groups whose evidence was weighed, and what came of it."""

    evidence: dict[Group, Evidence] = field(default_factory=dict)
    shown: dict[Group, bool] = field(default_factory=dict)


@dataclass(frozen=True)
class Named:
    """Groups with their ids."""

    ids: Identities
    groups: list[Group]
    """In the order of the ids: those that were weighed, and those that they lie within."""
    before: Mapping[Key, int]
    """The instances that the members belonged to."""


class Weighing:
    """What speaks for and against groups."""

    def __init__(self, grouping: Grouping) -> None:
        self._g, self._region = grouping, grouping.region
        self._within: dict[Group, list[Group]] = {}
        self._dropped: dict[int, NDArray[np.bool_]] = {}

    # ------------------------------------------------------------------ evidence and ids

    def weigh(self, changed: Iterable[Group], left: Collection[Key]) -> Weighed:
        """Weigh the groups that changed, those that have one of them, or a chunk that is new or moved, against them,
        those whose place such a chunk saw, and those that moved chunks or superseded instances have `left`; whenever
        one of them comes to be shown or not, also those that lie within it.
        """
        out = Weighed()
        changed = list(changed)
        left = [k for k in {*left, *self._g.uncovered} if self._region.takes_part(k)]
        self._g.look_up(k for k, _ in left)
        wanted = {*changed, *self._against(changed), *(self._g.home[k] for k in left)}
        wanted |= self._looked_at() | self._covered()
        while True:
            fresh = sorted(wanted - out.evidence.keys())
            if not fresh:
                return out
            self._weigh_into(out, fresh)
            flipped = [g for g in fresh if self._g.shown_before.get(g) != out.shown[g]]
            wanted |= self._against(flipped)

    def weigh_only(self, groups: Sequence[Group]) -> Weighed:
        """Weigh these groups alone."""
        out = Weighed()
        self._weigh_into(out, groups)
        return out

    def inside(self, group: Group, others: Collection[Group]) -> bool:
        """Return whether a group that was weighed lies within one of the others."""
        return any(g in others for g in self._within[group])

    def _weigh_into(self, out: Weighed, wanted: Sequence[Group]) -> None:
        region = self._region
        pairs = region.pairs_of(chunks_of(wanted))
        scope = {k for pair in pairs for k in pair} | chunks_of(wanted)
        groups = self._g.groups_in(scope)
        at = {g: n for n, g in enumerate(groups)}
        shapes, settings = {k: region.shapes(k) for k in scope}, region.settings.evidence
        found = weigh(groups, shapes, pairs, settings, {at[g] for g in wanted})
        seen = [found[at[g]] for g in wanted]
        ledger = self._g.ledger
        counts = [e.shown(settings, region.world.posed) or ledger.shows(g) for e, g in zip(seen, wanted, strict=True)]
        shown = self._g.constraints.shown(wanted, counts)
        for g, e, show in zip(wanted, seen, shown, strict=True):
            self._within[g] = [groups[w] for w in e.within]
            out.evidence[g] = e
            out.shown[g] = show

    def _looked_at(self) -> set[Group]:
        """Return groups in frames that chunks of computed depth share with a dirty one, which may miss them."""
        pairs = self._region.pairs_of(self._g.dirty.chunks)
        shapes = {k: self._region.shapes(k) for k in sorted({k for pair in pairs for k in pair})}
        beside = frames_beside(shapes, pairs)
        self._g.look_up(beside)
        out: set[Group] = set()
        for k, others in beside.items():
            shared = np.unique(np.concatenate(list(others.values())))
            seen = [len(np.intersect1d(frames, shared)) > 0 for frames in shapes[k].frames]
            out |= {self._g.home[k, int(n)] for n in shapes[k].local_id[seen]}
        return out

    def _covered(self) -> set[Group]:
        """Return groups on whose surface a dirty chunk has instances, so that it saw their place."""
        dirty = self._g.dirty.chunks
        pairs = self._region.pairs_of(dirty)
        chunks = {k for pair in pairs for k in pair}
        self._g.look_up(chunks)
        numbering = Numbering({k: self._region.shapes(k) for k in chunks})
        over = covered(PairTable.of(pairs, numbering), numbering, self._region.settings.evidence.covered)
        return {self._g.home[key] for key, found in over.items() if not dirty.isdisjoint(found)}

    def _against(self, groups: Collection[Group]) -> set[Group]:
        """Return groups of which a member lies on a member of one of these."""
        pairs = self._region.pairs_of(chunks_of(groups))
        chunks = {k for pair in pairs for k in pair}
        self._g.look_up(chunks)
        numbering = Numbering({k: self._region.shapes(k) for k in chunks})
        meet, here = PairTable.of(pairs, numbering), numbering.flags({k for g in groups for k in g})
        inside = np.maximum(meet.a_on_b, meet.b_on_a) >= self._region.settings.evidence.swallowed
        inside &= here[meet.a] | here[meet.b]
        found = np.unique(np.concatenate([meet.a[inside], meet.b[inside]]))
        return {self._g.home[numbering.keys[n]] for n in found}

    def name(self, weighed: Weighed) -> Named:
        """Give ids to the groups that were weighed, and look up those of the groups that they lie within."""
        shown = {**self._g.shown_before, **weighed.shown}
        inner = {g: next((w for w in self._within[g] if shown.get(w, False)), None) for g in weighed.evidence}
        groups = sorted({*weighed.evidence, *(w for w in inner.values() if w is not None)})
        at = {g: n for n, g in enumerate(groups)}
        keys = [k for g in groups for k in g]
        visible = [shown.get(g, False) for g in groups]
        before = self._g.constraints.remembered(groups, self._region.store.observations.owners(keys))
        before = without_missed(before, groups, [weighed.evidence.get(g, _UNWEIGHED) for g in groups], visible)
        within = [None if (w := inner.get(g)) is None else at[w] for g in groups]
        weights = {key: self._region.seen_for(key) for key in keys}
        left = {row.key: at[g] for row in self._g.left_out if (g := self._g.home[row.like]) in at}
        owners = self._region.store.observations.owners(sorted(left))
        weights |= {key: self._region.seen_for(key) for key in owners}
        whole = [[*g, *(key for key in owners if left[key] == n)] for n, g in enumerate(groups)]
        ids = assign_ids(whole, {**before, **owners}, weights, visible, within, self._region.store.ids.next())
        return Named(ids, groups, before)

    # ------------------------------------------------------------------ points that belong to something else

    def contest(self, changed: Sequence[Group]) -> set[Group]:
        """Look again at the cells of what is new, moved or grouped otherwise; return the groups that lost or won
        points.
        """
        dirty, region = self._g.dirty, self._region
        regrouped = self._regrouped(changed)
        left = {k: dirty.before[k] for k in sorted(dirty.moved) if k in dirty.before}
        cells = [self._cells_of(keys) for keys in regrouped.items()]
        cells += [self._cells(k, region.pose_before(row)) for k, row in left.items()]
        near = np.unique(np.concatenate(cells)) if cells else np.zeros(0, np.int64)
        if not len(near):
            return set()
        beside = {n for k in regrouped for n in region.near(k)}
        chunks = sorted(beside | {n for k, row in left.items() for n in region.near(k, row)})
        shapes, placed = {k: region.shapes(k) for k in chunks}, {k: region.pose(k) for k in chunks}
        groups = self._g.groups_in(chunks)
        found = contested(groups, shapes, placed, region.world.unit, region.settings.evidence, near)
        out: set[Group] = set()
        for k, (asked, drop) in found.items():
            bits = self.dropped_of(k).copy()
            other = asked[bits[asked] != drop]
            bits[asked] = drop
            if len(other):
                self._dropped[k] = bits
                out |= {self._g.home[k, int(shapes[k].local_id[n])] for n in np.unique(shapes[k].owner[other])}
        region.store.library.settled.set_dropped({k: self._dropped[k] for k in found if k in self._dropped})
        return out

    def _regrouped(self, changed: Sequence[Group]) -> dict[int, list[int]]:
        """Return local instances, by chunk, whose place may be claimed otherwise now: all of a group, but of a large
        one that only grew those that came to it.
        """
        before, out = self._g.before, dict[int, list[int]]()
        for g in changed:
            old = {before[k] for k in g if k in before}
            grown = len(old) == 1 and set(next(iter(old))) <= set(g)
            large = grown and len(chunks_of(old)) >= _LARGE
            for k, n in g:
                if k in self._g.dirty.chunks or not large or (k, n) not in before:
                    out.setdefault(k, []).append(n)
        return out

    def _cells(self, chunk_id: int, S_world_chunk: Sim3) -> Ints:
        shapes, settings = self._region.shapes(chunk_id), self._region.settings.evidence
        return claim_cells(shapes, S_world_chunk, self._region.world.unit, settings)

    def _cells_of(self, found: tuple[int, list[int]]) -> Ints:
        k, local = found
        shapes = self._region.shapes(k)
        return self._cells(k, self._region.pose(k))[np.isin(shapes.local_id[shapes.owner], local)]

    def dropped_of(self, chunk_id: int) -> NDArray[np.bool_]:
        """Return which points of a chunk's shapes belong to something else. Shape (R,)."""
        if chunk_id not in self._dropped:
            count = len(self._region.shapes(chunk_id).points)
            self._dropped[chunk_id] = self._region.store.library.settled.dropped(chunk_id, count)
        return self._dropped[chunk_id]
