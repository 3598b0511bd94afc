"""Which of the groups that were formed anew count, whose id they bear, and which points they lose (`memory.growth`)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from list3r.memory.library.evidence import Evidence, claim_cells, contested, weigh, without_missed
from list3r.memory.library.growth_region import Group, Occasion, Region
from list3r.memory.library.identities import Identities, assign_ids
from list3r.memory.library.settling import neighbours
from list3r.memory.overlap.missed import frames_beside
from list3r.memory.overlap.pair_scores import Key, Meetings
from list3r.memory.overlap.voxels import Ints

_LARGE = 3
"""Chunks from which a group is large, see `evidence.contested`."""
_UNWEIGHED = Evidence(0, 0, 0, ())


@dataclass
class Weighed:
    """Groups whose evidence was weighed, and what came of it."""

    evidence: dict[Group, Evidence] = field(default_factory=dict)
    shown: dict[Group, bool] = field(default_factory=dict)


class Weighing(Region):
    """The region with what speaks for and against its groups."""

    def __init__(self, occasion: Occasion) -> None:
        super().__init__(occasion)
        self._within: dict[Group, list[Group]] = {}
        self._dropped: dict[int, NDArray[np.bool_]] = {}

    # ------------------------------------------------------------------ evidence and ids

    def _weigh(self, changed: Sequence[Group]) -> Weighed:
        """Evidence for the groups that changed and for those that have one of them, or a chunk that is new or moved,
        against them; as long as one of them comes to be shown or not, also for those that lie within it.
        """
        out = Weighed()
        wanted = {*changed, *self._against(changed), *(self._home[k] for k in self._left), *self._looked_at()}
        while True:
            fresh = sorted(wanted - out.evidence.keys())
            if not fresh:
                return out
            self._weigh_some(fresh, out)
            flipped = [g for g in fresh if self._old_shown.get(g) != out.shown[g]]
            wanted |= self._against(flipped)

    def _weigh_only(self, groups: Sequence[Group]) -> Weighed:
        """Evidence for these groups alone."""
        out = Weighed()
        self._weigh_some(groups, out)
        return out

    def _weigh_some(self, wanted: Sequence[Group], out: Weighed) -> None:
        pairs = self._pairs_of({k for g in wanted for k, _ in g})
        scope = {k for pair in pairs for k in pair} | {k for g in wanted for k, _ in g}
        self._look_up(scope)
        nodes = [(k, n) for k in scope for n in self._shapes(k).local_id.tolist()]
        groups = sorted({self._home[key] for key in nodes})
        at = {g: n for n, g in enumerate(groups)}
        shapes = {k: self._shapes(k) for k in scope}
        found = weigh(groups, shapes, pairs, self._s.evidence, {at[g] for g in wanted})
        seen = [found[at[g]] for g in wanted]
        said = [
            e.shown(self._s.evidence, self._world.posed) or self._tale.shows(g)
            for e, g in zip(seen, wanted, strict=True)
        ]
        shown = self._word.shown(wanted, said)
        for g, e, show in zip(wanted, seen, shown, strict=True):
            self._within[g] = [groups[w] for w in e.within]
            out.evidence[g] = e
            out.shown[g] = show

    def _looked_at(self) -> set[Group]:
        """Groups in frames that chunks of computed depth share with one that is new or moved, which may miss them."""
        pairs = self._pairs_of(self._dirty)
        shapes = {k: self._shapes(k) for k in sorted({k for pair in pairs for k in pair})}
        beside = frames_beside(shapes, pairs)
        self._look_up(beside)
        out: set[Group] = set()
        for k, others in beside.items():
            shared = np.unique(np.concatenate(list(others.values())))
            seen = [len(np.intersect1d(frames, shared)) > 0 for frames in shapes[k].frames]
            out |= {self._home[k, int(n)] for n in shapes[k].local_id[seen]}
        return out

    def _against(self, groups: Collection[Group]) -> set[Group]:
        """Groups of which a member lies on a member of one of these."""
        keys = {k for g in groups for k in g}
        pairs = self._pairs_of({k for k, _ in keys})
        numbering = self._numbered(k for pair in pairs for k in pair)
        meet, here = Meetings.of(pairs, numbering), numbering.flags(keys)
        inside = np.maximum(meet.a_on_b, meet.b_on_a) >= self._s.evidence.swallowed
        inside &= here[meet.a] | here[meet.b]
        found = np.unique(np.concatenate([meet.a[inside], meet.b[inside]]))
        return {self._home[numbering.keys[n]] for n in found}

    def _identify(self, weighed: Weighed) -> tuple[Identities, list[Group], dict[Key, int]]:
        """Ids of the groups that were weighed, and of those that they lie within; what they were before."""
        shown = {**self._old_shown, **weighed.shown}
        inner = {g: next((w for w in self._within[g] if shown.get(w, False)), None) for g in weighed.evidence}
        listed = sorted({*weighed.evidence, *(w for w in inner.values() if w is not None)})
        at = {g: n for n, g in enumerate(listed)}
        keys = [k for g in listed for k in g]
        before = self._word.remembered(listed, self._store.observed_as(keys))
        weights = {(k, n): len(self._frames_of((k, n))) for k, n in keys}
        known = [weighed.evidence.get(g, _UNWEIGHED) for g in listed]
        before = without_missed(before, listed, known, [shown.get(g, False) for g in listed])
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
