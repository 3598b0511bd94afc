"""What a derivation reads of chunks: settled poses, shapes, overlaps and links, each once, when first asked for."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import takewhile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.memory.change.detection import across_sessions
from list3r.memory.change.free_space_carving import FreeSpaceCarving
from list3r.memory.errors import MemoryFileError
from list3r.memory.geometry import Array, Sim3
from list3r.memory.library.rows import pack_scores, unpack_scores
from list3r.memory.library.rules import ConsolidationSettings, World
from list3r.memory.library.settled_poses import extent_of, neighbours
from list3r.memory.merging.edges import Links, links_of
from list3r.memory.merging.movers import PlacedChunks, Tracks, without_moving
from list3r.memory.merging.nodes import Nodes
from list3r.memory.overlap.pair_scores import Key, Numbering, PairScores, pair_scores
from list3r.memory.overlap.summaries import ChunkSummary, Summaries
from list3r.memory.overlap.voxels import ChunkShapes, GrownCells, Ints
from list3r.memory.records import ChunkRow, MotionTrack
from list3r.memory.store.derived import KEPT_TURNS, LruCache
from list3r.memory.store.store import Store
from list3r.memory.store.tables.library import RedundantInstance, SettledRow

_KEPT = 3000
"""Pairs of chunks whose links are kept: a walk that stays in one room comes to the same pairs again. They take some
3 kB each."""


@dataclass(frozen=True)
class DirtySet:
    """What has to be derived anew; the whole memory is one case."""

    chunks: frozenset[int]
    """Chunks all of whose local instances are looked at again."""
    moved: frozenset[int]
    """Those of them that are new or lie elsewhere, so that their overlaps are measured anew."""
    before: Mapping[int, SettledRow]
    """Where chunks that moved lay at the last derivation."""
    edited: frozenset[Key]
    """Local instances named by edits since the last derivation."""
    whole: bool
    """Whether these are all chunks, so that what none of them names is removed."""


@dataclass(frozen=True)
class _LinkedPair:
    """A pair of chunks, valid as long as neither is settled anew."""

    rows: tuple[SettledRow, SettledRow]
    stamp: tuple[int, bytes]
    scores: PairScores
    links: Links


class PairCache(LruCache[tuple[int, int], _LinkedPair]):
    """Pairs of chunks by their ids."""

    def __init__(self) -> None:
        super().__init__(_KEPT, turns=KEPT_TURNS)


class _Chunks(dict[int, SettledRow]):
    """Settled chunks by id. Raises `MemoryFileError` for one that a file speaks of and does not have."""

    def __init__(self, path: Path, rows: Mapping[int, SettledRow]) -> None:
        super().__init__(rows)
        self._path = path

    def __missing__(self, chunk_id: int) -> SettledRow:
        raise MemoryFileError(
            f"{self._path} refers to chunk {chunk_id}, which is neither placed nor marked as redundant; "
            f"run `list3r verify {self._path}`, `list3r repair {self._path}` saves what is sound"
        )


class Region:
    """The chunks of a memory as one derivation sees them."""

    def __init__(self, store: Store, summaries: Summaries, world: World, settings: ConsolidationSettings) -> None:
        self.store, self.world, self.settings = store, world, settings
        self.summaries = summaries
        self.settled = _Chunks(store.path, store.library.settled.all())
        """The settled chunks by id."""
        redundant = store.library.redundant.chunks()
        self.rows = _Chunks(store.path, {k: r for k, r in self.settled.items() if k not in redundant})
        """Those of them that are not redundant as a whole."""
        if self.settled and not self.rows:
            file = store.path
            raise MemoryFileError(f"every chunk of {file} is marked as redundant; `list3r repair {file}` fixes that")
        self._extents: Array | None = None
        self._T_world_graph = store.facts.S_world_graph
        self._carving = FreeSpaceCarving(store, settings.changes.visibility)
        self.has_motion = store.local_instances.any_dynamic()
        """Whether any local instance was seen moving."""
        self._summary: dict[int, ChunkSummary] = {}
        self._poses: dict[int, Sim3] = {}
        self._marks: dict[int, bytes] = {}
        self._nodes: dict[int, Nodes] = {}
        self._still: dict[int, ChunkShapes] = {}
        self._still_nodes: dict[int, Nodes] = {}
        self._times: dict[int, dict[tuple[int, int], float]] = {}
        self._pairs: dict[tuple[int, int], _LinkedPair] = {}
        self._paired: set[int] = set()
        self._scores: dict[tuple[int, int], PairScores] = {}
        self._linked: tuple[frozenset[tuple[int, int]], tuple[Numbering, Links]] | None = None

    # ------------------------------------------------------------------ one chunk

    def summary(self, chunk_id: int) -> ChunkSummary:
        """Return the summary of what takes part of a chunk: its local instances that are not redundant."""
        if chunk_id not in self._summary:
            left_out = frozenset(row.key[1] for row in self.store.library.redundant.of([chunk_id]))
            self._summary[chunk_id] = self.summaries.without(chunk_id, left_out)
        return self._summary[chunk_id]

    def takes_part(self, key: Key) -> bool:
        """Return whether there is such a local instance, and it is not redundant."""
        return key[0] in self.rows and key[1] in self.shapes(key[0]).local_id

    def shapes(self, chunk_id: int) -> ChunkShapes:
        """Return the local instances of a chunk."""
        return self.summary(chunk_id).shapes

    def still(self, chunk_id: int) -> ChunkShapes:
        """Return those of them that do not move."""
        if chunk_id not in self._still:
            summary = self.summary(chunk_id)
            moving = np.isin(summary.shapes.local_id, list(summary.motions))
            self._still[chunk_id] = summary.shapes.only(~moving) if moving.any() else summary.shapes
        return self._still[chunk_id]

    def keys_of(self, chunk_ids: Iterable[int]) -> set[Key]:
        """Return all local instances of some chunks."""
        return {(k, n) for k in chunk_ids for n in self.shapes(k).local_id.tolist()}

    def frames_of(self, key: Key) -> Ints:
        """Return Frame.index of the frames in which a local instance is seen. Shape (V,)."""
        shapes = self.shapes(key[0])
        return shapes.frames[int(np.searchsorted(shapes.local_id, key[1]))]

    def seen_for(self, key: Key) -> int:
        """Return in how many frames of the recording a local instance, even a redundant one, is seen, passed over ones
        included.
        """
        shapes = self.summaries[key[0]].shapes
        return shapes.seen_for(int(np.searchsorted(shapes.local_id, key[1])))

    def pose(self, chunk_id: int) -> Sim3:
        """Return S_world_chunk where the chunk is settled."""
        if chunk_id not in self._poses:
            self._poses[chunk_id] = self._T_world_graph @ self.settled[chunk_id].S_graph_chunk
        return self._poses[chunk_id]

    def mark(self, chunk_id: int) -> bytes:
        """Return what tells apart what a chunk measured and where it is settled."""
        if chunk_id not in self._marks:
            crc = np.int64(self.store.chunks.checksum(chunk_id))
            self._marks[chunk_id] = crc.tobytes() + self.pose(chunk_id).as_matrix().tobytes()
        return self._marks[chunk_id]

    def pose_before(self, row: SettledRow) -> Sim3:
        """Return S_world_chunk of where a chunk was settled before."""
        return self._T_world_graph @ row.S_graph_chunk

    def settled_chunk(self, chunk_id: int) -> ChunkRow:
        """Return the row of a chunk, with its settled pose."""
        return replace(self.store.chunks.get(chunk_id), S_world_chunk=self.pose(chunk_id))

    def times_of(self, chunk_id: int) -> dict[tuple[int, int], float]:
        """Return seconds by (session id, Frame.index) of the frames in the span of a chunk."""
        if chunk_id not in self._times:
            self._times[chunk_id] = self.store.frames.times(self.store.chunks.get(chunk_id))
        return self._times[chunk_id]

    def near(self, chunk_id: int, here: SettledRow | None = None) -> list[int]:
        """Return the chunks that lie near a chunk, itself among them; `here` if not where it is settled."""
        if self._extents is None:
            self._extents = np.array([r.extent for r in self.rows.values()]).reshape(-1, 2, 3)
        return neighbours(self.rows, chunk_id, here or self.settled[chunk_id], self._extents)

    def look_again(self, chunk_id: int) -> None:
        """Take note that others of a chunk's local instances are redundant than before."""
        for kept in (self._summary, self._nodes, self._still, self._still_nodes, self.rows):
            kept.pop(chunk_id, None)
        self._extents = None
        if chunk_id in self.store.library.redundant.chunks():
            return
        row = self.settled[chunk_id]
        row = replace(row, extent=extent_of(self.summary(chunk_id), row.S_graph_chunk))
        self.store.library.settled.put({chunk_id: row})
        self.settled[chunk_id] = row
        self.rows = _Chunks(self.store.path, dict(sorted({**self.rows, chunk_id: row}.items())))

    def supersede(self, instances: Sequence[RedundantInstance]) -> set[Key]:
        """Leave out from now on local instances that later sessions saw again; return those of which much lay on one
        of these chunks, see `_much_on`.
        """
        library, gone = self.store.library, dict[int, list[int]]()
        for row in instances:
            gone.setdefault(row.key[0], []).append(row.key[1])
        position, dropped, empty = dict[int, Ints](), dict[int, NDArray[np.bool_]](), set[int]()
        for k, local_ids in gone.items():
            shapes = self.shapes(k)
            kept = ~np.isin(shapes.local_id, local_ids)
            position[k] = np.where(kept, np.cumsum(kept) - 1, -1)
            dropped[k] = library.settled.dropped(k, len(shapes.points))[kept[shapes.owner]]
            empty |= set() if kept.any() else {k}
        stored = library.overlaps.all(sorted(gone))
        known = {p: self._read_scores(p, blob) for p, blob in stored.items()}
        left = {key for pair, p in known.items() for key in self._much_on(pair, p)}
        found = {pair: p.renumbered(*map(position.get, pair)) for pair, p in known.items()}
        library.overlaps.drop(p for p in stored if not empty.isdisjoint(p))
        library.overlaps.put({p: pack_scores(x) for p, x in found.items() if empty.isdisjoint(p)})
        library.redundant.supersede(instances, empty)
        library.members.drop(row.key for row in instances)
        for k in gone:
            self.look_again(k)
        library.settled.set_dropped({k: bits for k, bits in dropped.items() if k not in empty})
        self._pairs.clear()
        self._paired.clear()
        self._scores.clear()
        self._linked = None
        return left

    def components(self, keys: Iterable[Key]) -> dict[int, int]:
        """Return the connected component of each chunk that has one of these local instances."""
        return {k: self.rows[k].component for k in {k for k, _ in keys}}

    # ------------------------------------------------------------------ pairs of chunks

    def measure_overlaps(self, dirty: DirtySet) -> set[Key]:
        """Write the overlaps of dirty chunks, measured anew where one of the two has moved; return the local instances
        of which much lay on another chunk by what was written before, see `_much_on`.
        """
        stored = self.store.library.overlaps.all(sorted(dirty.chunks))
        near = {(min(k, n), max(k, n)) for k in dirty.chunks for n in self.near(k)}
        kept = {p for p in near if p in stored and dirty.moved.isdisjoint(p)}
        fresh = {p: pack_scores(self.score(*p)) for p in sorted(near - kept)}
        self._scores.clear()
        self.store.library.overlaps.drop(stored.keys() - near)
        self.store.library.overlaps.put(fresh)
        left = stored.keys() - kept
        return {key for pair in left for key in self._much_on(pair, self._read_scores(pair, stored[pair]))}

    def _much_on(self, pair: tuple[int, int], p: PairScores) -> list[Key]:
        """Return the local instances of a pair of chunks of which most lies on one of the other chunk, or the other
        way round, and those that it saw.
        """
        s, out = self.settings.evidence, list[Key]()
        most = np.maximum(p.i_on_j, p.j_on_i) >= s.swallowed
        for k, at, share in zip(pair, (p.i, p.j), (p.i_on_j, p.j_on_i), strict=True):
            over = np.flatnonzero(np.bincount(at, share) >= s.covered)
            out += [(k, int(n)) for n in self.shapes(k).local_id[np.concatenate([at[most], over])]]
        return out

    def _read_scores(self, pair: tuple[int, int], blob: bytes) -> PairScores:
        """Return the scores of a pair of chunks. Raises `MemoryFileError` where they name what is not there."""
        p = unpack_scores(blob)
        for chunk_id, rows in zip(pair, (p.i, p.j), strict=True):
            if len(rows) and not 0 <= rows.min() <= rows.max() < len(self.shapes(chunk_id).local_id):
                file = self.store.path
                raise MemoryFileError(
                    f"overlaps of chunks {pair[0]} and {pair[1]} name local instances that chunk {chunk_id} does not "
                    f"have; run `list3r verify {file}`, `list3r repair {file}` saves what is sound"
                )
        return p

    def score(self, u: int, v: int) -> PairScores:
        """Return how the local instances of two chunks meet where the chunks are settled."""
        if (u, v) not in self._scores:
            a, b = self.settled[u].S_graph_chunk, self.settled[v].S_graph_chunk
            S_u_v = a.inverse() @ b if u != v else Sim3.identity()
            grown = self.store.derived.of(GrownCells)
            self._scores[u, v] = pair_scores(self.shapes(u), self.shapes(v), S_u_v, grown)
        return self._scores[u, v]

    def pairs_of(self, chunk_ids: Iterable[int]) -> dict[tuple[int, int], PairScores]:
        """Return the scores of all pairs of which one is among these chunks, in order."""
        wanted = set(chunk_ids)
        missing = sorted(wanted - self._paired)
        for pair in self.store.library.overlaps.pairs(missing) if missing else ():
            if pair not in self._pairs:
                self._pairs[pair] = self._linked_pair(pair)
        self._paired |= wanted
        return {p: self._pairs[p].scores for p in sorted(self._pairs) if p[0] in wanted or p[1] in wanted}

    def _linked_pair(self, pair: tuple[int, int]) -> _LinkedPair:
        kept = self.store.derived.of(PairCache)
        rows, stamp = (self.rows[pair[0]], self.rows[pair[1]]), self.world.stamp
        found = kept.get(pair)
        if found is None or any(a is not b for a, b in zip(found.rows, rows, strict=True)) or found.stamp != stamp:
            shapes = {k: self.shapes(k) for k in pair}
            known = {pair: self._read_scores(pair, self.store.library.overlaps.get(pair))}
            known = without_moving(known, shapes, self.motions(pair))
            graph = {k: self.rows[k].S_graph_chunk for k in pair}
            scores = across_sessions(known, shapes, graph, self._carving, self.settings.changes)[pair]
            u, v = (self.nodes_of(k) for k in pair)
            found = kept.put(pair, _LinkedPair(rows, stamp, scores, links_of(u, v, scores, self.settings.merging)))
        return found

    def links_of(self, pairs: Collection[tuple[int, int]]) -> tuple[Numbering, Links]:
        """Return what argues for local instances of pairs of chunks being one instance, and their numbers."""
        asked = frozenset(pairs)
        if self._linked is None or self._linked[0] != asked:
            numbering = Numbering({k: self.shapes(k) for pair in asked for k in pair})
            start = numbering.start
            parts = [(start[u], start[v], self._pairs[u, v].links) for u, v in sorted(asked)]
            self._linked = asked, (numbering, Links.join(parts))
        return self._linked[1]

    def links_inside(self, chunk_ids: Collection[int]) -> dict[tuple[int, int], Links]:
        """Return the links of the pairs of which both are among these chunks."""
        pairs = (p for p in self.pairs_of(chunk_ids) if p[0] in chunk_ids and p[1] in chunk_ids)
        return {p: self._pairs[p].links for p in pairs}

    def nodes_of(self, chunk_id: int) -> Nodes:
        """Return the table of a chunk's local instances that merging looks at."""
        if chunk_id not in self._nodes:
            self._nodes[chunk_id] = Nodes.of([self.shapes(chunk_id)], {chunk_id: self.pose(chunk_id)})
        return self._nodes[chunk_id]

    def still_nodes(self, chunk_id: int) -> Nodes:
        """Return the same of those that do not move."""
        if chunk_id not in self._still_nodes:
            self._still_nodes[chunk_id] = Nodes.of([self.still(chunk_id)], {chunk_id: self.pose(chunk_id)})
        return self._still_nodes[chunk_id]

    # ------------------------------------------------------------------ motion

    def motions(self, chunk_ids: Iterable[int]) -> dict[Key, MotionTrack | None]:
        """Return the local instances of chunks that move, and where they were."""
        return {(k, n): track for k in chunk_ids for n, track in self.summary(k).motions.items()}

    def tracks(self, chunk_ids: Iterable[int]) -> Tracks:
        """Return the same with the times of the frames."""
        chunks = sorted(set(chunk_ids))
        return Tracks(self.motions(chunks), {f: t for k in chunks for f, t in self.times_of(k).items()})

    def placed(self, chunk_ids: Iterable[int]) -> PlacedChunks:
        """Return what is asked of chunks about what moves."""
        ids = list(chunk_ids)
        component = {k: self.rows[k].component for k in ids}
        return PlacedChunks({k: self.shapes(k) for k in ids}, {k: self.pose(k) for k in ids}, component)

    def near_in_time(self, chunk_ids: Collection[int]) -> set[int]:
        """Return the chunks seen so shortly before or after one of these that what moves may be the same."""
        order = sorted(
            self.rows, key=lambda k: (self.store.chunks.get(k).session_id, self.store.chunks.get(k).first_frame)
        )
        at = {k: n for n, k in enumerate(order)}
        out = set(chunk_ids)
        for k in chunk_ids:
            meets = partial(self._meet_in_time, k)
            out.update(takewhile(meets, order[: at[k]][::-1]), takewhile(meets, order[at[k] + 1 :]))
        return {k for k in out if any(self.rows[k].component == self.rows[j].component for j in chunk_ids)}

    def _meet_in_time(self, a: int, b: int) -> bool:
        """Return whether two chunks of one session lie so near in time that what moves may be the same."""
        if self.store.chunks.get(a).session_id != self.store.chunks.get(b).session_id:
            return False
        one, two = (list(self.times_of(k).values()) or [0.0] for k in (a, b))
        return max(min(two) - max(one), min(one) - max(two)) <= self.settings.moving.most_gap_s

    # ------------------------------------------------------------------ places

    def span_of(self, chunk_id: int) -> Array:
        """Return the box round the points and the cameras of a chunk, in the frame of the graph. Shape (2, 3)."""
        extent = self.settled[chunk_id].extent
        frames = [
            f.T_chunk_cam[:3, 3] for f in self.store.frames.of(self.store.chunks.get(chunk_id)) if f.state == "posed"
        ]
        if not frames:
            return extent
        at = self.settled[chunk_id].S_graph_chunk.apply(np.array(frames))
        return np.stack([np.minimum(extent[0], at.min(axis=0)), np.maximum(extent[1], at.max(axis=0))])

    def within_sight(self, chunk_ids: Iterable[int]) -> list[int]:
        """Return the chunks that the frames of these can tell about, and those whose frames can tell about these."""
        ids = sorted(self.settled)
        boxes = np.array([self.span_of(k) for k in ids])
        part = np.array([self.settled[k].component for k in ids])
        most_depth = self.settings.changes.visibility.most_depth_m
        depth = most_depth * self.world.unit / float(self._T_world_graph.scale)
        found = np.zeros(len(ids), bool)
        for k in chunk_ids:
            low, high = boxes[ids.index(k)]
            meet = np.all((boxes[:, 0] <= high + depth) & (boxes[:, 1] >= low - depth), axis=1)
            found |= meet & (part == self.settled[k].component)
        return [k for k, near in zip(ids, found, strict=True) if near and k in self.rows]
