"""Events: what each session showed of the instances that earlier ones had seen."""

from __future__ import annotations

from collections.abc import Iterable

from list3r.memory.records import ChangeEvent
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.columns import Columns
from list3r.memory.store.rows.table import Table


class Events:
    """The table of events, which are derived."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        columns = Columns.of(ChangeEvent, instance_id="instance")
        self._rows = Table(connection, "events", columns, "session_id, instance")

    def replace(self, events: Iterable[ChangeEvent], after: int = 0) -> None:
        """Forget all events of sessions `after` one and write these; call inside `transaction()`."""
        self._rows.delete("session_id > ?", (after,))
        self._rows.put(events)

    def all(self, session_id: int | None = None) -> list[ChangeEvent]:
        """Return the events of one session or of all, in order of sessions and ids."""
        return self._rows.all() if session_id is None else self._rows.all("session_id = ?", (session_id,))

    def has_moved(self, instance_id: int) -> bool:
        """Return whether any session found an instance elsewhere."""
        query = "SELECT 1 FROM events WHERE instance = ? AND kind = 'moved' LIMIT 1"
        return bool(self._connection.rows(query, (instance_id,)))

    def drop(self, instance_id: int, heir: int | None) -> None:
        """Forget the events of an instance, or give those to its heir that the heir has none beside."""
        if heir is not None:
            statement = "UPDATE OR IGNORE events SET instance = ? WHERE instance = ?"
            self._connection.execute(statement, (heir, instance_id))
        self._rows.delete("instance = ?", (instance_id,))
