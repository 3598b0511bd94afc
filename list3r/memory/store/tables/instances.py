"""Instances of the library, by id and by place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import BestView, Instance
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.codec import raw_array
from list3r.memory.store.rows.columns import Columns, joined
from list3r.memory.store.rows.table import Table
from list3r.memory.store.tables.embeddings import Embeddings
from list3r.memory.store.tables.events import Events
from list3r.memory.store.tables.ids import Ids
from list3r.memory.store.tables.labels import DetectedLabels
from list3r.memory.store.tables.relations import RelationTable
from list3r.memory.store.tables.rooms import RoomTable
from list3r.memory.store.tables.words import Words

Array = NDArray[np.float64]
_RANK = ("id", "confidence", "state", "structure", "max(size_x, size_y, size_z)")
_KEPT_RANKS = 500_000
"""Instances whose ranks are kept; 13 MB."""


_GEOMETRY = ("center_x", "center_y", "center_z", "size_x", "size_y", "size_z", "geometry")


def _pack_geometry(center: Array, aabb: Array, box: OrientedBox) -> tuple[Any, ...]:
    rest = np.concatenate([aabb.ravel(), box.center, box.rotation.ravel()]).astype("<f8").tobytes()
    return *map(float, center), *map(float, box.size), rest


def _read_geometry(*columns: Sequence[Any]) -> list[list[Any]]:
    """Centres, axis-aligned boxes and boxes of many rows at once."""
    plain = np.array(columns[:6], np.float64).T
    rest = raw_array(b"".join(columns[6]), "<f8", (len(plain), 18), "the geometry").copy()
    boxes = map(OrientedBox, rest[:, 6:9], plain[:, 3:], rest[:, 9:18].reshape(-1, 3, 3))
    return [list(plain[:, :3]), list(rest[:, :6].reshape(-1, 2, 3)), list(boxes)]


def _pack_view(view: BestView | None) -> tuple[int | None, int | None, bytes | None]:
    if view is None:
        return None, None, None
    return view.session_id, int(view.frame_index), np.asarray(view.box_xyxy, dtype="<f8").tobytes()


def _read_views(*columns: Sequence[Any]) -> list[list[BestView | None]]:
    boxes = iter(np.frombuffer(b"".join(box for box in columns[2] if box is not None), "<f8").reshape(-1, 4).tolist())
    rows = zip(*columns[:2], strict=True)
    return [[None if s is None else BestView(s, frame, tuple(next(boxes))) for s, frame in rows]]


_COLUMNS = Columns(
    Instance,
    replace(joined(_GEOMETRY, ("center", "aabb", "box"), _pack_geometry, tuple), read=_read_geometry),
    joined(
        ("color_rgb",),
        ("color_rgb",),
        lambda rgb: (int(rgb[0]) << 16 | int(rgb[1]) << 8 | int(rgb[2]),),
        lambda packed: ((packed >> 16 & 255, packed >> 8 & 255, packed & 255),),
    ),
    replace(joined(("view_session", "view_frame", "view_box"), ("best_view",), _pack_view, tuple), read=_read_views),
)


@dataclass(frozen=True)
class Ranks:
    """What orders instances that words name equally well, and their sizes."""

    ids: NDArray[np.int64]
    """Ascending. Shape (N,)."""
    confidence: Array
    """Shape (N,)."""
    removed: NDArray[np.bool_]
    """Whether it is known to be gone. Shape (N,)."""
    structure: NDArray[np.bool_]
    """Shape (N,)."""
    longest_edge: Array
    """Of its box, world units. Shape (N,)."""

    def among(self, chosen: NDArray[Any]) -> Ranks:
        """Return those at some places."""
        return Ranks(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def with_more(self, other: Ranks) -> Ranks:
        """Return these and others."""
        names = [f.name for f in fields(self)]
        both = Ranks(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))
        return both.among(np.argsort(both.ids))


def _is_in(ids: NDArray[np.int64], known: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which of some ids are among others, ascending."""
    if len(known) == 0:
        return np.zeros(len(ids), bool)
    return np.asarray(known[np.minimum(np.searchsorted(known, ids), len(known) - 1)] == ids)


def _ranks(rows: Sequence[tuple[Any, ...]]) -> Ranks:
    """Ranks of rows (id, confidence, state, structure, longest edge)."""
    ids, confidence, state, structure, longest = zip(*rows, strict=True) if rows else ((), (), (), (), ())
    return Ranks(
        np.array(ids, np.int64),
        np.array(confidence, np.float64),
        np.array([s == "removed" for s in state], bool),
        np.array([s is not None for s in structure], bool),
        np.array(longest, np.float64),
    )


class Instances:
    """The table of instances and the R*Tree of their boxes. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection, ids: Ids, words: Words) -> None:
        self._connection = connection
        self._ids = ids
        self._words = words
        self._rows = Table(connection, "instances", _COLUMNS, "id")
        self._ranked = _ranks([])
        self._ranked_in: object = None
        """State of the file in which they were read."""

    def all(self, *, structure: bool | None = None) -> list[Instance]:
        """Return all instances by id; only structure or only things where asked."""
        return self._rows.all({None: "", True: "structure IS NOT NULL", False: "structure IS NULL"}[structure])

    def get(self, instance_id: int) -> Instance:
        """Return one instance; an alias gives the instance it was merged into. Raises `UnknownIdError`."""
        held = self._rows.first("id = ?", (int(instance_id),)) if 0 < instance_id < 2**63 else None
        return held or self._rows.all("id = ?", (self._ids.resolve(instance_id),))[0]

    def of(self, ids: Sequence[int]) -> list[Instance]:
        """Return the instances of these ids that are there, in the order of `ids`; aliases are not resolved."""
        found = {i.id: i for i in self._rows.among("id", ids)}
        return [found[i] for i in map(int, ids) if i in found]

    def put(self, instances: Iterable[Instance]) -> None:
        """Write instances, new or changed, with their boxes in the R*Tree."""
        records = list(instances)
        self._rows.put(records)
        self._words.put(records)
        self._put_boxes((i.id, i.aabb) for i in records)

    def drop(self, instance_id: int, alias_of: int | None) -> None:
        """Take an instance out; its id lives on as an alias of another, or resolves no more."""
        self._rows.delete("id = ?", (instance_id,))
        self._connection.execute("DELETE FROM instance_boxes WHERE id = ?", (instance_id,))
        self._words.drop(instance_id)
        for table in (Embeddings, DetectedLabels):
            table(self._connection).drop(instance_id)
        RelationTable(self._connection, self._ids).drop(instance_id)
        for held in (Events, RoomTable):
            held(self._connection).drop(instance_id, alias_of)
        if alias_of is not None:
            self._ids.add_aliases({instance_id: alias_of})

    def ranks(self, ids: NDArray[np.int64]) -> Ranks:
        """Return what answers are ordered by, before those are read that are given, of those of some ids that are
        there, ascending. Kept while the file stays as it is.
        """
        state = self._connection.stamp()
        if state != self._ranked_in or len(self._ranked.ids) > _KEPT_RANKS:
            self._ranked, self._ranked_in = _ranks([]), state
        wanted = np.sort(ids)
        fresh = wanted[~_is_in(wanted, self._ranked.ids)]
        if len(fresh):
            self._ranked = self._ranked.with_more(_ranks(list(self._rows.columns_of(_RANK, fresh.tolist()))))
        held = wanted[_is_in(wanted, self._ranked.ids)]
        return self._ranked.among(np.searchsorted(self._ranked.ids, held))

    def set_labels(self, labels: Mapping[int, str | None]) -> None:
        """Name instances, by id; None takes a name away."""
        statement = "UPDATE instances SET label = ? WHERE id = ?"
        self._connection.execute_many(statement, [(text, n) for n, text in sorted(labels.items())])
        self._words.put(self.of(sorted(labels)))

    def count(self) -> tuple[int, int]:
        """Return how many things and how many pieces of structure there are."""
        total, things = self._connection.rows("SELECT count(*), count(*) - count(structure) FROM instances")[0]
        return int(things), int(total) - int(things)

    # ------------------------------------------------------------------ by place

    def ids_in_box(self, lower: ArrayLike, upper: ArrayLike) -> list[int]:
        """Return the ids whose axis-aligned boxes meet the box, from the R*Tree. World coordinates, shape (3,) each."""
        query = f"SELECT id FROM instance_boxes WHERE {_MEETS} ORDER BY id"
        return [r[0] for r in self._connection.rows(query, _bounds_of(lower, upper))]

    def boxes_in_box(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        structure: bool = True,
        min_confidence: float = 0.0,
        state: str | None = None,
        component: int | None = None,
        limit: int = -1,
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return ids (N,) and boxes (N, 2, 3) of the instances whose boxes meet a box, at most `limit`, in no order.

        The boxes are those of the R*Tree: single precision, rounded outward. Without `structure` things only.
        """
        arguments: list[float | int | str] = [*_bounds_of(lower, upper)]
        clauses = "" if structure else " AND i.structure IS NULL"
        wanted = (("confidence >=", min_confidence or None), ("state =", state), ("component =", component))
        for condition, value in wanted:
            if value is not None:
                clauses, arguments = f"{clauses} AND i.{condition} ?", [*arguments, value]
        join = " CROSS JOIN instances i ON i.id = b.id" if clauses else ""
        query = (
            f"SELECT b.id, min_x, min_y, min_z, max_x, max_y, max_z FROM instance_boxes b{join} WHERE {_MEETS}"
            f"{clauses} LIMIT ?"
        )
        rows = np.array(self._connection.rows(query, (*arguments, limit)), dtype=np.float64).reshape(-1, 7)
        return rows[:, 0].astype(np.int64), rows[:, 1:].reshape(-1, 2, 3)

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the box round the boxes of all instances, from the root of the R*Tree; None without any. (2, 3)."""
        rows = self._connection.rows("SELECT data FROM instance_boxes_node WHERE nodeno = 1")
        return _bounds(rows[0][0]) if rows and len(rows[0][0]) >= 4 else None

    def index_again(self) -> None:
        """Fill the R*Tree and the words again from the instances."""
        self._connection.execute("DELETE FROM instance_boxes")
        self._connection.execute("INSERT INTO words (words) VALUES ('delete-all')")
        for instances in self._rows.in_batches():
            self._words.put(instances)
            self._put_boxes((i.id, i.aabb) for i in instances)

    def _put_boxes(self, boxes: Iterable[tuple[int, Array]]) -> None:
        statement = "INSERT OR REPLACE INTO instance_boxes VALUES (?, ?, ?, ?, ?, ?, ?)"
        self._connection.execute_many(statement, [(n, *map(float, aabb.T.ravel())) for n, aabb in boxes])


_MEETS = "max_x >= ? AND min_x <= ? AND max_y >= ? AND min_y <= ? AND max_z >= ? AND min_z <= ?"


def _bounds_of(lower: ArrayLike, upper: ArrayLike) -> tuple[float, ...]:
    low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    return tuple(float(x) for pair in zip(low, high, strict=True) for x in pair)


@lru_cache(maxsize=16)
def _bounds(node: bytes) -> NDArray[np.float64] | None:
    """Box around what a node of the R*Tree holds, None where that is nothing; not to be changed. Shape (2, 3)."""
    count = int.from_bytes(node[2:4], "big")
    cell = np.dtype([("id", ">i8"), ("span", ">f4", 6)])
    if count == 0 or len(node) < 4 + count * cell.itemsize:
        return None
    span = np.frombuffer(node, cell, count, 4)["span"].astype(np.float64)
    bounds = np.stack([span[:, 0::2].min(axis=0), span[:, 1::2].max(axis=0)])
    bounds.setflags(write=False)
    return bounds
