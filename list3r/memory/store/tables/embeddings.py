"""Embeddings of instances in named spaces, each with the number of the change that wrote it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.table import batches

_SPACES = (
    "WITH RECURSIVE held (space) AS (SELECT min(space) FROM embeddings UNION ALL"
    " SELECT (SELECT min(e.space) FROM embeddings e WHERE e.space > held.space) FROM held WHERE held.space IS NOT NULL)"
)


class Embeddings:
    """The table of embeddings: vectors in, vectors out. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def put(self, space: str, ids: Sequence[int], vectors: NDArray[np.float32]) -> None:
        """Set the vectors of instances in a named space. `vectors` has shape (N, D)."""
        change = self.changes() + 1
        self._connection.execute_many(
            "INSERT OR REPLACE INTO embeddings (instance, space, change, vector) VALUES (?, ?, ?, ?)",
            [(int(i), space, change, v.astype("<f4").tobytes()) for i, v in zip(ids, vectors, strict=True)],
        )

    def changes(self) -> int:
        """Return how often vectors were written or dropped."""
        query = (
            f"{_SPACES} SELECT max("
            "coalesce(max((SELECT max(e.change) FROM embeddings e WHERE e.space = held.space)), 0),"
            " coalesce((SELECT CAST(value AS INTEGER) FROM memory WHERE key = 'embedding changes'), 0)) FROM held"
        )
        return int(self._connection.rows(query)[0][0])

    def changed(self, space: str, after: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return ids (N,) and vectors (N, D) of a named space that were written after a change."""
        query = "SELECT instance, vector FROM embeddings WHERE space = ? AND change > ? ORDER BY instance"
        return _vectors(self._connection.rows(query, (space, after)), space)

    def unchanged(self, space: str, ids: Sequence[int], upto: int) -> list[tuple[int, bytes]]:
        """Return those of some instances whose vectors were not written after a change, with these as they are."""
        marks = ",".join("?" * len(ids))
        query = f"SELECT instance, vector FROM embeddings WHERE instance IN ({marks}) AND space = ? AND change <= ?"
        return self._connection.rows(query, (*ids, space, upto))

    def of_the_file(self) -> bool:
        """Return whether these are the vectors of the file, as they were committed, and not shown otherwise."""
        return not self._connection.writing and not self._connection.rows(
            "SELECT 1 FROM sqlite_temp_master WHERE name = 'embeddings'"
        )

    def all(self, space: str) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return ids (N,) and vectors (N, D) of a named space."""
        query = "SELECT instance, vector FROM embeddings WHERE space = ? ORDER BY instance"
        return _vectors(self._connection.rows(query, (space,)), space)

    def drop(self, instance_id: int) -> None:
        """Forget the vectors of an instance."""
        change = self.changes() + 1
        if self._connection.execute("DELETE FROM embeddings WHERE instance = ?", (instance_id,)).count:
            value = "INSERT OR REPLACE INTO memory VALUES ('embedding changes', ?)"
            self._connection.execute(value, (str(change),))

    def of(self, space: str, ids: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return ids (N,), ascending, and vectors (N, D) of those of some instances (no aliases) that have one."""
        rows: list[tuple[Any, ...]] = []
        for part, marks in batches(ids):
            query = f"SELECT instance, vector FROM embeddings WHERE instance IN ({marks}) AND space = ?"
            rows += self._connection.rows(query, (*part, space))
        return _vectors(sorted(rows), space)

    def batches(self, space: str, size: int = 20_000) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """Yield ids (n,) and vectors (n, D) of a named space, in order of ids, at most `size` at a time."""
        last = -1
        query = "SELECT instance, vector FROM embeddings WHERE instance > ? AND space = ? ORDER BY instance LIMIT ?"
        while rows := self._connection.rows(query, (last, space, size)):
            last = rows[-1][0]
            yield _vectors(rows, space)

    def count(self, space: str) -> int:
        """Return how many vectors a named space holds."""
        return int(self._connection.rows("SELECT count(*) FROM embeddings WHERE space = ?", (space,))[0][0])

    def sample(self, space: str, size: int) -> NDArray[np.float32]:
        """Return about `size` vectors of a named space, spread evenly over it; all where there are fewer. (n, D)."""
        return self.of(space, self.spread(space, size))[1]

    def spread(self, space: str, size: int) -> list[int]:
        """Return the ids of about `size` vectors of a named space, spread evenly over it; all where there are fewer."""
        stride = max(1, self.count(space) // size)
        query = (
            "SELECT instance FROM embeddings"
            " WHERE space = ? AND ((instance % 1000003) * 2654435761 >> 7) % ? = 0 ORDER BY instance"
        )
        return [n for (n,) in self._connection.rows(query, (space, stride))]

    def spaces(self) -> list[str]:
        """Return the named spaces that hold vectors."""
        return [r[0] for r in self._connection.rows(f"{_SPACES} SELECT space FROM held WHERE space IS NOT NULL")]


def _vectors(rows: Sequence[tuple[Any, ...]], space: str) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Ids and vectors of rows of `embeddings`. Raises `MemoryFileError` where one has another length than the rest, or
    numbers that are none.
    """
    if not rows:
        return np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
    length = len(rows[0][1]) if type(rows[0][1]) is bytes else 0
    bad = [n for n, v in rows if type(v) is not bytes or len(v) != length or length == 0 or length % 4]
    ids = np.fromiter((row[0] for row in rows), np.int64, len(rows))
    if not bad:
        vectors = np.frombuffer(b"".join(row[1] for row in rows), "<f4").reshape(len(rows), -1)
        bad = ids[~np.isfinite(vectors).all(axis=1)].tolist()
    if bad:
        raise MemoryFileError(f"the vector of instance {bad[0]} in the space {space} is damaged")
    return ids, vectors.astype(np.float32, copy=False)
