"""The chunks of a memory, and where they lie."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import MemoryFileError
from list3r.memory.geometry import Sim3
from list3r.memory.records import (
    ChunkRow,
)
from list3r.memory.store.codec import (
    pack_sim3,
)
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.rows import (
    f8,
    read_chunk_row,
)
from list3r.memory.store.tables.edges import EdgeVerbs


class PlacementVerbs(EdgeVerbs):
    """Reading the chunks, and writing where they lie. Writing verbs are called inside `transaction()`."""

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        super().__init__(path, database, lock)
        self._chunk_rows: dict[int, ChunkRow] | None = None
        self._chunk_version = -1
        self._crcs: dict[int, int] | None = None
        self.touched: set[int] | None = None
        """Chunks that were placed or measured anew since the library was derived; None where that is not known."""

    def chunks(self, session_id: int | None = None) -> list[ChunkRow]:
        """The chunks in order, of one session or of all."""
        rows = self._placed().values()
        return [c for c in rows if session_id is None or c.session_id == session_id]

    def chunk(self, chunk_id: int) -> ChunkRow:
        """One chunk. Raises `MemoryFileError` when the memory has none of that id."""
        found = self._placed().get(chunk_id)
        if found is None:
            raise MemoryFileError(f"{self.path} has no chunk {chunk_id}")
        return found

    def _placed(self) -> dict[int, ChunkRow]:
        """All chunks by id, read again only when another process or a rollback may have changed them."""
        version = int(self._rows("PRAGMA data_version")[0][0])
        if self._chunk_rows is None or self._chunk_version != version:
            self._chunk_rows, self._chunk_version, self._crcs = self._read_chunks(), version, None
        return self._chunk_rows

    def _read_chunks(self, chunk_ids: Sequence[int] = ()) -> dict[int, ChunkRow]:
        where = f"WHERE c.chunk_id IN ({','.join('?' * len(chunk_ids))})" if chunk_ids else ""
        query = (
            "SELECT c.chunk_id, c.session_id, c.chunk_index, c.first_frame, c.last_frame, p.component,"
            " p.S_world_chunk, c.fx, c.fy, c.cx, c.cy, c.height, c.width, c.scale_kind, p.covariance"
            f" FROM chunks c JOIN placements p USING (chunk_id) {where} ORDER BY c.chunk_id"
        )
        rows = self._rows(query, tuple(chunk_ids))
        self._sound("chunks", (row[0] for row in rows))
        return {row[0]: read_chunk_row(row) for row in rows}

    def place_chunks(
        self,
        poses: Mapping[int, Sim3],
        components: Mapping[int, int],
        covariances: Mapping[int, NDArray[np.float64]] | None = None,
    ) -> None:
        """Rewrite `S_world_chunk`, component and uncertainty of chunks: all that a loop closure moves.

        Chunks that are not named stay as they are, and so do the rows of those that lie there already.
        """
        known = covariances or {}
        rows = dict(self._placed())
        fresh = []
        for k, S in poses.items():
            after = replace(rows[k], S_world_chunk=S, component=int(components[k]), covariance=known.get(k))
            if not _same_place(rows[k], after):
                fresh.append(k)
                rows[k] = after
        self._database.executemany(
            "UPDATE placements SET component = ?, S_world_chunk = ?, covariance = ? WHERE chunk_id = ?",
            [
                (
                    rows[k].component,
                    pack_sim3(rows[k].S_world_chunk),
                    None if rows[k].covariance is None else f8(known[k]),
                    k,
                )
                for k in fresh
            ],
        )
        self._chunk_rows = rows
        self._touch(fresh)

    def unsettle(self, chunk_id: int) -> None:
        """What was derived from a chunk does not hold any more: it was measured anew."""
        gone = self._database.execute("DELETE FROM settled WHERE chunk_id = ?", (int(chunk_id),)).rowcount
        self.unsettled += gone
        self._touch([chunk_id])

    def _touch(self, chunk_ids: Iterable[int]) -> None:
        if self.touched is not None:
            self.touched.update(chunk_ids)

    def forget_rows(self) -> None:
        """Read chunks and edges again when they are next asked for."""
        super().forget_rows()
        self._chunk_rows = self._crcs = None

    def _roll_back(self) -> None:
        super()._roll_back()
        self.forget_rows()
        self.touched = None

    def feature_space(self, chunk_id: int) -> str:
        """The embedding space of a chunk's local features."""
        return str(self._rows("SELECT feature_space FROM chunks WHERE chunk_id = ?", (chunk_id,))[0][0])

    def chunk_checksums(self) -> dict[int, int]:
        """A checksum of what each chunk measured, by chunk id: tells whether something derived from it still holds."""
        rows = self._placed()
        if self._crcs is None or self._crcs.keys() != rows.keys():
            known = self._crcs or {}
            query = "SELECT crc FROM chunks WHERE chunk_id = ?"
            self._crcs = {k: known[k] if k in known else int(self._rows(query, (k,))[0][0]) for k in rows}
        return dict(self._crcs)

    def stage_seconds(self) -> dict[str, float]:
        """CPU seconds spent so far by stage, over all chunks."""
        total: dict[str, float] = {}
        for (text,) in self._rows("SELECT seconds FROM chunks ORDER BY chunk_id"):
            for stage, seconds in json.loads(text).items():
                total[stage] = total.get(stage, 0.0) + seconds
        return total


def _same_place(a: ChunkRow, b: ChunkRow) -> bool:
    """Whether two rows of one chunk say the same of where it lies."""
    if a.component != b.component or (a.covariance is None) != (b.covariance is None):
        return False
    S, T = a.S_world_chunk, b.S_world_chunk
    same = np.array_equal(S.scale, T.scale) and np.array_equal(S.translation, T.translation)
    same = same and np.array_equal(S.rotation, T.rotation)
    return bool(same and (a.covariance is None or np.array_equal(a.covariance, np.asarray(b.covariance))))
