"""Local instances that add nothing to what others of their session, or later sessions, saw.

A camera that stays in one room comes to the same things again and again. As ORB-SLAM (IEEE T-RO 2015) culls keyframes
whose points enough other keyframes see, a local instance is redundant whose surface enough earlier chunks of its
session saw, as one thing or in pieces: no group is formed, weighed or derived with it, so that a chunk costs what is
new in it, not how often its place was seen (decisions 0113 and 0118). A redundant one counts among the observations of
the instance that it is like.

It is decided when a chunk settles, of what was settled before it; what was not redundant once stays so until enough
later sessions saw the instance again, and its surface: that is decided when a session ends. What changed is told of all
that sessions saw, those included (decision 0189).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from list3r.memory.change.ledger import ChangeLedger, Group, read_ledger
from list3r.memory.library.region import Region
from list3r.memory.merging.edges import NONE, links_of
from list3r.memory.merging.nodes import Nodes
from list3r.memory.overlap.pair_scores import Key, pair_scores
from list3r.memory.overlap.voxels import ChunkShapes, GrownCells, Ints, lies_on
from list3r.memory.records import Instance, Observation
from list3r.memory.runs import SeenRuns, runs_seen, seen_together
from list3r.memory.store.derived import LruCache
from list3r.memory.store.store import Store
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
        found = before
        if k in moved:
            found = _still_superseded(region, k, before)
            known_so = {row.key for row in found}
            found += [row for row in _redundant(region, k) if row.key not in known_so]
        found = [row for row in found if not before or row.key in known]
        found = [row for row in found if not links.forbids(row.key, row.like)]
        if found or before:
            every = len(found) == len(region.summaries[k].shapes.local_id)
            table.put(k, found, all_of_it=every)
            region.store.observations.forget({row.key for row in before} - {row.key for row in found})
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
    known, beside = _seen_by(region, k, earlier, settings.chunks)
    known &= ~np.isin(shapes.local_id, list(summary.motions))
    if not len(shapes.points) or not known[shapes.owner].any():
        return []
    like = _like(region, k, shapes.only(known), beside)
    return [
        RedundantInstance((k, n), like.get(n, (k, n)), frames.astype(np.int32))
        for n, frames, redundant in zip(shapes.local_id.tolist(), shapes.frames, known.tolist(), strict=True)
        if redundant
    ]


def _seen_by(region: Region, k: int, others: Sequence[int], enough: int) -> tuple[NDArray[np.bool_], list[int]]:
    """Return of which local instances of a chunk `enough` of some other chunks saw the surface, and those of them that
    saw most of the surface of one of these.
    """
    settings, shapes = region.settings.redundancy, region.summaries[k].shapes
    points = region.settled[k].S_graph_chunk.apply(shapes.points)
    total = np.bincount(shapes.owner, minlength=len(shapes.local_id))
    times, known, grown = np.zeros(len(points), np.int64), total == 0, region.store.derived.of(GrownCells)
    met: dict[int, Ints] = {}
    for u in others:
        row = region.rows[u]
        asked = ~known[shapes.owner] & (times < enough)
        asked &= ((points >= row.extent[0]) & (points <= row.extent[1])).all(axis=1)
        at = np.flatnonzero(asked)
        if not len(at):
            continue
        placed = row.S_graph_chunk.inverse().apply(points[at])
        seen = at[lies_on(placed, region.still(u), grown)]
        times[seen] += 1
        met[u] = np.bincount(shapes.owner[seen], minlength=len(total))
        often = np.bincount(shapes.owner, times >= enough, minlength=len(total))
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


def _still_superseded(region: Region, k: int, rows: Sequence[RedundantInstance]) -> list[RedundantInstance]:
    """Return those rows of a chunk whose local instances are where they lie now like those that they rest on."""
    later = {row.key[1]: row for row in rows if _session(region, row.like) > _session(region, row.key)}
    shapes = region.summaries[k].shapes
    there = sorted({row.like[0] for row in later.values() if region.takes_part(row.like)}.intersection(region.near(k)))
    like = _like(region, k, shapes.only(np.isin(shapes.local_id, list(later))), there) if there else {}
    return [replace(later[n], like=key) for n, key in like.items()]


def superseded(region: Region, groups: Iterable[Group], spared: Collection[Key]) -> list[RedundantInstance]:
    """Return the members of groups that need not be looked at any more: enough later sessions saw the instance again,
    and together the surface of the member; those `spared` stay.
    """
    settings, wanted = region.settings.redundancy, dict[int, dict[int, Group]]()
    later: dict[Key, Group] = {}
    for g in groups:
        sessions = sorted({_session(region, key) for key in g})
        if not settings.sessions or len(sessions) <= settings.sessions:
            continue
        kept = tuple(key for key in g if _session(region, key) >= sessions[-settings.sessions])
        later |= dict.fromkeys(kept, kept)
        for k, n in g:
            if (k, n) not in later and (k, n) not in spared:
                wanted.setdefault(k, {})[n] = kept
    return [row for k, of in wanted.items() for row in _superseded(region, k, of)]


def _superseded(region: Region, k: int, wanted: Mapping[int, Group]) -> list[RedundantInstance]:
    """Return the same of one chunk; its local instances that are asked about with the later members of their groups."""
    later = sorted({u for kept in wanted.values() for u, _ in kept}, reverse=True)
    known, beside = _seen_by(region, k, later, 1)
    shapes = region.summaries[k].shapes
    known &= np.isin(shapes.local_id, list(wanted))
    like = _like(region, k, shapes.only(known), beside) if known.any() else {}
    out = []
    for n, frames in zip(shapes.local_id[known].tolist(), compress(shapes.frames, known), strict=True):
        best = like.get(n)
        if best not in wanted[n]:
            best = max(wanted[n], key=lambda key: (region.seen_for(key), key))
        out.append(RedundantInstance((k, n), best, frames.astype(np.int32)))
    return out


def _session(region: Region, key: Key) -> int:
    return region.store.chunks.get(key[0]).session_id


def followers(store: Store, keys: Iterable[Key]) -> list[RedundantInstance]:
    """Return the redundant local instances that belong where some local instances do, each after what it is like."""
    old = store.library.redundant.superseded(keys)
    return [*old, *store.library.redundant.like([*keys, *(row.key for row in old)])]


def follow(region: Region, moved: Collection[int], culled: Culled, written: Collection[int]) -> set[int]:
    """Write which instances the redundant local instances of chunks that moved belong to, and when those were seen that
    were not `written` anew; return their ids.
    """
    store = region.store
    rows = store.library.redundant.of(sorted(moved))
    owners = store.observations.owners(sorted({*culled.like, *(row.like for row in rows if row.like != row.key)}))
    store.observations.forget(row.key for row in rows if row.like not in owners)
    store.observations.set(Observation(owners[row.like], *row.key) for row in rows if row.like in owners)
    ids = sorted(set(owners.values()) - set(written))
    ledger = (read_ledger(store, store.chunks.all()) if ids else None) or ChangeLedger(0)
    seen = {n: sightings(region, ledger.current(_members(region, n))) for n in ids}
    store.instances.put(s.on(i) for i in store.instances.of(ids) if (s := seen[i.id]) is not None)
    return set(ids)


def _members(region: Region, instance_id: int) -> list[Key]:
    group = region.store.library.members.group_of(instance_id)
    return [key for key in group if region.takes_part(key)]


class _EarlierCache(LruCache[Key, tuple[int, dict[int, SeenRuns]]]):
    """By the local instance that they are like, with what tells when that holds."""

    def __init__(self) -> None:
        super().__init__(10_000)


def _seen_in_earlier(region: Region, key: Key) -> dict[int, SeenRuns]:
    """Return when those were seen, by session, that a local instance of a later one is looked at instead of."""
    redundant, kept = region.store.library.redundant, region.store.derived.of(_EarlierCache)
    redundant.chunks()
    found = kept.get(key)
    if found is None or found[0] != redundant.turned:
        parts: dict[int, list[SeenRuns]] = {}
        for row in redundant.superseded([key]):
            own = [runs_seen(row.key[0], row.frames), redundant.seen_like(row.key)]
            parts.setdefault(_session(region, row.key), []).extend(own)
        found = kept.put(key, (redundant.turned, {session: seen_together(seen) for session, seen in parts.items()}))
    return found[1]


def sightings(region: Region, group: Sequence[Key]) -> SeenSpan | None:
    """Return when a group is seen, with the redundant local instances that are like it."""
    redundant = region.store.library.redundant
    sessions: dict[int, list[SeenRuns]] = {}
    for key in group:
        parts = sessions.setdefault(_session(region, key), [])
        parts += [runs_seen(key[0], region.frames_of(key)), redundant.seen_like(key)]
        for session, seen in _seen_in_earlier(region, key).items():
            sessions.setdefault(session, []).append(seen)
    count, times = 0, list[float]()
    for session, parts in sessions.items():
        seen = seen_together(parts)
        if len(seen.runs):
            count += int(np.diff(seen.runs).sum())
            ends = (seen.first, int(seen.runs[0, 0])), (seen.last, int(seen.runs[-1, 1]) - 1)
            times += [region.times_of(k).get((session, frame), 0.0) for k, frame in ends]
    return SeenSpan(count, min(times), max(times)) if times else None
