"""Instances of the library, by id and by place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.errors import UnknownIdError
from list3r.memory.records import Instance
from list3r.memory.store.instance_rows import COLUMNS, instance_row, read_instance
from list3r.memory.store.tables.embeddings import EmbeddingVerbs

_BATCH = 500
"""Rows asked for by id in one statement."""


class InstanceVerbs(EmbeddingVerbs):
    """Writing and reading the library: instances and the boxes in which they lie. Writing verbs are called inside
    `transaction()`."""

    def instances(self, *, structure: bool | None = None) -> list[Instance]:
        """All instances by id; only structure or only things where asked."""
        where = {None: "", True: "WHERE structure IS NOT NULL", False: "WHERE structure IS NULL"}[structure]
        rows = self._rows(f"SELECT {COLUMNS} FROM instances {where} ORDER BY id")
        return [read_instance(row) for row in self._believed("instances", rows)]

    def instance(self, instance_id: int) -> Instance:
        """One instance; an alias gives the instance it was merged into. Raises `UnknownIdError`."""
        resolved = self.resolve(instance_id)
        rows = self._rows(f"SELECT {COLUMNS} FROM instances WHERE id = ?", (resolved,))
        return read_instance(self._believed("instances", rows)[0])

    def instances_of(self, ids: Sequence[int]) -> list[Instance]:
        """The instances of these ids that are there, in the order of `ids`; aliases are not resolved."""
        found: dict[int, Instance] = {}
        for start in range(0, len(ids), _BATCH):
            part = [int(i) for i in ids[start : start + _BATCH]]
            marks = ",".join("?" * len(part))
            rows = self._rows(f"SELECT {COLUMNS} FROM instances WHERE id IN ({marks})", tuple(part))
            for row in self._believed("instances", rows):
                found[row[0]] = read_instance(row)
        return [found[i] for i in map(int, ids) if i in found]

    def resolve(self, instance_id: int) -> int:
        """The id that stands for an id today. Raises `UnknownIdError` for an id the memory has never held."""
        seen = set()
        current = int(instance_id)
        while current not in seen:
            seen.add(current)
            if self._rows("SELECT 1 FROM instances WHERE id = ?", (current,)):
                return current
            target = self._rows("SELECT instance FROM aliases WHERE id = ?", (current,))
            if not target:
                break
            current = int(target[0][0])
        raise UnknownIdError(f"{self.path} has no instance {instance_id}; `list3r list {self.path}` shows the ids")

    def put_instances(self, instances: Iterable[Instance]) -> None:
        """Write instances, new or changed, with their boxes in the R*Tree."""
        rows = list(instances)
        marks = ",".join("?" * 18)
        self._database.executemany(
            f"INSERT OR REPLACE INTO instances ({COLUMNS}) VALUES ({marks})", [instance_row(i) for i in rows]
        )
        self._database.executemany(
            "INSERT OR REPLACE INTO instance_boxes VALUES (?, ?, ?, ?, ?, ?, ?)",
            [(i.id, *(float(x) for x in i.aabb.T.ravel())) for i in rows],
        )

    def drop_instance(self, instance_id: int, alias_of: int | None) -> None:
        """Take an instance out; its id lives on as an alias of another, or resolves no more."""
        self.vectors_touched.append(int(instance_id))
        for table, column in (
            ("instances", "id"),
            ("instance_boxes", "id"),
            ("embeddings", "instance"),
            ("anchors", "instance"),
        ):
            self._database.execute(f"DELETE FROM {table} WHERE {column} = ?", (instance_id,))
        self._database.execute("DELETE FROM relations WHERE subject = ? OR object = ?", (instance_id, instance_id))
        if alias_of is not None:
            query = "UPDATE OR IGNORE events SET instance = ? WHERE instance = ?"
            self._database.execute(query, (alias_of, instance_id))
        self._database.execute("DELETE FROM events WHERE instance = ?", (instance_id,))
        if alias_of is not None:
            self._database.execute("INSERT OR REPLACE INTO aliases VALUES (?, ?)", (instance_id, alias_of))

    def states(self) -> dict[int, tuple[str, int]]:
        """State and component of every instance, by id."""
        return {n: (state, part) for n, state, part in self._rows("SELECT id, state, component FROM instances")}

    def set_states(self, states: Mapping[int, str]) -> None:
        """Write the state of instances, by id."""
        self._database.executemany(
            "UPDATE instances SET state = ? WHERE id = ?", [(state, n) for n, state in sorted(states.items())]
        )

    def instance_count(self) -> tuple[int, int]:
        """How many things and how many pieces of structure there are."""
        total, things = self._rows("SELECT count(*), count(*) - count(structure) FROM instances")[0]
        return int(things), int(total) - int(things)

    def next_id(self) -> int:
        """The smallest id that was never used; ids are not used again."""
        query = "SELECT max((SELECT coalesce(max(id), 0) FROM instances), (SELECT coalesce(max(id), 0) FROM aliases))"
        return max(int(self._rows(query)[0][0]), int(self.get_value("last_id", 0))) + 1

    def aliases(self) -> dict[int, int]:
        """Every retired id and the id it was merged into."""
        return {r[0]: r[1] for r in self._rows("SELECT id, instance FROM aliases ORDER BY id")}

    def aliases_of(self, instance_id: int) -> list[int]:
        """Retired ids that stand for an instance (no alias) today, ascending."""
        older: dict[int, list[int]] = {}
        for old, new in self.aliases().items():
            older.setdefault(new, []).append(old)
        found, waiting = set[int](), [instance_id]
        while waiting:
            fresh = [n for n in older.get(waiting.pop(), []) if n not in found]
            found.update(fresh)
            waiting += fresh
        return sorted(found)

    def ids_in_box(self, lower: ArrayLike, upper: ArrayLike) -> list[int]:
        """Ids whose axis-aligned boxes meet the box, from the R*Tree. World coordinates, shape (3,) each."""
        low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        query = (
            "SELECT id FROM instance_boxes WHERE max_x >= ? AND min_x <= ? AND max_y >= ? AND min_y <= ?"
            " AND max_z >= ? AND min_z <= ? ORDER BY id"
        )
        arguments = tuple(float(x) for pair in zip(low, high, strict=True) for x in pair)
        return [r[0] for r in self._rows(query, arguments)]

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
        """Ids (N,) and boxes (N, 2, 3) of the instances whose boxes meet a box, at most `limit`, in no order.

        The boxes are those of the R*Tree: single precision, rounded outward. Without `structure` things only.
        """
        low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        arguments: list[float | int | str] = [float(x) for pair in zip(low, high, strict=True) for x in pair]
        clauses = ""
        if not structure:
            clauses += " AND i.structure IS NULL"
        if min_confidence > 0.0:
            clauses, arguments = f"{clauses} AND i.confidence >= ?", [*arguments, min_confidence]
        if state is not None:
            clauses, arguments = f"{clauses} AND i.state = ?", [*arguments, state]
        if component is not None:
            clauses, arguments = f"{clauses} AND i.component = ?", [*arguments, component]
        join = " CROSS JOIN instances i ON i.id = b.id" if clauses else ""
        query = (
            f"SELECT b.id, b.min_x, b.min_y, b.min_z, b.max_x, b.max_y, b.max_z FROM instance_boxes b{join}"
            " WHERE b.max_x >= ? AND b.min_x <= ? AND b.max_y >= ? AND b.min_y <= ? AND b.max_z >= ? AND b.min_z <= ?"
            f"{clauses} LIMIT ?"
        )
        rows = np.array(self._rows(query, (*arguments, limit)), dtype=np.float64).reshape(-1, 7)
        return rows[:, 0].astype(np.int64), rows[:, 1:].reshape(-1, 2, 3)

    def world_bounds(self) -> NDArray[np.float64] | None:
        """Box around the boxes of all instances, read off the root of the R*Tree; None without any. Shape (2, 3)."""
        rows = self._rows("SELECT data FROM instance_boxes_node WHERE nodeno = 1")
        if not rows or len(rows[0][0]) < 4:
            return None
        return _bounds(rows[0][0])


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
