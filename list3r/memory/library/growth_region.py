"""The local instances that new or moved chunks touch, and their groups, formed anew (`memory.growth` says why that
is enough).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from list3r.memory.change.detection import across_sessions
from list3r.memory.change.free_space import SeenThrough
from list3r.memory.change.ledger import Tale
from list3r.memory.geometry import Sim3
from list3r.memory.library.rows import pack_scores, unpack_scores
from list3r.memory.library.rules import ConsolidationSettings, World
from list3r.memory.library.settling import neighbours
from list3r.memory.merging.edges import NONE, Links, form_groups, links_of
from list3r.memory.merging.moving import Mover, Tracks, join_movers, tied_movers, without_moving
from list3r.memory.merging.nodes import Nodes
from list3r.memory.overlap.pair_scores import Key, Numbering, PairScores, pair_scores
from list3r.memory.overlap.summaries import Summaries
from list3r.memory.overlap.voxels import ChunkShapes
from list3r.memory.records import MergeDecision, MotionTrack
from list3r.memory.store.derived import LruCache
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import SettledRow

Group = tuple[Key, ...]
_KEPT = 6000
"""Pairs of chunks of which it is kept what argues for their local instances being one thing: a walk that stays in one
room comes to the same pairs again. They take some 3 kB each."""


@dataclass(frozen=True)
class _Pair:
    """A pair of chunks, as long as neither of the two is settled anew."""

    rows: tuple[SettledRow, SettledRow]
    stamp: int
    scores: PairScores
    links: Links


class PairCache(LruCache[tuple[int, int], _Pair]):
    """Pairs of chunks by their ids."""

    def __init__(self) -> None:
        super().__init__(_KEPT)


@dataclass(frozen=True)
class Occasion:
    """Why the library grows."""

    store: Store
    summaries: Summaries
    world: World
    settings: ConsolidationSettings
    tale: Tale
    """What stands of changes between sessions."""
    before: dict[int, SettledRow]
    """Where chunks were settled before that were asked about."""
    dirty: frozenset[int]
    """Chunks that are new or have moved."""
    spoken: frozenset[Key]
    """Local instances that an operator has spoken of since the library was derived."""


class Region:
    """What is touched, read as far as it is asked for."""

    def __init__(self, occasion: Occasion) -> None:
        store = occasion.store
        self._store, self._summaries, self._world, self._s = (
            store,
            occasion.summaries,
            occasion.world,
            occasion.settings,
        )
        self._dirty = sorted(occasion.dirty)
        self._spoken = occasion.spoken
        self._before = occasion.before
        self._tale = occasion.tale
        self._rows = store.settled()
        self._extents = np.array([r.extent for r in self._rows.values()])
        self._T_world_graph = Sim3.from_matrix(store.get_value("T_world_graph", np.eye(4).tolist()))
        self._word = store.constraints()
        self._seen_through = SeenThrough(store, self._s.changes.visibility)
        self._placed: dict[int, Sim3] = {}
        self._pairs: dict[tuple[int, int], _Pair] = {}
        self._paired: set[int] = set()
        self._linked: tuple[frozenset[tuple[int, int]], Numbering, Links] | None = None
        self._nodes: dict[int, Nodes] = {}
        self._left: set[Key] = set()
        """Local instances that lay on, or under, one of a chunk that has moved."""
        self._home: dict[Key, Group] = {}
        """The group of each local instance of the chunks that were looked up, as it is now."""
        self._old: dict[Key, Group] = {}
        """The same before."""
        self._old_shown: dict[Group, bool] = {}
        self._known: set[int] = set()
        self._moving = store.has_moving()
        self._movers: dict[Group, Mover] = {}
        self._spans: dict[int, tuple[float, float]] = {}

    # ------------------------------------------------------------------ what is known of chunks

    def _shapes(self, chunk_id: int) -> ChunkShapes:
        return self._summaries[chunk_id].shapes

    def _pose(self, chunk_id: int) -> Sim3:
        """Settled, in the world."""
        if chunk_id not in self._placed:
            self._placed[chunk_id] = self._T_world_graph @ self._rows[chunk_id].S_graph_chunk
        return self._placed[chunk_id]

    def _compare(self) -> None:
        """Score the pairs of the chunks that are new or moved with those near them, and forget the others of theirs."""
        stored = self._store.overlaps(self._dirty)
        fresh: dict[tuple[int, int], bytes] = {}
        for k in self._dirty:
            for other in neighbours(self._rows, k, None, self._extents):
                u, v = sorted((k, other))
                if (u, v) not in fresh:
                    S_u_v = self._rows[u].S_graph_chunk.inverse() @ self._rows[v].S_graph_chunk
                    S_u_v = S_u_v if u != v else Sim3.identity()
                    fresh[u, v] = pack_scores(pair_scores(self._shapes(u), self._shapes(v), S_u_v))
        self._store.drop_overlaps(stored.keys() - fresh.keys())
        self._store.put_overlaps(fresh)
        self._look_up({*self._dirty, *(k for pair in stored for k in pair)})
        for (u, v), blob in stored.items():
            p = unpack_scores(blob)
            most = np.maximum(p.i_on_j, p.j_on_i) >= self._s.evidence.swallowed
            self._left.update((u, int(self._shapes(u).local_id[i])) for i in p.i[most])
            self._left.update((v, int(self._shapes(v).local_id[j])) for j in p.j[most])

    def _pairs_of(self, chunks: Iterable[int]) -> dict[tuple[int, int], PairScores]:
        """Scores of all pairs of which one is among these chunks, in order."""
        wanted = set(chunks)
        missing = sorted(wanted - self._paired)
        for pair in self._store.overlapping(missing) if missing else ():
            if pair not in self._pairs:
                self._pairs[pair] = self._pair(pair)
        self._paired |= wanted
        return {p: self._pairs[p].scores for p in sorted(self._pairs) if p[0] in wanted or p[1] in wanted}

    def _pair(self, pair: tuple[int, int]) -> _Pair:
        """What is known of a pair, from the chunks before where that still holds."""
        kept = self._store.derived.of(PairCache)
        rows, stamp = (self._rows[pair[0]], self._rows[pair[1]]), self._world.stamp
        found = kept.get(pair)
        if found is None or any(a is not b for a, b in zip(found.rows, rows, strict=True)) or found.stamp != stamp:
            shapes = {k: self._shapes(k) for k in pair}
            known = {pair: unpack_scores(self._store.overlap(pair))}
            known = without_moving(known, shapes, self._motions(pair))
            graph = {k: self._rows[k].S_graph_chunk for k in pair}
            scores = across_sessions(known, shapes, graph, self._seen_through, self._s.changes)[pair]
            u, v = (self._nodes_of(k) for k in pair)
            found = kept.put(pair, _Pair(rows, stamp, scores, links_of(u, v, scores, self._s.merging)))
        return found

    def _numbered(self, chunks: Iterable[int]) -> Numbering:
        """The local instances of chunks, looked up."""
        chunks = set(chunks)
        self._look_up(chunks)
        return Numbering({k: self._shapes(k) for k in chunks})

    def _links(self, pairs: Collection[tuple[int, int]]) -> tuple[Numbering, Links]:
        """What argues for local instances of pairs of chunks being one thing."""
        asked = frozenset(pairs)
        if self._linked is None or self._linked[0] != asked:
            numbering = self._numbered(k for pair in asked for k in pair)
            start = numbering.start
            parts = [(start[u], start[v], self._pairs[u, v].links) for u, v in sorted(asked)]
            self._linked = asked, numbering, Links.join(parts)
        return self._linked[1:]

    def _look_up(self, chunks: Iterable[int]) -> None:
        """Read how the local instances of chunks were grouped before; new ones stand alone."""
        missing = sorted(set(chunks) - self._known)
        if not missing:
            return
        self._known.update(missing)
        found = self._store.members_in(missing)
        for first, shown in sorted({v for v in found.values()}):
            group = tuple(self._store.group_of(first))
            if group and group[0] not in self._old:
                self._old.update(dict.fromkeys(group, group))
                self._old_shown[group] = shown
                for key in group:
                    self._home.setdefault(key, group)
        for k in missing:
            for n in self._shapes(k).local_id.tolist():
                self._home.setdefault((k, n), ((k, n),))

    # ------------------------------------------------------------------ things that move

    def _motions(self, chunks: Iterable[int]) -> dict[Key, MotionTrack | None]:
        """The local instances of chunks that move."""
        return {(k, n): track for k in chunks for n, track in self._summaries[k].motions.items()}

    def _tracks(self, chunks: Iterable[int]) -> Tracks:
        chunks = sorted(set(chunks))
        times = {f: t for k in chunks for f, t in self._store.frame_times(self._store.chunk(k)).items()}
        return Tracks(self._motions(chunks), times)

    def _at_that_time(self, chunks: Collection[int]) -> set[int]:
        """Chunks seen so shortly before or after one of these that what moves may be the same."""
        rows = [c for c in self._store.chunks() if c.chunk_id in self._rows]
        rows.sort(key=lambda c: (c.session_id, c.first_frame))
        at = {c.chunk_id: n for n, c in enumerate(rows)}
        out = set(chunks)
        for k in chunks:
            low, high = self._span_s(k)
            for way in (range(at[k] - 1, -1, -1), range(at[k] + 1, len(rows))):
                for n in way:
                    other = self._span_s(rows[n].chunk_id)
                    far = max(other[0] - high, low - other[1]) > self._s.moving.most_gap_s
                    if far or rows[n].session_id != rows[at[k]].session_id:
                        break
                    out.add(rows[n].chunk_id)
        return {k for k in out if any(self._rows[k].component == self._rows[j].component for j in chunks)}

    def _span_s(self, chunk_id: int) -> tuple[float, float]:
        if chunk_id not in self._spans:
            times = list(self._store.frame_times(self._store.chunk(chunk_id)).values()) or [0.0]
            self._spans[chunk_id] = min(times), max(times)
        return self._spans[chunk_id]

    def _along(self, keys: Collection[Key], inside: Collection[Key]) -> set[Key]:
        """Local instances outside that one of these may be, because one of the two moves."""
        if not self._moving:
            return set()
        chunks = self._at_that_time({k for k, _ in keys})
        moving = self._motions(chunks)
        if not moving:
            return set()
        others = {(k, n) for k in chunks for n in self._shapes(k).local_id.tolist()} - set(inside)
        if moving.keys().isdisjoint(keys):
            others &= moving.keys()
        shapes, placed = {k: self._shapes(k) for k in chunks}, {k: self._pose(k) for k in chunks}
        return tied_movers(sorted(keys), sorted(others), shapes, placed, self._tracks(chunks), self._s.moving)

    def _mover(self, group: Group) -> Mover | None:
        """What is known of a group that moves."""
        if not self._moving or self._motions({k for k, _ in group}).keys().isdisjoint(group):
            return None
        if group not in self._movers:
            self._by_overlap(set(group))
        return self._movers.get(group)

    # ------------------------------------------------------------------ groups

    def _partition(self, seeds: Collection[Key] = ()) -> tuple[list[Group], list[MergeDecision]]:
        """The groups by overlap of all local instances that the chunks, or these seeds, touch, formed anew; and the
        decisions.
        """
        region = {(k, n) for k in self._dirty for n in self._shapes(k).local_id.tolist()}
        region |= {k for k in (*self._spoken, *seeds) if k[0] in self._rows}
        region = self._closed(region)
        region = self._closed(region | self._across(region, region) | self._along(region, region))
        while True:
            groups, decisions = self._by_overlap(region)
            joined = self._tale.joined(groups, self._components(region))[0]
            changed = {k for g in joined if self._has_changed(tuple(g)) for k in g}
            left = self._closed(self._across(changed, region) | self._along(changed, region)) - region
            if not left:
                return groups, decisions
            region |= left

    def _components(self, keys: Iterable[Key]) -> dict[int, int]:
        return {k: self._rows[k].component for k in {k for k, _ in keys}}

    def _closed(self, keys: Collection[Key]) -> set[Key]:
        """All local instances that were in one group with any of these."""
        self._look_up({k for k, _ in keys})
        return {m for key in keys for m in (*self._old.get(key, ()), key) if m[0] in self._rows}

    def _has_changed(self, group: Group) -> bool:
        spoken = not self._spoken.isdisjoint(group)
        return self._old.get(group[0]) != group or spoken or any(k in self._dirty for k, _ in group)

    def _across(self, keys: Collection[Key], inside: Collection[Key]) -> set[Key]:
        """Local instances outside that an edge ties to one of these."""
        numbering, links = self._links(self._pairs_of({k for k, _ in keys}))
        here, outside = numbering.flags(keys), ~numbering.flags(inside)
        tied = links.kind != NONE
        found = [y[tied & here[x] & outside[y]] for x, y in ((links.a, links.b), (links.b, links.a))]
        return {numbering.keys[n] for n in np.unique(np.concatenate(found))}

    def _nodes_of(self, chunk_id: int) -> Nodes:
        if chunk_id not in self._nodes:
            self._nodes[chunk_id] = Nodes.of([self._shapes(chunk_id)], {chunk_id: self._pose(chunk_id)})
        return self._nodes[chunk_id]

    def _by_overlap(self, region: Collection[Key]) -> tuple[list[Group], list[MergeDecision]]:
        """The groups of some local instances alone, and the decisions."""
        if not region:
            return [], []
        chunks = sorted({k for k, _ in region})
        inside = set(chunks)
        links = {p: self._pairs[p].links for p in self._pairs_of(chunks) if p[0] in inside and p[1] in inside}
        apart = [((k, int(a)), (k, int(b))) for k in chunks for a, b in self._summaries[k].cannot_link]
        tables = {k: self._nodes_of(k) for k in chunks}
        found_groups, decisions = form_groups(tables, links, region, apart, self._s.merging, self._word)
        components = {k: self._rows[k].component for k in chunks}
        movers: dict[Key, Mover] = {}
        motions = self._motions(chunks) if self._moving else {}
        if motions:
            shapes, placed = {k: self._shapes(k) for k in chunks}, {k: self._pose(k) for k in chunks}
            apart, tracks = apart + self._word.pairs_apart(motions), self._tracks(chunks)
            found_groups, movers, joins = join_movers(
                found_groups, shapes, placed, components, apart, tracks, self._s.moving
            )
            decisions = decisions + joins
        joined, movers = self._word.joined(found_groups, components, movers)
        self._movers |= {tuple(g): movers[g[0]] for g in joined if g[0] in movers}
        return [tuple(g) for g in joined], decisions
