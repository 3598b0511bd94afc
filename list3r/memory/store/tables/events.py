"""Events: what each session showed of the things that earlier ones had seen."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from list3r.memory.geometry import OrientedBox
from list3r.memory.records import ChangeEvent
from list3r.memory.store.codec import from_json, raw_array, to_json
from list3r.memory.store.connection import Connection


class EventVerbs(Connection):
    """Writing and reading events. Events are derived: they are written anew whenever the library is."""

    def replace_events(self, events: Iterable[ChangeEvent]) -> None:
        """Forget all events and write these; call inside `transaction()`."""
        self._database.execute("DELETE FROM events")
        self._database.executemany(
            "INSERT OR REPLACE INTO events (session_id, instance, kind, from_box, to_box, frames, confidence, reason)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            [
                (
                    e.session_id,
                    e.instance_id,
                    e.kind,
                    _packed(e.from_box),
                    _packed(e.to_box),
                    to_json([list(f) for f in e.frames]),
                    float(e.confidence),
                    e.reason,
                )
                for e in events
            ],
        )

    def events(self, session_id: int | None = None) -> list[ChangeEvent]:
        """The events of one session or of all, in order of sessions and ids."""
        where, arguments = ("", ()) if session_id is None else ("WHERE session_id = ?", (session_id,))
        query = (
            f"SELECT session_id, instance, kind, from_box, to_box, frames, confidence, reason FROM events {where}"
            " ORDER BY session_id, instance"
        )
        return [_event(row) for row in self._rows(query, arguments)]


def _packed(box: OrientedBox | None) -> bytes | None:
    if box is None:
        return None
    return np.concatenate([box.center, box.size, box.rotation.ravel()]).astype("<f8").tobytes()


def _box(blob: bytes | None, where: str) -> OrientedBox | None:
    if blob is None:
        return None
    values = raw_array(blob, "<f8", (15,), where).copy()
    return OrientedBox(values[:3], values[3:6], values[6:].reshape(3, 3))


def _event(row: tuple[Any, ...]) -> ChangeEvent:
    where = f"the event of instance {row[1]} in session {row[0]}"
    return ChangeEvent(
        session_id=row[0],
        instance_id=row[1],
        kind=row[2],
        from_box=_box(row[3], where),
        to_box=_box(row[4], where),
        frames=tuple((int(s), int(f)) for s, f in from_json(row[5], where)),
        confidence=row[6],
        reason=row[7],
    )
