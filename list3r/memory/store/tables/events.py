"""Events: what each session showed of the instances that earlier ones had seen."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import ChangeEvent
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.codec import raw_array
from list3r.memory.store.rows.columns import Column, Columns, joined
from list3r.memory.store.rows.table import Table


def _pack(box: OrientedBox | None) -> tuple[Any, ...]:
    if box is None:
        return None, None, None, None
    rest = np.concatenate([box.size, box.rotation.ravel()]).astype("<f8").tobytes()
    return *map(float, box.center), rest


def _unpack(x: float, y: float, z: float, rest: bytes | None) -> tuple[OrientedBox | None]:
    if rest is None:
        return (None,)
    values = raw_array(rest, "<f8", (12,), "the box").copy()
    return (OrientedBox(np.array([x, y, z], np.float64), values[:3], values[3:].reshape(3, 3)),)


def _box(end: str) -> Column:
    """The columns of the box where something was before or after; its centre is plain."""
    return joined((f"{end}_x", f"{end}_y", f"{end}_z", f"{end}_box"), (f"{end}_box",), _pack, _unpack)


_COLUMNS = Columns(ChangeEvent, _box("from"), _box("to"), instance_id="instance")


class Events:
    """The table of events, which are derived."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._rows = Table(connection, "events", _COLUMNS, "session_id, instance")

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
