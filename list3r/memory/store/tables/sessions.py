"""Sessions: the videos that were added to the memory."""

from __future__ import annotations

from collections.abc import Mapping

from list3r.memory.core.errors import MemoryFileError, OptionError
from list3r.memory.core.records import Session
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns
from list3r.memory.store.rows.table import Table

_OF_CHUNKS = (
    ("edges", ("u", "v")),
    ("pair_scores", ("u", "v")),
    *((table, ("chunk_id",)) for table in ("placements", "bends", "keyframes", "supports")),
    *((table, ("chunk_id",)) for table in ("local_instances", "votes")),
)
"""Tables of what chunks hold, and the columns that name the chunks."""


class Sessions:
    """The table of sessions. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._rows = Table(connection, "sessions", Columns.of(Session), "session_id")

    def add(self, source: str, fingerprint: str, settings: Mapping[str, object], frame_count: int) -> int:
        """Add a session in the state `building`; its id."""
        session = Session(0, source, fingerprint, dict(settings), frame_count, "building")
        return self._rows.add(session, session_id=None)

    def all(self) -> list[Session]:
        """Return all sessions in order."""
        return self._rows.all()

    def get(self, session_id: int) -> Session:
        """Return one session. Raises `MemoryFileError` when the memory has none of that id."""
        found = self._rows.first("session_id = ?", (session_id,))
        if found is None:
            raise MemoryFileError(f"{self._connection.path} has no session {session_id}")
        return found

    def check(self, session_id: int) -> None:
        """Raise `OptionError` for a session that the memory does not have."""
        known = [s.session_id for s in self.all()]
        if session_id not in known:
            text = ", ".join(map(str, known)) or "none"
            raise OptionError(f"{self._connection.path} has no session {session_id}; it has: {text}")

    def put(self, session: Session) -> None:
        """Write a session again."""
        self._rows.put([session])

    def complete(self, session_id: int) -> None:
        """Mark a session as wholly built."""
        self._rows.set("session_id = ?", (session_id,), state="complete")

    def drop(self, session_id: int) -> None:
        """Take a session back, with all that its chunks hold. Its instances must not be in the library yet."""
        own = "SELECT chunk_id FROM chunks WHERE session_id = :session"
        for table, columns in _OF_CHUNKS:
            where = " OR ".join(f"{column} IN ({own})" for column in columns)
            self._connection.execute(f"DELETE FROM {table} WHERE {where}", {"session": session_id})
        for table in ("frames", "chunks", "sessions"):
            self._connection.execute(f"DELETE FROM {table} WHERE session_id = ?", (session_id,))
        self._connection.forget()
