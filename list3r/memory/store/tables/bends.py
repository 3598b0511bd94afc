"""Verbs for how chunks bend: one small row a chunk, written when a session is finished."""

from __future__ import annotations

from collections.abc import Mapping

from list3r.memory.bends import Bend
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows import f8


class BendVerbs(Connection):
    """Writing and reading the bends of chunks."""

    def set_bends(self, bends: Mapping[int, Bend]) -> None:
        """Replace what is known of how chunks bend, by chunk id; call inside `transaction()`."""
        self._database.execute("DELETE FROM bends")
        self._database.executemany(
            "INSERT INTO bends VALUES (?, ?, ?)",
            [(k, f8(bend.frames), f8(bend.twists)) for k, bend in sorted(bends.items())],
        )

    def bends(self) -> dict[int, Bend]:
        """By chunk id; a chunk that is not in it is rigid. Raises `MemoryFileError` for damaged rows."""
        rows = self._rows("SELECT chunk_id, frames, twists FROM bends ORDER BY chunk_id")
        return {int(k): Bend.of_bytes(frames, twists, f"the bend of chunk {k}") for k, frames, twists in rows}
