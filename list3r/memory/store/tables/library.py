"""What consolidation goes on with when the next chunk comes: where chunks settled, how they overlap, who is grouped.

All of it follows from what was measured and where chunks lie, and may be lost: consolidation then derives the library
as a whole.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import Sim3
from list3r.memory.records import Shape
from list3r.memory.runs import SeenRuns, runs_seen, seen_together
from list3r.memory.store.connection import Connection
from list3r.memory.store.derived import LruCache
from list3r.memory.store.rows.columns import Columns, joined, nested
from list3r.memory.store.rows.table import Table, batches

Key = tuple[int, int]
"""(chunk id, local id)."""


@dataclass(frozen=True)
class SettledRow:
    """Where a chunk lies for the purpose of consolidation."""

    component: int
    S_graph_chunk: Sim3
    extent: Annotated[NDArray[np.float64], Shape((2, 3))]
    """Box round its points in the frame of the graph, grown by half of what lies near. Shape (2, 3)."""
    carried: Annotated[NDArray[np.float64], Shape((4,))] = field(default_factory=lambda: np.zeros(4))
    """How far it has shifted (metres) and turned (degrees) against others, its up has turned (degrees), and it has
    turned in the world (degrees), since what was derived of it was derived. Shape (4,)."""


@dataclass(frozen=True)
class _OfChunk:
    chunk_id: int
    settled: SettledRow


@dataclass(frozen=True)
class Anchor:
    """The chunk that an instance is attached to."""

    chunk_id: int
    S_exact_settled: Sim3
    """World, as its row was written: from where the chunk is settled to where it lies."""


@dataclass(frozen=True)
class Overlap:
    """How the local instances of two chunks overlap."""

    u: int
    """Chunk id."""
    v: int
    """Chunk id, v >= u."""
    scores: bytes
    """Packed, see `memory.overlap.pair_scores`."""


@dataclass(frozen=True)
class GroupMember:
    """A local instance in its group, which is named by its first member."""

    key: Key
    first: Key
    shown: bool


@dataclass(frozen=True)
class RedundantInstance:
    """A local instance whose surface enough other chunks of its session saw, or enough later sessions."""

    key: Key
    like: Key
    """The local instance of another chunk that is the same instance; its own key where there is none. If it is of a
    later session, that saw it again."""
    frames: Annotated[NDArray[np.int32], Shape((-1,))]
    """Frame.index of the frames in which it is seen. Shape (V,)."""


_KEY = joined(("chunk_id", "local_id"), ("key",), tuple, lambda *key: (key,))
_FIRST = joined(("first_chunk", "first_local"), ("first",), tuple, lambda *key: (key,))


class Settled:
    """The table of where chunks settled. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        columns = Columns.of(_OfChunk, nested("settled", Columns.of(SettledRow)))
        self._rows = Table(connection, "settled", columns, "chunk_id")
        self._known: dict[int, SettledRow] | None = None
        self._version = -1
        connection.on_forget(self.forget)

    def all(self) -> Mapping[int, SettledRow]:
        """Return all settled chunks by id; not to be changed."""
        version = self._connection.data_version
        if self._known is None or version != self._version:
            self._known, self._version = {row.chunk_id: row.settled for row in self._rows.all()}, version
        return self._known

    def put(self, rows: Mapping[int, SettledRow]) -> None:
        """Settle chunks, or settle them again; which of their points were dropped is forgotten."""
        known = {**self.all(), **rows}
        self._rows.put((_OfChunk(k, row) for k, row in rows.items()), dropped=b"")
        self._known = dict(sorted(known.items()))

    def carry(self, rows: Mapping[int, SettledRow]) -> None:
        """Settle chunks where they were carried to; which of their points were dropped still holds."""
        known = {**self.all(), **rows}
        columns = Columns.of(SettledRow)
        values = [(*held, k) for k, held in zip(rows, columns.rows(list(rows.values())), strict=True)]
        names = ", ".join(f"{name} = ?" for name in columns.names)
        self._connection.execute_many(f"UPDATE settled SET {names} WHERE chunk_id = ?", values)
        self._known = dict(sorted(known.items()))

    def rest(self) -> None:
        """Forget how far chunks were carried, for all is derived again where they lie."""
        self.carry({k: replace(row, carried=np.zeros(4)) for k, row in self.all().items() if row.carried.any()})

    def drop(self, chunk_id: int) -> None:
        """Forget where a chunk settled."""
        if self._rows.delete("chunk_id = ?", (int(chunk_id),)):
            self.forget()

    def dropped(self, chunk_id: int, count: int) -> NDArray[np.bool_]:
        """Return which of a chunk's representative points belong to something else. Shape (count,)."""
        rows = self._connection.rows("SELECT dropped FROM settled WHERE chunk_id = ?", (chunk_id,))
        bits = np.frombuffer(rows[0][0], np.uint8) if rows else np.zeros(0, np.uint8)
        out = np.zeros(count, dtype=bool)
        found = np.unpackbits(bits)[:count].astype(bool)
        out[: len(found)] = found
        return out

    def set_dropped(self, dropped: Mapping[int, NDArray[np.bool_]]) -> None:
        """Say which representative points of chunks belong to something else."""
        packed = [(np.packbits(v).tobytes() if v.any() else b"", k) for k, v in dropped.items()]
        self._connection.execute_many("UPDATE settled SET dropped = ? WHERE chunk_id = ?", packed)

    def forget(self) -> None:
        """Read the rows again when they are next asked for."""
        self._known = None


class Overlaps:
    """The table of how pairs of chunks overlap. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._rows = Table(connection, "overlaps", Columns.of(Overlap), "u, v")

    def all(self, chunk_ids: Sequence[int] | None = None) -> dict[Key, bytes]:
        """Return how pairs of chunks (u <= v) overlap, those of which one is among these, or all, in order."""
        if chunk_ids is None:
            rows = self._rows.all()
        else:
            rows = [row for column in ("u", "v") for row in self._rows.among(column, chunk_ids)]
        return dict(sorted(((row.u, row.v), row.scores) for row in rows))

    def pairs(self, chunk_ids: Sequence[int]) -> list[Key]:
        """Return the pairs of chunks (u <= v) that overlap, of which one is among these."""
        out: set[Key] = set()
        for part, marks in batches(chunk_ids):
            for column in ("u", "v"):
                found = self._connection.rows(f"SELECT u, v FROM overlaps WHERE {column} IN ({marks})", part)
                out.update((u, v) for u, v in found)
        return sorted(out)

    def get(self, pair: Key) -> bytes:
        """Return how one pair of chunks overlaps, which must be known."""
        return bytes(self._rows.values("scores", "u = ? AND v = ?", pair)[0])

    def put(self, overlaps: Mapping[Key, bytes]) -> None:
        """Write how pairs of chunks overlap."""
        self._rows.put(Overlap(*pair, scores) for pair, scores in overlaps.items())

    def drop(self, pairs: Iterable[Key]) -> None:
        """Forget pairs of chunks."""
        self._connection.execute_many("DELETE FROM overlaps WHERE u = ? AND v = ?", list(pairs))


class GroupMembers:
    """The table of which local instances are grouped. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._rows = Table(connection, "members", Columns.of(GroupMember, _KEY, _FIRST), "chunk_id, local_id")

    def of(self, chunk_ids: Sequence[int]) -> dict[Key, GroupMember]:
        """Return the local instances of some chunks, by key."""
        return {row.key: row for row in self._rows.among("chunk_id", chunk_ids)}

    def group(self, first: Key) -> list[Key]:
        """Return all members of a group, in order; none where there is no such group."""
        return [row.key for row in self._rows.all("first_chunk = ? AND first_local = ?", first)]

    def group_of(self, instance_id: int) -> list[Key]:
        """Return all members of the group that is an instance, in order; none where there is no such instance."""
        query = (
            "SELECT m.first_chunk, m.first_local FROM observations o JOIN members m USING (chunk_id, local_id) "
            "WHERE o.instance = ? ORDER BY o.chunk_id, o.local_id LIMIT 1"
        )
        return [key for first in self._connection.rows(query, (instance_id,)) for key in self.group(first)]

    def put(self, members: Iterable[GroupMember]) -> None:
        """Write of local instances which group they are in; they leave those that they were in."""
        self._rows.put(members)

    def drop(self, keys: Iterable[Key]) -> None:
        """Take local instances out of their groups."""
        self._connection.execute_many("DELETE FROM members WHERE chunk_id = ? AND local_id = ?", list(keys))

    def hidden_groups(self) -> int:
        """Return how many groups are not shown."""
        return self._rows.count("shown = 0 AND chunk_id = first_chunk AND local_id = first_local")


_KEPT_BYTES = 4 << 20


class _SeenCache(LruCache[Key, SeenRuns]):
    """By the local instance that they are like."""

    def __init__(self) -> None:
        super().__init__(_KEPT_BYTES, lambda seen: 200 + seen.runs.nbytes)


_LIKE = joined(("like_chunk", "like_local"), ("like",), tuple, lambda *key: (key,))
_SESSION = "(SELECT session_id FROM chunks c WHERE c.chunk_id = redundant.{})"
_OTHER_SESSION = f"({_SESSION.format('chunk_id')} != {_SESSION.format('like_chunk')})"


class Redundant:
    """The table of redundant local instances. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        columns = Columns.of(RedundantInstance, _KEY, _LIKE)
        self._rows = Table(connection, "redundant", columns, "chunk_id, local_id")
        self._known: set[int] | None = None
        self._superseding: set[Key] | None = None
        self._seen = _SeenCache()
        self.turned = 0
        """Grows when rows of chunks that had any are others."""
        self._version = -1
        connection.on_forget(self.forget)

    def chunks(self) -> Set[int]:
        """Return the ids of the chunks of which no local instance is in a group; not to be changed."""
        version = self._connection.data_version
        if self._known is None or version != self._version:
            grouped = "SELECT 1 FROM members m WHERE m.chunk_id = r.chunk_id"
            rows = self._connection.rows(f"SELECT DISTINCT chunk_id FROM redundant r WHERE NOT EXISTS ({grouped})")
            self._known, self._version = {k for (k,) in rows}, version
            self._turn()
        return self._known

    def any(self) -> bool:
        """Return whether any local instance is redundant."""
        return bool(self._connection.rows("SELECT EXISTS (SELECT 1 FROM redundant)")[0][0])

    def partly(self) -> Set[int]:
        """Return the ids of the chunks of which some local instances are redundant and others are not."""
        rows = self._connection.rows("SELECT DISTINCT chunk_id FROM redundant")
        return {k for (k,) in rows} - self.chunks()

    def compared(self) -> list[Key]:
        """Return the pairs of chunks of which one has a redundant local instance that is like one of the other."""
        return self._connection.rows("SELECT DISTINCT chunk_id, like_chunk FROM redundant ORDER BY 1, 2")

    def of(self, chunk_ids: Sequence[int]) -> list[RedundantInstance]:
        """Return the redundant local instances of some chunks, none of which is in a group, in no order."""
        grouped = "SELECT 1 FROM members m WHERE m.chunk_id = redundant.chunk_id AND m.local_id = redundant.local_id"
        return self._rows.among("chunk_id", chunk_ids, f"NOT EXISTS ({grouped})")

    def like(self, keys: Iterable[Key], after: int = 0) -> list[RedundantInstance]:
        """Return those of chunks `after` one that are the same instance as one of these local instances, in order, all
        of the same session.
        """
        where = f"like_chunk = ? AND like_local = ? AND chunk_id > ? AND NOT {_OTHER_SESSION}"
        return [row for key in keys for row in self._rows.all(where, (*key, after))]

    def superseded(self, keys: Iterable[Key] | None = None) -> list[RedundantInstance]:
        """Return those that one of these local instances, or any, of a later session saw again."""
        if keys is None:
            return self._rows.all(_OTHER_SESSION)
        self.chunks()
        if self._superseding is None:
            query = f"SELECT DISTINCT like_chunk, like_local FROM redundant WHERE {_OTHER_SESSION}"
            self._superseding = set(self._connection.rows(query))
        where = f"like_chunk = ? AND like_local = ? AND {_OTHER_SESSION}"
        return [row for key in keys if key in self._superseding for row in self._rows.all(where, key)]

    def seen_like(self, key: Key) -> SeenRuns:
        """Return when those of the same session are seen that are the same instance as a local instance."""
        self.chunks()
        return self._seen.get(key) or self._seen.put(
            key, seen_together([runs_seen(row.key[0], row.frames) for row in self.like([key])])
        )

    def put(self, chunk_id: int, instances: Sequence[RedundantInstance], *, all_of_it: bool) -> None:
        """Say which local instances of a chunk are redundant, and whether these are `all_of_it`."""
        known = set(self.chunks())
        if self._rows.delete("chunk_id = ?", (chunk_id,)):
            self._turn()
        self._rows.add_all(instances)
        for row in instances:
            if (seen := self._seen.get(row.like)) is not None:
                self._seen.put(row.like, seen_together([seen, runs_seen(row.key[0], row.frames)]))
        self._known = known | {chunk_id} if all_of_it else known - {chunk_id}

    def supersede(self, instances: Sequence[RedundantInstance], chunk_ids: Collection[int]) -> None:
        """Add local instances that later sessions saw again, and those that rested on them, which now rest on what
        these are like; `chunk_ids` are chunks of which nothing is left.
        """
        known = set(self.chunks())
        self._rows.add_all(instances)
        to = "UPDATE redundant SET like_chunk = ?, like_local = ? WHERE like_chunk = ? AND like_local = ?"
        moved = [(*row.like, *row.key) for row in instances if row.like != row.key]
        self._connection.execute_many(f"{to} AND {_OTHER_SESSION}", moved)
        self._known = known | set(chunk_ids)
        self._turn()

    def forget(self) -> None:
        """Read the rows again when they are next asked for."""
        self._known = None
        self._turn()

    def _turn(self) -> None:
        self._seen, self._superseding = _SeenCache(), None
        self.turned += 1


@dataclass(frozen=True)
class _AnchorRow:
    instance: int
    chunk_id: int
    S_exact_settled: Sim3


class Anchors:
    """The table of which chunks instances are attached to. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._rows = Table(connection, "anchors", Columns.of(_AnchorRow), "instance")

    def put(self, anchors: Mapping[int, Anchor]) -> None:
        """Record which chunk instances are attached to, by id."""
        self._rows.put(_AnchorRow(n, a.chunk_id, a.S_exact_settled) for n, a in anchors.items())

    def all(self) -> Iterator[dict[int, Anchor]]:
        """Yield the anchors of all instances by id, some thousand at a time."""
        for rows in self._rows.in_batches():
            yield {row.instance: Anchor(row.chunk_id, row.S_exact_settled) for row in rows}

    def drop(self, instance_id: int) -> None:
        """Forget which chunk an instance is attached to."""
        self._rows.delete("instance = ?", (instance_id,))


@dataclass(frozen=True)
class Looks:
    """What the description of an instance is made of, in any light."""

    instance: int
    shape: str
    """See `memory.description.describe.shape_word`."""
    resting: bool
    """Whether it stands still."""
    swatches: Annotated[NDArray[np.float64], Shape((-1, 7))]
    """RGB, CIE L*a*b* and share of its colours, the commonest first. Shape (S, 7)."""


class LooksTable:
    """The table of looks. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._rows = Table(connection, "looks", Columns.of(Looks), "instance")

    def put(self, looks: Iterable[Looks]) -> None:
        """Write the looks of instances."""
        self._rows.put(looks)

    def all(self) -> Iterator[dict[int, Looks]]:
        """Yield the looks of all instances by id, some thousand at a time."""
        for rows in self._rows.in_batches():
            yield {looks.instance: looks for looks in rows}

    def count(self) -> int:
        """Return of how many instances the looks are known."""
        return self._rows.count()

    def drop(self, instance_id: int) -> None:
        """Forget the looks of an instance."""
        self._rows.delete("instance = ?", (instance_id,))


class LibraryState:
    """The six tables, and which chunks the library does not know yet."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.settled = Settled(connection)
        self.overlaps = Overlaps(connection)
        self.members = GroupMembers(connection)
        self.anchors = Anchors(connection)
        self.redundant = Redundant(connection)
        self.looks = LooksTable(connection)
        self.touched: set[int] | None = None
        """Chunks that were placed or measured again since the library was derived; None where that is not known."""
        connection.on_forget(self._forget)

    def touch(self, chunk_ids: Iterable[int]) -> None:
        """Note that chunks were placed or measured again."""
        if self.touched is not None:
            self.touched.update(chunk_ids)

    def unsettle(self, chunk_id: int) -> None:
        """Note that what was derived from a chunk does not hold any more: it was measured again."""
        self.settled.drop(chunk_id)
        self.touch([chunk_id])

    def forget(self) -> None:
        """Drop all of it, so that the library is derived as a whole next time."""
        for name in PASSING:
            self._connection.execute(f"DELETE FROM {name}")
        self._connection.execute("DELETE FROM memory WHERE key = 'library'")
        self.settled.forget()
        self.redundant.forget()

    def _forget(self) -> None:
        self.touched = None


PASSING = ("settled", "overlaps", "members", "anchors", "redundant", "looks")
"""The tables of this page."""
