"""How pairs of chunks overlap: the one cache of consolidation. All of it can be computed again and may be lost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns
from list3r.memory.store.rows.table import Table


@dataclass(frozen=True)
class StoredScores:
    """How the local instances of two chunks overlap."""

    u: int
    """Chunk id."""
    v: int
    """Chunk id, v >= u."""
    stamp: bytes
    """What it was computed from: what the two chunks measured, how they lie to each other, the settings."""
    scores: bytes
    """Packed, see `memory.library.scores`."""


class PairScoreTable:
    """The table of overlaps. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._rows = Table(connection, "pair_scores", Columns.of(StoredScores), "u, v")

    def get(self, u: int, v: int) -> StoredScores | None:
        """Return how two chunks overlap, if that was kept."""
        return self._rows.first("u = ? AND v = ?", (u, v))

    def all(self) -> list[StoredScores]:
        """Return how all pairs overlap that are kept."""
        return self._rows.all()

    def pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of chunks that are kept, in order."""
        return [(u, v) for u, v in self._connection.rows("SELECT u, v FROM pair_scores ORDER BY u, v")]

    def put(self, rows: Iterable[StoredScores]) -> None:
        """Keep how pairs of chunks overlap."""
        self._rows.put(rows)

    def drop(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Forget pairs of chunks."""
        self._connection.execute_many("DELETE FROM pair_scores WHERE u = ? AND v = ?", list(pairs))

    def clear(self) -> None:
        """Forget all pairs."""
        self._rows.delete()
