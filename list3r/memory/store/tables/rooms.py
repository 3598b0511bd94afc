"""Rooms, what is in them, and the doorways between them, which are derived."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from list3r.memory.core.records import Doorway, Room
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.codec import raw_array
from list3r.memory.store.rows.columns import Columns, joined
from list3r.memory.store.rows.table import Table


def _unpack_outline(blob: bytes) -> tuple[Any, ...]:
    return (raw_array(blob, "<f8", (len(blob) // 16, 2), "the outline").copy(),)


def _unpack_position(blob: bytes) -> tuple[Any, ...]:
    return (raw_array(blob, "<f8", (3,), "the position").copy(),)


def _pack(array: Any) -> tuple[bytes]:
    return (np.asarray(array, "<f8").tobytes(),)


class RoomTable:
    """The tables of rooms and doorways. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        outline = joined(("outline",), ("outline",), _pack, _unpack_outline)
        position = joined(("position",), ("position",), _pack, _unpack_position)
        said = ("instances", "name", "reason")
        self._rooms = Table(connection, "rooms", Columns(Room, outline, omit=said), "id")
        self._doorways = Table(connection, "doorways", Columns(Doorway, position), "a, b, position")

    def replace(self, rooms: Sequence[Room], doorways: Iterable[Doorway]) -> None:
        """Forget all rooms and doorways and write these."""
        for table in ("doorways", "room_instances", "rooms"):
            self._connection.execute(f"DELETE FROM {table}")
        self._rooms.add_all(rooms)
        home = [(n, room.id) for room in rooms for n in room.instances]
        self._connection.execute_many("INSERT INTO room_instances (instance, room) VALUES (?, ?)", home)
        self._doorways.add_all(doorways)

    def all(self) -> list[Room]:
        """Return the rooms by id, with what is in them, without names; `library.rooms.naming` gives these."""
        inside: dict[int, list[int]] = {}
        for n, room in self._connection.rows("SELECT instance, room FROM room_instances ORDER BY instance"):
            inside.setdefault(int(room), []).append(int(n))
        return [replace(room, instances=tuple(inside.get(room.id, ()))) for room in self._rooms.all()]

    def doorways(self) -> list[Doorway]:
        """Return the doorways, by the rooms that they join."""
        return self._doorways.all()

    def drop(self, instance_id: int, heir: int | None) -> None:
        """Take an instance out of its room; an heir that is in none takes its place."""
        if heir is not None:
            self._connection.execute(
                "UPDATE OR IGNORE room_instances SET instance = ? WHERE instance = ?", (heir, instance_id)
            )
        self._connection.execute("DELETE FROM room_instances WHERE instance = ?", (instance_id,))
