"""The embedded catalogue: one SQLite file on one machine."""

from __future__ import annotations

import contextlib
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.catalog.base import INSTANCE, Backend, Condition, check_dimension, filters_sql, wanted_sql
from list3r.catalog.records import (
    CatalogError,
    CatalogFilters,
    CatalogInstance,
    MemoryContent,
    MemoryEntry,
    Wanted,
)
from list3r.memory.store.search.vectors import unit

_APPLICATION_ID = 0x4C334331
"""ASCII "L3C1"."""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS memory (
    memory_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, path TEXT NOT NULL, revision INTEGER NOT NULL,
    sha256 TEXT NOT NULL, bytes INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, scale_kind TEXT NOT NULL,
    gravity TEXT NOT NULL, instances INTEGER NOT NULL, sessions INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS instance (
    number INTEGER PRIMARY KEY, memory_id INTEGER NOT NULL REFERENCES memory, id INTEGER NOT NULL, label TEXT,
    description TEXT NOT NULL, state TEXT NOT NULL, structure TEXT, confidence REAL NOT NULL, sigma REAL,
    component INTEGER NOT NULL, box BLOB NOT NULL, UNIQUE (memory_id, id));
CREATE VIRTUAL TABLE IF NOT EXISTS bounds USING rtree (
    number, min_x, max_x, min_y, max_y, min_z, max_z, min_memory, max_memory);
CREATE TABLE IF NOT EXISTS word (
    word TEXT NOT NULL, number INTEGER NOT NULL REFERENCES instance, weight INTEGER NOT NULL,
    PRIMARY KEY (word, number)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS relation (
    memory_id INTEGER NOT NULL REFERENCES memory, subject INTEGER NOT NULL, predicate TEXT NOT NULL,
    object INTEGER NOT NULL, confidence REAL NOT NULL, margin REAL NOT NULL,
    PRIMARY KEY (memory_id, subject, predicate, object)) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS relation_by_object ON relation (memory_id, object);
CREATE TABLE IF NOT EXISTS vector (
    space TEXT NOT NULL, memory_id INTEGER NOT NULL REFERENCES memory, id INTEGER NOT NULL, v BLOB NOT NULL,
    PRIMARY KEY (space, memory_id, id)) WITHOUT ROWID;
"""
_FROM = "FROM instance i JOIN memory m ON m.memory_id = i.memory_id"
_OF_MEMORY = "i.memory_id = (SELECT memory_id FROM memory WHERE name = ?)"
_BATCH = 20_000
_GROW = 2.0
"""Factor by which a search distance grows when it finds too few."""


class SqliteBackend(Backend):
    """A catalogue in a file; one process writes while others read."""

    def __init__(self, path: str) -> None:
        """Make the file where there is none. Raises `CatalogError` for one that is no catalogue."""
        self._path = Path(path)
        self._turn = threading.RLock()
        try:
            self._database = sqlite3.connect(path, timeout=30.0, isolation_level=None, check_same_thread=False)
            known = self._database.execute("PRAGMA application_id").fetchone()[0]
            if known not in (0, _APPLICATION_ID) or (known == 0 and self._tables()):
                raise CatalogError(f"{path} is not a catalogue; name another file")
            if known == 0:
                self._database.execute("PRAGMA journal_mode = WAL")
                self._database.executescript(
                    f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA application_id = {_APPLICATION_ID}; COMMIT"
                )
        except sqlite3.Error as error:
            raise CatalogError(f"{path} cannot be opened as a catalogue: {error}; name another file") from error

    def _tables(self) -> bool:
        return bool(self._database.execute("SELECT 1 FROM sqlite_master").fetchone())

    def put(self, content: MemoryContent, *, again: bool = False) -> MemoryEntry:
        with self._writing():
            known = self.memories([content.entry.name])
            before = known[0] if known else content.entry
            if known and not again and replace(content.entry, revision=before.revision) == before:
                return before
            same = bool(known) and before.sha256 == content.entry.sha256
            entry = replace(content.entry, revision=before.revision + (not same))
            if known:
                self._forget(entry.name)
            names = ", ".join(f.name for f in fields(MemoryEntry))
            marks = ", ".join("?" for _ in fields(MemoryEntry))
            row = self._database.execute(f"INSERT INTO memory ({names}) VALUES ({marks})", astuple(entry))
            self._write(int(row.lastrowid or 0), content)
            return entry

    def _write(self, memory: int, content: MemoryContent) -> None:
        database = self._database
        first = int(database.execute("SELECT coalesce(max(number), 0) + 1 FROM instance").fetchone()[0])
        numbered = list(enumerate(content.instances, first))
        marks = ", ".join("?" for _ in range(11))
        rows = ((n, memory, *_columns_of(t), np.array(t.box_numbers(), "<f4").tobytes()) for n, t in numbered)
        database.executemany(f"INSERT INTO instance VALUES ({marks})", rows)
        boxes = ((n, *(v for pair in zip(*t.bounds(), strict=True) for v in pair), memory, memory) for n, t in numbered)
        database.executemany("INSERT INTO bounds VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", boxes)
        database.executemany(
            "INSERT INTO word VALUES (?, ?, ?)",
            sorted((w, n, weight) for n, t in numbered for w, weight in t.words.items()),
        )
        database.executemany(
            "INSERT INTO relation VALUES (?, ?, ?, ?, ?, ?)", ((memory, *r) for r in content.relations)
        )
        for space in content.spaces:
            check_dimension(space, self.dimension(space.space))
            held = zip(space.ids.tolist(), unit(space.vectors).astype("<f2"), strict=True)
            database.executemany(
                "INSERT INTO vector VALUES (?, ?, ?, ?)", ((space.space, memory, n, v.tobytes()) for n, v in held)
            )

    @contextlib.contextmanager
    def loading(self, *, many: bool) -> Iterator[None]:
        yield

    def drop(self, name: str) -> bool:
        with self._writing():
            known = bool(self.memories([name]))
            if known:
                self._forget(name)
            return known

    def _forget(self, name: str) -> None:
        (memory,) = self._database.execute("SELECT memory_id FROM memory WHERE name = ?", (name,)).fetchone()
        own = "SELECT number FROM instance WHERE memory_id = ?"
        for table in ("bounds", "word"):
            self._database.execute(f"DELETE FROM {table} WHERE number IN ({own})", (memory,))
        for table in ("instance", "relation", "vector", "memory"):
            self._database.execute(f"DELETE FROM {table} WHERE memory_id = ?", (memory,))

    def near(
        self, memory: str, point: Sequence[float], k: int, filters: CatalogFilters
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        entry = self.memories([memory])
        return (entry[0], self._near(memory, np.asarray(point, np.float64), k, filters)) if entry else None

    def _near(self, memory: str, at: NDArray[np.float64], k: int, filters: CatalogFilters) -> list[CatalogInstance]:
        """Return the k nearest, within a distance that grows until it holds enough."""
        reach, farthest = 1.0, np.inf
        while True:
            found = self._inside(memory, (at - reach).tolist(), (at + reach).tolist(), filters, -1)
            gaps = [t.aabb_distance(at) for t in found]
            if sum(g <= reach for g in gaps) >= k or reach >= farthest:
                order = sorted(range(len(found)), key=lambda n: (gaps[n], found[n].id))
                return [found[n] for n in order[:k]]
            farthest = self._farthest(memory, at) if np.isinf(farthest) else farthest
            reach *= _GROW

    def _farthest(self, memory: str, point: NDArray[np.float64]) -> float:
        """Return a distance from a point beyond which a memory holds nothing."""
        whole = self._rows(
            "SELECT min(b.min_x), min(b.min_y), min(b.min_z), max(b.max_x), max(b.max_y), max(b.max_z) "
            f"FROM bounds b JOIN instance i ON i.number = b.number WHERE {_OF_MEMORY}",
            (memory,),
        )[0]
        if whole[0] is None:
            return 0.0
        corners = np.array(whole, np.float64).reshape(2, 3)
        return float(np.linalg.norm(np.abs(corners - point).max(axis=0))) + 1.0

    def inside(
        self, memory: str, lower: Sequence[float], upper: Sequence[float], filters: CatalogFilters, limit: int
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        entry = self.memories([memory])
        return (entry[0], self._inside(memory, lower, upper, filters, limit)) if entry else None

    def _inside(
        self, memory: str, lower: Sequence[float], upper: Sequence[float], filters: CatalogFilters, limit: int
    ) -> list[CatalogInstance]:
        """Return instances whose axis-aligned boxes meet a box; all with a negative limit."""
        passing, values = filters_sql(filters, "i")
        low, high = lower, upper
        query = (
            f"SELECT {INSTANCE} FROM bounds b JOIN instance i ON i.number = b.number JOIN memory m USING (memory_id) "
            "WHERE b.min_memory <= (SELECT memory_id FROM memory WHERE name = ?) "
            "AND b.max_memory >= (SELECT memory_id FROM memory WHERE name = ?) "
            "AND b.max_x >= ? AND b.min_x <= ? AND b.max_y >= ? AND b.min_y <= ? AND b.max_z >= ? AND b.min_z <= ? "
            f"AND {passing} ORDER BY i.id LIMIT ?"
        )
        ends = [v for pair in zip(low, high, strict=True) for v in pair]
        return [self._instance(row) for row in self._rows(query, (memory, memory, *ends, *values, limit))]

    def spaces(self, memory: str | None) -> list[str]:
        where, values = ("", ()) if memory is None else (f"WHERE {_OF_MEMORY.replace('i.', '')}", (memory,))
        return [str(s) for (s,) in self._rows(f"SELECT DISTINCT space FROM vector {where} ORDER BY space", values)]

    def dimension(self, space: str) -> int | None:
        rows = self._rows("SELECT length(v) FROM vector WHERE space = ? LIMIT 1", (space,))
        return int(rows[0][0]) // 2 if rows else None

    def vector(self, memory: str, instance_id: int, space: str) -> NDArray[np.float32] | None:
        query = f"SELECT v FROM vector i WHERE space = ? AND {_OF_MEMORY} AND id = ?"
        rows = self._rows(query, (space, memory, instance_id))
        return np.frombuffer(rows[0][0], "<f2").astype(np.float32) if rows else None

    def alike(
        self, memory: str | None, space: str, vector: NDArray[np.float32], k: int, filters: CatalogFilters
    ) -> list[tuple[CatalogInstance, float]]:
        passing, values = filters_sql(filters, "i")
        only, given = ("", ()) if memory is None else (f" AND {_OF_MEMORY}", (memory,))
        query = (
            "SELECT i.number, v.v FROM vector v JOIN instance i ON i.memory_id = v.memory_id AND i.id = v.id "
            f"WHERE v.space = ? AND length(v.v) = ? AND {passing}{only}"
        )
        best = np.zeros((0, 2))
        with self._reading():
            rows = self._database.execute(query, (space, 2 * len(vector), *values, *given))
            while some := rows.fetchmany(_BATCH):
                held = np.frombuffer(b"".join(v for _, v in some), "<f2").reshape(len(some), -1).astype(np.float32)
                both = np.column_stack([held @ vector, [n for n, _ in some]])
                best = np.concatenate([best, both])
                best = best[np.lexsort((best[:, 1], -best[:, 0]))[:k]]
            query = f"SELECT {INSTANCE} {_FROM} WHERE i.number = ?"
            return [(self._instance(self._database.execute(query, (int(n),)).fetchone()), float(c)) for c, n in best]

    def close(self) -> None:
        self._database.close()

    def _of(self, memory: str, alias: str) -> Condition:
        return _OF_MEMORY.replace("i.", f"{alias}."), [memory]

    def _wanted(self, wanted: Wanted, alias: str, memory: str | None, *, nested: bool = False) -> Condition:
        return wanted_sql(wanted, alias, _bearing if memory is None else _bearing_here)

    def _weight(self, words: Sequence[str]) -> Condition:
        marks = ", ".join("?" for _ in words)
        return f"(SELECT avg(weight) FROM word w WHERE w.number = i.number AND w.word IN ({marks}))", list(words)

    def _box(self, stored: Any) -> NDArray[np.float64]:
        return np.frombuffer(stored, "<f4").astype(np.float64)

    def _rows(self, query: str, values: Sequence[Any]) -> list[Any]:
        with self._reading():
            return self._database.execute(query, values).fetchall()

    @contextlib.contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            with self._turn:
                yield
        except sqlite3.Error as error:
            raise CatalogError(
                f"{self._path} cannot be read: {error}; `list3r catalog rebuild` makes a new one"
            ) from error

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._database.in_transaction:  # SQLite ends it itself where the disk is full
                    self._database.execute("ROLLBACK")
                raise
            self._database.execute("COMMIT")
        except sqlite3.Error as error:
            raise CatalogError(f"{self._path} cannot be written: {error}; nothing was changed") from error


def _columns_of(t: CatalogInstance) -> tuple[object, ...]:
    return t.id, t.label, t.description, t.state, t.structure, t.confidence, t.sigma, t.component


def _bearing(alias: str, words: Sequence[str]) -> tuple[str, list[Any]]:
    """Over all memories: instances are looked up by word."""
    one = f"{alias}.number IN (SELECT number FROM word WHERE word = ?)"
    return " AND ".join([one] * len(words)), list(words)


def _bearing_here(alias: str, words: Sequence[str]) -> tuple[str, list[Any]]:
    """In one memory: each of its instances is tested."""
    one = f"EXISTS (SELECT 1 FROM word WHERE word = ? AND number = {alias}.number)"
    return " AND ".join([one] * len(words)), list(words)
