"""Rooms: which there are, which one a thing is in, and the way from one to another."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from list3r.memory.core.description.spelling import split_words
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Doorway, Room
from list3r.memory.library.rooms.naming import named_rooms, title
from list3r.memory.store.store import Store

NO_ROOMS = (
    "a memory has rooms as it is today, and only when its session has ended, up is known and its keyframes have depth"
)


@dataclass(frozen=True)
class RoomPath:
    """The way from one room to another."""

    rooms: tuple[Room, ...]
    doorways: tuple[Doorway, ...]
    """One between each two."""


def rooms(store: Store) -> list[Room]:
    """Return the rooms by id, with their names; none where up is not known or no depth was kept, or of the past."""
    return named_rooms(store)


def rooms_of(store: Store, room: int | str) -> list[Room]:
    """Return the room of an id, or all rooms of a name. Raises `OptionError` that says which there are."""
    known = named_rooms(store)
    wanted = str(room).removeprefix("#")
    if wanted.isdigit():
        found = [r for r in known if r.id == int(wanted)]
    else:
        found = [r for r in known if r.name and _words(r.name) == _words(wanted)]
    if not found:
        there = ", ".join(title(r) for r in known)
        raise OptionError(
            f"no room {str(room)!r}; there are {there}" if there else f"no room {str(room)!r}: {NO_ROOMS}"
        )
    return found


def _words(name: str) -> list[str]:
    """Return the words by which a room is known: "storage room" is the storage."""
    words = split_words(name)
    return words[:-1] if len(words) > 1 and words[-1] == "room" else words


def room_of(store: Store, instance_id: int) -> Room | None:
    """Return the room that an instance is in; None for one in none."""
    return next((r for r in named_rooms(store) if instance_id in r.instances), None)


def room_path(store: Store, start: int | str, end: int | str) -> RoomPath:
    """Return the way through the fewest doorways from one room to another, of several rooms of a name to the first.

    Raises `OptionError` for rooms that there are not, and where no doorways lead from one to the other.
    """
    import networkx

    a, b = rooms_of(store, start)[0], rooms_of(store, end)[0]
    graph = networkx.Graph()
    graph.add_nodes_from(r.id for r in named_rooms(store))
    for d in store.rooms.doorways():
        graph.add_edge(d.a, d.b, doorway=d)
    try:
        way: Sequence[int] = networkx.shortest_path(graph, a.id, b.id)
    except networkx.NetworkXNoPath:
        raise OptionError(f"no doorways lead from {title(a)} to {title(b)}") from None
    by_id = {r.id: r for r in named_rooms(store)}
    doorways = tuple(graph.edges[pair]["doorway"] for pair in itertools.pairwise(way))
    return RoomPath(tuple(by_id[n] for n in way), doorways)
