"""Interface of a catalogue's database, and the database of a URL."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.catalog.records import CatalogFilters, CatalogInstance, MemoryContent, MemoryEntry, Wanted

MOST_RANKED = 2_000
"""Most instances that match some words and are ranked; of more, any of them."""


class Backend(Protocol):
    """A database that holds a catalogue. Each call sees one state of it. Raises `CatalogError`."""

    def put(self, content: MemoryContent, *, again: bool = False) -> MemoryEntry:
        """Write a memory in place of the one with its name; the same file only with `again`. Return its entry, with the
        next revision where the file differs.
        """
        ...

    def loading(self, *, many: bool) -> AbstractContextManager[None]:
        """Write memories meanwhile; where they are `many`, indices that cost more kept up are made again at the end."""
        ...

    def drop(self, name: str) -> bool:
        """Forget a memory; whether there was one."""
        ...

    def memories(self, names: Sequence[str] | None = None) -> list[MemoryEntry]:
        """Return entries by name, all or some."""
        ...

    def instance(self, memory: str, instance_id: int) -> CatalogInstance | None:
        """Return one instance."""
        ...

    def near(
        self, memory: str, point: Sequence[float], k: int, filters: CatalogFilters
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        """Return a memory and its k instances whose axis-aligned boxes are nearest to a point, the nearest first.

        None where there is no memory of that name.
        """
        ...

    def inside(
        self, memory: str, lower: Sequence[float], upper: Sequence[float], filters: CatalogFilters, limit: int
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        """Return a memory and its instances whose axis-aligned boxes meet a box; None where there is no such memory."""
        ...

    def named(
        self, memory: str | None, wanted: Wanted, k: int, filters: CatalogFilters
    ) -> tuple[list[tuple[CatalogInstance, float]], int]:
        """Return the k that are wanted with how well the words name them, the best first, and how many were ranked."""
        ...

    def related(
        self, memory: str | None, subject: Wanted, predicate: str | None, object: Wanted, k: int
    ) -> list[tuple[str, int, str, str, int, str, float, float]]:
        """Return memory, subject and its name, predicate, object and its name, confidence, margin."""
        ...

    def spaces(self, memory: str | None) -> list[str]:
        """Return the names of spaces that hold vectors."""
        ...

    def dimension(self, space: str) -> int | None:
        """Return how many numbers the vectors of a space have; None where it has none."""
        ...

    def vector(self, memory: str, instance_id: int, space: str) -> NDArray[np.float32] | None:
        """Return the vector of an instance. Shape (D,)."""
        ...

    def alike(
        self, memory: str | None, space: str, vector: NDArray[np.float32], k: int, filters: CatalogFilters
    ) -> list[tuple[CatalogInstance, float]]:
        """Return the k instances with the highest cosine to a unit vector, the most similar first."""
        ...

    def alive(self) -> bool:
        """Whether the database answers."""
        ...

    def close(self) -> None:
        """Let the database go."""
        ...


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
        marks = ", ".join("?" for _ in predicates)
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
