"""Chunks that add nothing to what others of their session saw.

A camera that stays in one room comes to the same things again and again. As ORB-SLAM (IEEE T-RO 2015) culls keyframes
whose points enough other keyframes see, a chunk all of whose local instances lie on what enough earlier chunks of its
session saw is redundant: no group is formed, weighed or derived with it, so that a chunk costs what is near, not how
often it was seen (decision 0113). What it saw counts among the observations of the instances that it saw.

It is decided when a chunk settles, of what was settled before it; what was not redundant once stays so.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from list3r.memory.library.region import Region
from list3r.memory.merging.edges import NONE, links_of
from list3r.memory.overlap.pair_scores import Key
from list3r.memory.overlap.voxels import Ints
from list3r.memory.records import Instance, Observation
from list3r.memory.store.tables.library import RedundantInstance


@dataclass(frozen=True)
class SeenSpan:
    """When an instance is seen, redundant chunks included."""

    frames: int
    """Different frames."""
    first_s: float
    last_s: float

    def on(self, instance: Instance) -> Instance:
        """Return an instance that says so."""
        return replace(instance, observations=self.frames, first_seen_s=self.first_s, last_seen_s=self.last_s)


@dataclass(frozen=True)
class Culled:
    """What came of deciding which chunks are redundant."""

    settled: frozenset[int]
    """Chunks that are not, and are new, moved, or were redundant before."""
    like: frozenset[Key]
    """Local instances that what redundant chunks see, or saw before, is like."""


def cull(region: Region, moved: Collection[int], edited: Iterable[Key]) -> Culled:
    """Decide which of the chunks are redundant that moved, or of which edits named a local instance."""
    table, links = region.store.library.redundant, region.store.edits.constraints().links
    like: set[Key] = set()
    asked = {*moved, *({k for k, _ in edited} & table.chunks())}
    for k in sorted(asked):
        before = table.of([k]) if k in table.chunks() else []
        if not before and region.store.library.members.of([k]):
            continue
        found = _redundant(region, k) if k in moved else before
        if any(links.forbids(row.key, row.like) for row in found):
            found = []
        if found or before:
            table.put(k, found)
            region.leave(k) if found else region.enter(k)
            like.update(row.like for row in (*before, *found) if row.like[0] != k)
    return Culled(frozenset(asked & region.rows.keys()), frozenset(like))


def _redundant(region: Region, k: int) -> list[RedundantInstance]:
    """Return the local instances of a redundant chunk; none of a chunk that is not."""
    settings, shapes = region.settings.redundancy, region.shapes(k)
    if settings.chunks == 0 or region.summary(k).motions or not len(shapes.points):
        return []
    session = region.store.chunks.get(k).session_id
    earlier = [u for u in region.near(k) if u < k and region.store.chunks.get(u).session_id == session]
    if len(earlier) < settings.chunks:
        return []
    seen = np.zeros(len(shapes.local_id), np.int64)
    seen[np.setdiff1d(np.arange(len(seen)), shapes.owner)] = settings.chunks
    like: dict[int, tuple[float, Key]] = {}
    for u in reversed(earlier):
        p = region.score(u, k)
        seen[np.unique(p.j[p.j_on_i >= settings.covered])] += 1
        links = links_of(region.nodes_of(u), region.nodes_of(k), p, region.settings.merging)
        still = ~np.isin(region.shapes(u).local_id[p.i], list(region.summary(u).motions))
        for n in np.flatnonzero((links.kind != NONE) & still).tolist():
            best = float(links.score[n]), (u, int(region.shapes(u).local_id[p.i[n]]))
            like[int(p.j[n])] = max(best, like.get(int(p.j[n]), best))
        if seen.min() >= settings.chunks:
            return [
                RedundantInstance((k, n), like[j][1] if j in like else (k, n), shapes.frames[j].astype(np.int32))
                for j, n in enumerate(shapes.local_id.tolist())
            ]
    return []


def follow(region: Region, moved: Collection[int], culled: Culled, written: Collection[int]) -> set[int]:
    """Write which instances redundant chunks that moved belong to, and when those were seen that were not `written`
    anew; return their ids.
    """
    store = region.store
    rows = store.library.redundant.of(sorted(store.library.redundant.chunks() & set(moved)))
    owners = store.observations.owners(sorted(culled.like))
    store.observations.forget(row.key for row in rows if row.like not in owners)
    store.observations.set(Observation(owners[row.like], *row.key) for row in rows if row.like in owners)
    ids = sorted(set(owners.values()) - set(written))
    seen = {n: sightings(region, _members(region, n)) for n in ids}
    store.instances.put(s.on(i) for i in store.instances.of(ids) if (s := seen[i.id]) is not None)
    return set(ids)


def _members(region: Region, instance_id: int) -> list[Key]:
    found = ((o.chunk_id, o.local_id) for o in region.store.observations.of(instance_id))
    return [key for key in found if key[0] in region.rows]


def sightings(region: Region, group: Sequence[Key]) -> SeenSpan | None:
    """Return when a group is seen, with the redundant chunks that saw it."""
    frames: dict[int, list[Ints]] = {}
    holder: dict[tuple[int, int], int] = {}
    like = region.store.library.redundant.like(group)
    seen = [(key[0], region.frames_of(key)) for key in group] + [(row.key[0], row.frames) for row in like]
    for k, indices in seen:
        session = region.store.chunks.get(k).session_id
        if len(indices):
            frames.setdefault(session, []).append(indices.astype(np.int64))
            holder |= {(session, int(indices.min())): k, (session, int(indices.max())): k}
    if not frames:
        return None
    every = {session: np.unique(np.concatenate(parts)) for session, parts in frames.items()}
    ends = [(session, int(f)) for session, held in every.items() for f in (held[0], held[-1])]
    times = [region.times_of(holder[end]).get(end, 0.0) for end in ends]
    return SeenSpan(sum(map(len, every.values())), min(times), max(times))
