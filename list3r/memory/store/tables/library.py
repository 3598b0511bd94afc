"""What consolidation goes on with when the next chunk comes: where chunks settled, how they overlap, who is grouped.

All of it follows from what was measured and where chunks lie, and may be lost: consolidation then derives the library
as a whole.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import Sim3
from list3r.memory.store.codec import pack_sim3, raw_array, unpack_sim3
from list3r.memory.store.connection import Connection
from list3r.memory.store.lock import WriterLock

Key = tuple[int, int]
"""(chunk id, local id)."""
_BATCH = 500
"""Rows asked for by id in one statement."""
PASSING = ("settled", "overlaps", "members", "anchors")
"""The tables of this page."""


@dataclass(frozen=True)
class SettledRow:
    """Where a chunk lies for the purpose of consolidation."""

    component: int
    S_graph_chunk: Sim3
    extent: NDArray[np.float64]
    """Box round its points in the frame of the graph, grown by half of what lies near. Shape (2, 3)."""


@dataclass(frozen=True)
class Anchor:
    """The chunk that an instance hangs on."""

    chunk_id: int
    S_exact_settled: Sim3
    """World, as its row was written: from where the chunk is settled to where it lies."""


class LibraryVerbs(Connection):
    """Reading and writing it. Writing verbs are called inside `transaction()`."""

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        super().__init__(path, database, lock)
        self._settled_rows: dict[int, SettledRow] | None = None
        self._settled_version = (-1, -1)

    def forget_library(self) -> None:
        """Drop all of it, so that the library is derived as a whole next time."""
        for name in PASSING:
            self._database.execute(f"DELETE FROM {name}")
        self._database.execute("DELETE FROM memory WHERE key = 'library'")
        self._settled_rows = None

    def _roll_back(self) -> None:
        super()._roll_back()
        self._settled_rows = None

    # ------------------------------------------------------------------ where chunks settled

    def settled(self) -> Mapping[int, SettledRow]:
        """All settled chunks by id; not to be changed."""
        version = int(self._rows("PRAGMA data_version")[0][0]), self.unsettled
        if self._settled_rows is None or version != self._settled_version:
            query = "SELECT chunk_id, component, S_graph_chunk, extent FROM settled ORDER BY chunk_id"
            self._settled_rows = {
                k: SettledRow(c, unpack_sim3(S), raw_array(x, "<f8", (2, 3), f"the extent of chunk {k}").copy())
                for k, c, S, x in self._rows(query)
            }
            self._settled_version = version
        return self._settled_rows

    def put_settled(self, rows: Mapping[int, SettledRow]) -> None:
        """Settle chunks, or settle them anew; which of their points were dropped is forgotten."""
        known = {**self.settled(), **rows}
        self._database.executemany(
            "INSERT OR REPLACE INTO settled VALUES (?, ?, ?, ?, x'')",
            [(k, r.component, pack_sim3(r.S_graph_chunk), r.extent.astype("<f8").tobytes()) for k, r in rows.items()],
        )
        self._settled_rows = dict(sorted(known.items()))

    def dropped(self, chunk_id: int, count: int) -> NDArray[np.bool_]:
        """Which of a chunk's representative points belong to something else. Shape (count,)."""
        rows = self._rows("SELECT dropped FROM settled WHERE chunk_id = ?", (chunk_id,))
        bits = np.frombuffer(rows[0][0], np.uint8) if rows else np.zeros(0, np.uint8)
        out = np.zeros(count, dtype=bool)
        found = np.unpackbits(bits)[:count].astype(bool)
        out[: len(found)] = found
        return out

    def set_dropped(self, dropped: Mapping[int, NDArray[np.bool_]]) -> None:
        """Say which representative points of chunks belong to something else."""
        packed = [(np.packbits(v).tobytes() if v.any() else b"", k) for k, v in dropped.items()]
        self._database.executemany("UPDATE settled SET dropped = ? WHERE chunk_id = ?", packed)

    # ------------------------------------------------------------------ how chunks overlap

    def overlaps(self, chunk_ids: Sequence[int] | None = None) -> dict[tuple[int, int], bytes]:
        """How the local instances of pairs of chunks overlap (u <= v), of which one is among these, or of all."""
        if chunk_ids is None:
            return {(u, v): blob for u, v, blob in self._rows("SELECT u, v, scores FROM overlaps ORDER BY u, v")}
        out: dict[tuple[int, int], bytes] = {}
        for start in range(0, len(chunk_ids), _BATCH):
            part = tuple(int(k) for k in chunk_ids[start : start + _BATCH])
            marks = ",".join("?" * len(part))
            for column in ("u", "v"):
                query = f"SELECT u, v, scores FROM overlaps WHERE {column} IN ({marks})"
                out |= {(u, v): blob for u, v, blob in self._rows(query, part)}
        return dict(sorted(out.items()))

    def overlapping(self, chunk_ids: Sequence[int]) -> list[tuple[int, int]]:
        """Pairs of chunks (u <= v) that overlap, of which one is among these."""
        out: set[tuple[int, int]] = set()
        for start in range(0, len(chunk_ids), _BATCH):
            part = tuple(int(k) for k in chunk_ids[start : start + _BATCH])
            marks = ",".join("?" * len(part))
            for column in ("u", "v"):
                out.update(self._rows(f"SELECT u, v FROM overlaps WHERE {column} IN ({marks})", part))  # type: ignore[arg-type]
        return sorted(out)

    def overlap(self, pair: tuple[int, int]) -> bytes:
        """How the local instances of one pair of chunks overlap, which must be known."""
        return bytes(self._rows("SELECT scores FROM overlaps WHERE u = ? AND v = ?", pair)[0][0])

    def put_overlaps(self, overlaps: Mapping[tuple[int, int], bytes]) -> None:
        """Write how pairs of chunks overlap."""
        rows = [(u, v, blob) for (u, v), blob in overlaps.items()]
        self._database.executemany("INSERT OR REPLACE INTO overlaps VALUES (?, ?, ?)", rows)

    def drop_overlaps(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Forget pairs of chunks."""
        self._database.executemany("DELETE FROM overlaps WHERE u = ? AND v = ?", list(pairs))

    # ------------------------------------------------------------------ who is grouped

    def members_in(self, chunk_ids: Sequence[int]) -> dict[Key, tuple[Key, bool]]:
        """First member of the group of each local instance of some chunks, and whether the group is shown."""
        out: dict[Key, tuple[Key, bool]] = {}
        for start in range(0, len(chunk_ids), _BATCH):
            part = tuple(int(k) for k in chunk_ids[start : start + _BATCH])
            query = (
                "SELECT chunk_id, local_id, first_chunk, first_local, shown FROM members WHERE chunk_id IN"
                f" ({','.join('?' * len(part))})"
            )
            out |= {(k, n): ((a, b), bool(shown)) for k, n, a, b, shown in self._rows(query, part)}
        return out

    def group_of(self, first: Key) -> list[Key]:
        """All members of a group, in order; none where there is no such group."""
        query = "SELECT chunk_id, local_id FROM members WHERE first_chunk = ? AND first_local = ? ORDER BY 1, 2"
        return [(k, n) for k, n in self._rows(query, first)]

    def put_groups(self, groups: Iterable[tuple[Sequence[Key], bool]]) -> None:
        """Write groups, each with whether it is shown; their members leave the groups that they were in."""
        self.put_members((key, group[0], shown) for group, shown in groups for key in group)

    def put_members(self, members: Iterable[tuple[Key, Key, bool]]) -> None:
        """Write of local instances the first member of their group, and whether it is shown."""
        self._database.executemany(
            "INSERT OR REPLACE INTO members VALUES (?, ?, ?, ?, ?)",
            [(*key, *first, int(shown)) for key, first, shown in members],
        )

    def hidden_groups(self) -> int:
        """How many groups are not shown."""
        query = "SELECT count(*) FROM members WHERE shown = 0 AND chunk_id = first_chunk AND local_id = first_local"
        return int(self._rows(query)[0][0])

    # ------------------------------------------------------------------ what instances hang on

    def put_anchors(self, anchors: Mapping[int, Anchor]) -> None:
        """Say which chunk instances hang on, by id."""
        rows = [(n, a.chunk_id, pack_sim3(a.S_exact_settled)) for n, a in anchors.items()]
        self._database.executemany("INSERT OR REPLACE INTO anchors VALUES (?, ?, ?)", rows)

    def anchors(self, ids: Sequence[int] | None = None) -> dict[int, Anchor]:
        """The anchors of some instances, or of all."""
        if ids is None:
            rows = self._rows("SELECT instance, chunk_id, S_exact_settled FROM anchors ORDER BY instance")
            return {n: Anchor(k, unpack_sim3(S)) for n, k, S in rows}
        out: dict[int, Anchor] = {}
        for n in ids:
            for k, S in self._rows("SELECT chunk_id, S_exact_settled FROM anchors WHERE instance = ?", (int(n),)):
                out[int(n)] = Anchor(k, unpack_sim3(S))
        return out
