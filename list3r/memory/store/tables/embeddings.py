"""Embeddings of instances in named spaces, and what changed among them since the store was opened."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import MemoryFileError
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.tables.chunks import ChunkVerbs
from list3r.memory.store.tables.words import WordVerbs

_BATCH = 500
"""Rows asked for by id in one statement."""


class EmbeddingVerbs(ChunkVerbs, WordVerbs):
    """Vectors in, vectors out. Writing verbs are called inside `transaction()`."""

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        super().__init__(path, database, lock)
        self.vectors_touched: list[int] = []
        """Instances whose vectors this store has written or dropped since it was opened, in order; may repeat."""
        self.spaces_touched: set[str] = set()
        """Spaces that this store has written to."""

    def state_stamp(self) -> tuple[int, int, bool]:
        """Changes whenever the content may have: by other processes, by this store, by a rollback."""
        other = int(self._rows("PRAGMA data_version")[0][0])
        return other, self._database.total_changes, self._database.in_transaction

    def put_embeddings(self, space: str, ids: Sequence[int], vectors: NDArray[np.float32]) -> None:
        """Set the vectors of instances in a named space. `vectors` has shape (N, D)."""
        self.vectors_touched += [int(i) for i in ids]
        self.spaces_touched.add(space)
        self._database.executemany(
            "INSERT OR REPLACE INTO embeddings VALUES (?, ?, ?)",
            [(int(i), space, v.astype("<f4").tobytes()) for i, v in zip(ids, vectors, strict=True)],
        )

    def embeddings(self, space: str) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Ids of shape (N,) and vectors of shape (N, D) of a named space."""
        rows = self._rows("SELECT instance, vector FROM embeddings WHERE space = ? ORDER BY instance", (space,))
        self._sound("embeddings", (row[0] for row in rows))
        ids = np.array([r[0] for r in rows], dtype=np.int64)
        return ids, np.array([np.frombuffer(r[1], "<f4") for r in rows], dtype=np.float32)

    def embeddings_of(self, space: str, ids: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Of these instances (no aliases) those with a vector in the space: ids (N,), ascending, and vectors (N, D)."""
        rows: list[tuple[Any, ...]] = []
        for start in range(0, len(ids), _BATCH):
            part = [int(i) for i in ids[start : start + _BATCH]]
            marks = ",".join("?" * len(part))
            query = f"SELECT instance, vector FROM embeddings WHERE instance IN ({marks}) AND space = ?"
            rows += self._rows(query, (*part, space))
        self._sound("embeddings", (row[0] for row in rows))
        return _vectors(sorted(rows), space)

    def embedding_batches(
        self, space: str, size: int = 20_000
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """Ids (n,) and vectors (n, D) of a named space, in order of ids, at most `size` at a time."""
        last = -1
        query = "SELECT instance, vector FROM embeddings WHERE instance > ? AND space = ? ORDER BY instance LIMIT ?"
        while rows := self._rows(query, (last, space, size)):
            last = rows[-1][0]
            self._sound("embeddings", (row[0] for row in rows))
            yield _vectors(rows, space)

    def embedding_count(self, space: str) -> int:
        """How many vectors a named space holds."""
        return int(self._rows("SELECT count(*) FROM embeddings WHERE space = ?", (space,))[0][0])

    def embedding_sample(self, space: str, size: int) -> NDArray[np.float32]:
        """About `size` of the vectors of a named space, spread evenly over it; all where there are fewer. (n, D)."""
        stride = max(1, self.embedding_count(space) // size)
        query = (
            "SELECT instance, vector FROM embeddings"
            " WHERE space = ? AND ((instance % 1000003) * 2654435761 >> 7) % ? = 0 ORDER BY instance"
        )
        return _vectors(self._rows(query, (space, stride)), space)[1]

    def embedding_spaces(self) -> list[str]:
        """The named spaces that hold vectors."""
        query = (
            "WITH RECURSIVE held (space) AS (SELECT min(space) FROM embeddings UNION ALL"
            " SELECT (SELECT min(e.space) FROM embeddings e WHERE e.space > held.space) FROM held"
            " WHERE held.space IS NOT NULL) SELECT space FROM held WHERE space IS NOT NULL"
        )
        return [r[0] for r in self._rows(query)]


def _vectors(rows: Sequence[tuple[Any, ...]], space: str) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Ids and vectors of rows of `embeddings`. Raises `MemoryFileError` where one has another length than the rest."""
    if not rows:
        return np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
    length = len(rows[0][1])
    if length % 4 or any(len(row[1]) != length for row in rows):
        bad = next(instance for instance, vector in rows if len(vector) != length or length % 4)
        raise MemoryFileError(f"the vector of instance {bad} in the space {space} is damaged")
    ids = np.fromiter((row[0] for row in rows), np.int64, len(rows))
    return ids, np.frombuffer(b"".join(row[1] for row in rows), "<f4").reshape(len(rows), -1).astype(
        np.float32, copy=False
    )
