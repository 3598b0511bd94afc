"""Interface of a catalogue's database, and the database of a URL."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.catalog.records import (
    CatalogError,
    CatalogFilters,
    CatalogInstance,
    MemoryContent,
    MemoryEntry,
    SpaceVectors,
    Wanted,
)
from list3r.memory.core.geometry import OrientedBox

MOST_RANKED = 2_000
"""Most instances that match some words and are ranked; of more, any of them."""


_ENTRY = ", ".join(f"m.{f.name}" for f in fields(MemoryEntry))
_FIELDS = [f.name for f in fields(CatalogInstance)][:9]
OF_ONE = ", ".join(f"i.{name}" for name in (*_FIELDS[1:], "box"))
INSTANCE = f"m.name, {OF_ONE}"
Condition = tuple[str, list[Any]]
"""Text with `?` for values, and the values."""


class Backend(ABC):
    """A database that holds a catalogue. Each call sees one state of it. Raises `CatalogError`."""

    @abstractmethod
    def put(self, content: MemoryContent, *, again: bool = False) -> MemoryEntry:
        """Write a memory in place of the one with its name; the same file only with `again`. Return its entry, with the
        new revision.
        """

    @abstractmethod
    def loading(self, *, many: bool) -> AbstractContextManager[None]:
        """Write memories meanwhile; where they are `many`, indices that cost more kept up are made again at the end."""

    @abstractmethod
    def drop(self, name: str) -> bool:
        """Forget a memory; whether there was one."""

    def memories(self, names: Sequence[str] | None = None) -> list[MemoryEntry]:
        """Return entries by name, all or some."""
        return [MemoryEntry(*row[1:]) for row in self._entries(names)]

    def _entries(self, names: Sequence[str] | None) -> list[Any]:
        """Return number and entry of memories by name."""
        where = "" if names is None else f" WHERE m.name IN ({_marks(names)})"
        query = f"SELECT m.memory_id, {_ENTRY} FROM memory m{where} ORDER BY m.name"
        return [] if names is not None and not names else self._rows(query, names or ())

    def instance(self, memory: str, instance_id: int) -> CatalogInstance | None:
        """Return one instance."""
        here, values = self._of(memory, "i")
        rows = self._rows(f"SELECT {OF_ONE} FROM instance i WHERE {here} AND i.id = ?", (*values, instance_id))
        return self._instance((memory, *rows[0])) if rows else None

    @abstractmethod
    def near(
        self, memory: str, point: Sequence[float], k: int, filters: CatalogFilters
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        """Return a memory and its k instances whose axis-aligned boxes are nearest to a point, the nearest first.

        None where there is no such memory.
        """

    @abstractmethod
    def inside(
        self, memory: str, lower: Sequence[float], upper: Sequence[float], filters: CatalogFilters, limit: int
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        """Return a memory and its instances whose axis-aligned boxes meet a box; None where there is no such memory."""

    def named(
        self, memory: str | None, wanted: Wanted, k: int, filters: CatalogFilters
    ) -> tuple[list[tuple[CatalogInstance, float]], int]:
        """Return the k that are wanted with how well the words name them, the best first, and how many were ranked."""
        conditions = [self._wanted(wanted, "i", memory), filters_sql(filters, "i")]
        if memory is not None:
            conditions.append(self._of(memory, "i"))
        where, values = _all(conditions)
        weight, words = self._weight(wanted.words)
        query = (
            f"WITH chosen AS MATERIALIZED (SELECT i.* FROM instance i WHERE {where} LIMIT {MOST_RANKED}) "
            f"SELECT {INSTANCE}, coalesce({weight}, 100) AS weight, (SELECT count(*) FROM chosen) "
            "FROM chosen i JOIN memory m USING (memory_id) "
            "ORDER BY weight DESC, i.confidence DESC, m.name, i.id LIMIT ?"
        )
        rows = self._rows(query, (*values, *words, k))
        return [(self._instance(r[:-2]), float(r[-2]) / 100.0) for r in rows], int(rows[0][-1]) if rows else 0

    def related(
        self, memory: str | None, subject: Wanted, predicate: str | None, object: Wanted, k: int
    ) -> list[tuple[str, int, str, str, int, str, float, float]]:
        """Return memory, subject and its name, predicate, object and its name, confidence, margin; the surest first."""
        conditions = [self._wanted(subject, "s", memory, nested=True), self._wanted(object, "o", memory, nested=True)]
        if memory is not None:
            conditions.append(self._of(memory, "r"))
        if predicate is not None:
            conditions.append(("r.predicate = ?", [predicate]))
        where, values = _all(conditions)
        query = (
            "SELECT m.name, r.subject, coalesce(s.label, s.description), r.predicate, r.object, "
            "coalesce(o.label, o.description), r.confidence, r.margin FROM relation r "
            "JOIN instance s ON s.memory_id = r.memory_id AND s.id = r.subject "
            "JOIN instance o ON o.memory_id = r.memory_id AND o.id = r.object "
            "JOIN memory m ON m.memory_id = r.memory_id "
            f"WHERE {where} ORDER BY r.confidence DESC, m.name, r.subject, r.predicate, r.object LIMIT ?"
        )
        return [tuple(row) for row in self._rows(query, (*values, k))]

    @abstractmethod
    def spaces(self, memory: str | None) -> list[str]:
        """Return the names of spaces that hold vectors."""

    @abstractmethod
    def dimension(self, space: str) -> int | None:
        """Return how many numbers the vectors of a space have; None where it has none."""

    @abstractmethod
    def vector(self, memory: str, instance_id: int, space: str) -> NDArray[np.float32] | None:
        """Return the vector of an instance. Shape (D,)."""

    @abstractmethod
    def alike(
        self, memory: str | None, space: str, vector: NDArray[np.float32], k: int, filters: CatalogFilters
    ) -> list[tuple[CatalogInstance, float]]:
        """Return the k instances with the highest cosine to a unit vector, the most similar first."""

    def alive(self) -> bool:
        """Whether the database answers."""
        try:
            self._rows("SELECT 1 FROM memory LIMIT 1", ())
        except CatalogError:
            return False
        return True

    @abstractmethod
    def close(self) -> None:
        """Let the database go."""

    @abstractmethod
    def _rows(self, query: str, values: Sequence[Any]) -> list[Any]:
        """Return the answer to a query with `?` for values."""

    @abstractmethod
    def _of(self, memory: str, alias: str) -> Condition:
        """Return the condition that a row is of a memory."""

    @abstractmethod
    def _wanted(self, wanted: Wanted, alias: str, memory: str | None, *, nested: bool = False) -> Condition:
        """Return the condition that an instance is wanted, of `memory` or of any; `nested` in a query of relations."""

    @abstractmethod
    def _weight(self, words: Sequence[str]) -> Condition:
        """Return how well words name an instance `i` on average, in hundredths; NULL for no words."""

    @abstractmethod
    def _box(self, stored: Any) -> NDArray[np.float64]:
        """Return the 15 numbers of a box as it is stored."""

    def _instance(self, row: Any) -> CatalogInstance:
        """Return an instance of a row of its memory's name and `OF_ONE`."""
        box = self._box(row[9])
        values = dict(zip(_FIELDS, row[:9], strict=True))
        return CatalogInstance(**values, box=OrientedBox(box[:3], box[3:6], box[6:].reshape(3, 3)), words={})


def check_dimension(held: SpaceVectors, known: int | None) -> None:
    """Raise `CatalogError` for vectors of another dimension than a space is known to have."""
    numbers = held.vectors.shape[1]
    if known is not None and numbers != known:
        raise CatalogError(f"vectors of {numbers} numbers do not belong to {held.space}, which has {known}")


def _all(conditions: Sequence[Condition]) -> Condition:
    return " AND ".join(text for text, _ in conditions), [v for _, values in conditions for v in values]


def _marks(values: Sequence[Any]) -> str:
    return ", ".join("?" for _ in values)


def wanted_sql(
    wanted: Wanted, alias: str, words: Any, *, joined: bool = False, depth: int = 0
) -> tuple[str, list[Any]]:
    """Return the condition (with `?` for values) that an instance is wanted, and its values.

    `words` makes the condition of having words, of an alias and the words. Relations are looked up for each instance
    with the words: OFFSET keeps PostgreSQL from a join, which takes minutes in one memory without statistics. Over all
    memories a join from the rarer end is many times faster: `joined`.
    """
    parts, values = ["TRUE"], []
    if wanted.words:
        text, given = words(alias, wanted.words)
        parts.append(text)
        values += given
    if wanted.instance_id is not None:
        parts.append(f"{alias}.id = ?")
        values.append(wanted.instance_id)
    for predicates, object in wanted.where:
        o, r = f"o{depth}", f"r{depth}"
        text, given = wanted_sql(object, o, words, joined=joined, depth=depth + 1)
        marks = _marks(predicates)
        ends = (
            f"FROM relation {r} JOIN instance {o} ON {o}.memory_id = {r}.memory_id AND {o}.id = {r}.object "
            f"WHERE {r}.predicate IN ({marks}) AND {text}"
        )
        if joined:
            parts.append(f"({alias}.memory_id, {alias}.id) IN (SELECT {r}.memory_id, {r}.subject {ends})")
        else:
            own = f"{r}.memory_id = {alias}.memory_id AND {r}.subject = {alias}.id"
            parts.append(f"EXISTS (SELECT 1 {ends} AND {own} LIMIT 1 OFFSET 0)")
        values += [*predicates, *given]
    return " AND ".join(parts), values


def filters_sql(filters: CatalogFilters, alias: str) -> tuple[str, list[Any]]:
    """Return the condition (with `?` for values) that an instance passes the filters, and its values."""
    parts, values = [f"{alias}.confidence >= ?"], [filters.min_confidence]
    if not filters.structure:
        parts.append(f"{alias}.structure IS NULL")
    if filters.state is None:
        parts.append(f"{alias}.state <> 'removed'")
    elif filters.state != "any":
        parts.append(f"{alias}.state = ?")
        values.append(filters.state)  # type: ignore[arg-type]
    return " AND ".join(parts), values
