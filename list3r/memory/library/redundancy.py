"""Local instances that add nothing to what others of their session saw.

A camera that stays in one room comes to the same things again and again. As ORB-SLAM (IEEE T-RO 2015) culls keyframes
whose points enough other keyframes see, a local instance is redundant whose surface enough earlier chunks of its
session saw, as one thing or in pieces: no group is formed, weighed or derived with it, so that a chunk costs what is
new in it, not how often its place was seen (decisions 0113 and 0118). A redundant one counts among the observations of
the instance that it is like.

It is decided when a chunk settles, of what was settled before it; what was not redundant once stays so.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.library.region import Region
from list3r.memory.merging.edges import NONE, links_of
from list3r.memory.merging.nodes import Nodes
from list3r.memory.overlap.pair_scores import Key, pair_scores
from list3r.memory.overlap.voxels import ChunkShapes, GrownCells, Ints, lies_on
from list3r.memory.records import Instance, Observation
from list3r.memory.runs import runs_seen, seen_together
from list3r.memory.store.tables.library import RedundantInstance

_COMPARED = 3
"""Chunks with which a redundant local instance is compared, to find what it is like: those that saw most of it."""


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
    """What came of deciding which local instances are redundant."""

    settled: frozenset[int]
    """Chunks that take part, and are new, moved, or had others that are redundant before."""
    like: frozenset[Key]
    """Local instances that redundant ones are like, or were before."""


def cull(region: Region, moved: Collection[int], edited: Iterable[Key]) -> Culled:
    """Decide which local instances are redundant of the chunks that moved, or of which edits named a redundant one."""
    table, links = region.store.library.redundant, region.store.edits.constraints().links
    known = {row.key: row for row in table.of(sorted({*moved, *(k for k, _ in edited)}))}
    asked = {*moved, *(k for k, _ in known)}
    like: set[Key] = set()
    for k in sorted(asked):
        before = [row for row in known.values() if row.key[0] == k]
        if not before and region.store.library.members.of([k]):
            continue
        found = _redundant(region, k) if k in moved else before
        found = [row for row in found if not before or row.key in known]
        found = [row for row in found if not links.forbids(row.key, row.like)]
        if found or before:
            every = len(found) == len(region.summaries[k].shapes.local_id)
            table.put(k, found, all_of_it=every)
            region.look_again(k)
            like.update(row.like for row in (*before, *found) if row.like != row.key)
    return Culled(frozenset(asked & region.rows.keys()), frozenset(like))


def _redundant(region: Region, k: int) -> list[RedundantInstance]:
    """Return the redundant local instances of a chunk; what moves is none of them."""
    settings, summary = region.settings.redundancy, region.summaries[k]
    session = region.store.chunks.get(k).session_id
    earlier = [u for u in region.near(k) if u < k and region.store.chunks.get(u).session_id == session]
    if settings.chunks == 0 or len(earlier) < settings.chunks:
        return []
    shapes = summary.shapes
    known, beside = _seen_before(region, k, earlier)
    known &= ~np.isin(shapes.local_id, list(summary.motions))
    if not len(shapes.points) or not known[shapes.owner].any():
        return []
    like = _like(region, k, shapes.only(known), beside)
    return [
        RedundantInstance((k, n), like.get(n, (k, n)), frames.astype(np.int32))
        for n, frames, redundant in zip(shapes.local_id.tolist(), shapes.frames, known.tolist(), strict=True)
        if redundant
    ]


def _seen_before(region: Region, k: int, earlier: Sequence[int]) -> tuple[NDArray[np.bool_], list[int]]:
    """Return of which local instances of a chunk enough of some earlier chunks saw the surface, and the chunks that saw
    most of the surface of one of them.
    """
    settings, shapes = region.settings.redundancy, region.summaries[k].shapes
    points = region.settled[k].S_graph_chunk.apply(shapes.points)
    total = np.bincount(shapes.owner, minlength=len(shapes.local_id))
    times, known, grown = np.zeros(len(points), np.int64), total == 0, region.store.derived.of(GrownCells)
    met: dict[int, Ints] = {}
    for u in earlier:
        row = region.rows[u]
        asked = ~known[shapes.owner] & (times < settings.chunks)
        asked &= ((points >= row.extent[0]) & (points <= row.extent[1])).all(axis=1)
        at = np.flatnonzero(asked)
        if not len(at):
            continue
        placed = row.S_graph_chunk.inverse().apply(points[at])
        seen = at[lies_on(placed, region.still(u), grown)]
        times[seen] += 1
        met[u] = np.bincount(shapes.owner[seen], minlength=len(total))
        often = np.bincount(shapes.owner, times >= settings.chunks, minlength=len(total))
        known = often >= settings.covered * total
        if known.all():
            break
    order = np.argsort(
        -np.array([*met.values()], np.int64).reshape(len(met), len(total))[:, known], axis=0, kind="stable"
    )
    best = np.unique(order[:_COMPARED])
    return known, [u for n, u in enumerate(met) if n in best]


def _like(region: Region, k: int, shapes: ChunkShapes, beside: Sequence[int]) -> dict[int, Key]:
    """Return the local instances of other chunks that some of a chunk are most like, by local id."""
    own, grown = Nodes.of([shapes], {k: region.pose(k)}), region.store.derived.of(GrownCells)
    best: dict[int, tuple[float, Key]] = {}
    for u in beside:
        S_u_k = region.settled[u].S_graph_chunk.inverse() @ region.settled[k].S_graph_chunk
        p = pair_scores(region.still(u), shapes, S_u_k, grown)
        links = links_of(region.still_nodes(u), own, p, region.settings.merging)
        for n in np.flatnonzero(links.kind != NONE).tolist():
            found = float(links.score[n]), (u, int(region.still(u).local_id[p.i[n]]))
            local_id = int(shapes.local_id[p.j[n]])
            best[local_id] = max(found, best.get(local_id, found))
    return {local_id: key for local_id, (_, key) in best.items()}


def follow(region: Region, moved: Collection[int], culled: Culled, written: Collection[int]) -> set[int]:
    """Write which instances the redundant local instances of chunks that moved belong to, and when those were seen that
    were not `written` anew; return their ids.
    """
    store = region.store
    rows = store.library.redundant.of(sorted(moved))
    owners = store.observations.owners(sorted(culled.like))
    store.observations.forget(row.key for row in rows if row.like not in owners)
    store.observations.set(Observation(owners[row.like], *row.key) for row in rows if row.like in owners)
    ids = sorted(set(owners.values()) - set(written))
    seen = {n: sightings(region, _members(region, n)) for n in ids}
    store.instances.put(s.on(i) for i in store.instances.of(ids) if (s := seen[i.id]) is not None)
    return set(ids)


def _members(region: Region, instance_id: int) -> list[Key]:
    group = region.store.library.members.group_of(instance_id)
    return [key for key in group if region.takes_part(key)]


def sightings(region: Region, group: Sequence[Key]) -> SeenSpan | None:
    """Return when a group is seen, with the redundant local instances that are like it."""
    sessions: dict[int, list[Key]] = {}
    for key in group:
        sessions.setdefault(region.store.chunks.get(key[0]).session_id, []).append(key)
    count, times = 0, list[float]()
    for session, keys in sessions.items():
        own = [runs_seen(key[0], region.frames_of(key)) for key in keys]
        seen = seen_together([*own, *map(region.store.library.redundant.seen_like, keys)])
        if len(seen.runs):
            count += int(np.diff(seen.runs).sum())
            ends = (seen.first, int(seen.runs[0, 0])), (seen.last, int(seen.runs[-1, 1]) - 1)
            times += [region.times_of(k).get((session, frame), 0.0) for k, frame in ends]
    return SeenSpan(count, min(times), max(times)) if times else None
