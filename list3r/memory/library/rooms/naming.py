"""What rooms are called: as a person said, else by what stands in them.

Names are read from labels whenever they are asked for, so they follow every new label. A person's name belongs to the
keyframes that were taken in the room, which never change, so it holds however rooms are derived later.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull

from list3r.memory.core.constraints import Key, standing
from list3r.memory.core.description.nouns import is_a, names
from list3r.memory.core.description.spelling import split_words
from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Room
from list3r.memory.library.rooms.outline import encloses
from list3r.memory.store.store import Store

_TELLING: Mapping[str, tuple[str, str]] = {
    "bathroom": ("toilet|bathtub|shower", "washbasin|towel|mirror|sink|washing machine"),
    "kitchen": (
        "stove|oven|refrigerator|dishwasher|kitchen counter|counter|cooker|kitchen unit",
        "sink|microwave|kettle|toaster|pot|pan|table|chair|cabinet",
    ),
    "bedroom": ("bed|crib|bunk bed", "wardrobe|nightstand|pillow|dresser|blanket"),
    "living room": ("sofa|couch", "armchair|television|coffee table|bookshelf|rug|cushion"),
    "meeting room": ("whiteboard|projector", "table|chair|television"),
    "office": ("desk", "monitor|office chair|keyboard|computer|laptop|printer|bookshelf|chair"),
    "dining room": ("dining table", "chair|sideboard"),
    "storage": ("storage rack", "carton|box|shelf|bookshelf"),
}
"""By room what tells it alone, and what supports that. A room is what most of its telling things tell."""
_CORRIDOR = (2.5, 2.5)
"""A corridor is at most so many metres wide, and at least so many times as long."""
_MOST_KEYS = 16
"""Keyframes of a room that a person's name belongs to, at most."""


def named_rooms(store: Store) -> list[Room]:
    """Return the rooms by id, with their names and what these come from."""
    rooms = store.rooms.all()
    if not rooms:
        return []
    labels = {i.id: i.label for i in store.instances.of([n for r in rooms for n in r.instances]) if i.label}
    said = _said(store, rooms)
    out = []
    for room in rooms:
        things = [(n, labels[n]) for n in room.instances if n in labels]
        name, reason = _by_things(things) or _by_shape(room) or (None, "")
        if room.id in said:
            name, author = said[room.id]
            reason = f"named by {author}"
        out.append(replace(room, name=name, reason=reason))
    return out


def title(room: Room) -> str:
    """Name a room by its number and its name."""
    return f"room {room.id}" + (f" ({room.name})" if room.name else "")


def _by_things(things: Sequence[tuple[int, str]]) -> tuple[str, str] | None:
    """Return what labelled things make of a room, with those that tell it; None where none does."""
    best: tuple[tuple[int, int], str, str] | None = None
    for name, (telling, supporting) in _TELLING.items():
        sure = [t for t in things if _is_one(t[1], telling)]
        more = [t for t in things if t not in sure and _is_one(t[1], supporting)]
        score = len(sure), len({label for _, label in more})
        if sure and (best is None or score > best[0]):
            best = score, name, ", ".join(f"#{n} {label}" for n, label in (sure + more)[:4])
    return None if best is None else best[1:]


def _is_one(label: str, kinds: str) -> bool:
    """Return whether a label names one of some kinds."""
    words = split_words(label)
    meant = names().get(tuple(words), ())
    return any(words == split_words(kind) or any(is_a(m, kind) for m in meant) for kind in kinds.split("|"))


def _by_shape(room: Room) -> tuple[str, str] | None:
    """Return `corridor` for what is long and narrow and was seen whole."""
    corners = room.outline[ConvexHull(room.outline).vertices]
    sides = np.roll(corners, -1, axis=0) - corners
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    widths = [np.ptp(corners @ (-d[1], d[0])) for d in along]
    k = int(np.argmin(widths))
    wide, long = float(widths[k]), float(np.ptp(corners @ along[k]))
    if room.partial or wide > _CORRIDOR[0] or long < _CORRIDOR[1] * wide:
        return None
    return "corridor", f"{long:.1f} m long and {wide:.1f} m wide"


# ---------------------------------------------------------------------------------------------- what persons said


def keyframes_in(store: Store, room: Room) -> tuple[Key, ...]:
    """Return (chunk id, Frame.index) of keyframes taken in a room, some of them where there are many."""
    keys = [(k, f) for k, f, xyz in _cameras(store) if _holds(room, xyz)]
    return tuple(keys[:: -(-len(keys) // _MOST_KEYS)]) if keys else ()


def _cameras(store: Store) -> list[tuple[int, int, Array]]:
    """Return chunk id, Frame.index and position of the keyframes of the first component."""
    chunks = store.chunks.all()
    first = min((c.component for c in chunks), default=0)
    return [
        (c.chunk_id, k.frame_index, c.S_world_chunk.apply(k.T_chunk_cam[None, :3, 3])[0])
        for c in chunks
        if c.component == first
        for k in store.keyframes.of(c.chunk_id)
    ]


def _holds(room: Room, xyz: Array) -> bool:
    """Return whether a camera was in a room: over its outline, and not on another storey."""
    return bool(room.floor_z < xyz[2] < room.floor_z + 3.0) and bool(encloses(room.outline, xyz[:2])[0])


def _said(store: Store, rooms: Sequence[Room]) -> dict[int, tuple[str | None, str]]:
    """Return the names that persons gave, with who did, by room: the one in which most of the named keyframes are."""
    edits = [e for e in standing(store.edits.all()) if e.kind == "room"]
    where = {(k, f): xyz for k, f, xyz in _cameras(store)} if edits else {}
    out: dict[int, tuple[str | None, str]] = {}
    for edit in reversed(edits):
        keys = [k for part in edit.parts for k in part if k in where]
        votes = Counter(room.id for k in keys for room in rooms if _holds(room, where[k]))
        if votes:
            out.setdefault(min(votes, key=lambda n: (-votes[n], n)), (edit.text, edit.author))
    return {n: said for n, said in out.items() if said[0]}
