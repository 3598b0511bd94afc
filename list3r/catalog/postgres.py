"""A catalogue in PostgreSQL: boxes by `cube` and `btree_gist`, words by GIN, vectors by `pgvector`."""

from __future__ import annotations

import contextlib
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields, replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psycopg
from numpy.typing import NDArray

from list3r.catalog.base import INSTANCE, OF_ONE, Backend, Condition, check_dimension, filters_sql, wanted_sql
from list3r.catalog.postgres_connections import Connections
from list3r.catalog.postgres_schema import SCHEMA, SCHEMA_VERSION, lists_of, vector_index, vector_table
from list3r.catalog.records import (
    CatalogError,
    CatalogFilters,
    CatalogInstance,
    MemoryContent,
    MemoryEntry,
    SpaceVectors,
    Wanted,
)
from list3r.memory.store.search.vectors import unit

_ENTRY_FIELDS = fields(MemoryEntry)
_ENTRY = ", ".join(f"m.{f.name}" for f in _ENTRY_FIELDS)
_BUILD_MEMORY = "2GB"
"""Memory of the server while it makes an index of vectors."""
_MOST_ALIKE = 10_000
"""Vectors scanned at most when few of the most similar pass the filters."""
_WIDE, _LISTS_OF_WIDE = 128, 20
"""Vectors with more numbers than the first are searched in as many lists as the second says, instead of 40: they take
longer to compare, and fewer lists find as many. research/storage 0141."""
_WRITTEN = "written"
_SCHEMA_LOCK = 0x4C334331
"""Number of the advisory lock under which the schema is made."""


class PostgresBackend(Backend):
    """A catalogue that many read and write at once. Credentials come from the environment or a service file."""

    def __init__(self, url: str, connections: int = 1) -> None:
        """Connect, and bring the schema up to date where this user may. Raises `CatalogError`."""
        self._where = _checked(url)
        self._connections = Connections(url, connections)
        self._numbers: dict[str, int] = {}
        with self._connected("opened") as connection, connection.transaction():
            self.has_vectors = _made(connection)

    # ------------------------------------------------------------------ writing

    def put(self, content: MemoryContent, *, again: bool = False) -> MemoryEntry:
        with self._connected(_WRITTEN) as connection, connection.transaction():
            spaces = self._spaces_for(connection, content.spaces)
            names, marks = ", ".join(f.name for f in _ENTRY_FIELDS), ", ".join("%s" for _ in _ENTRY_FIELDS)
            statement = (
                f"INSERT INTO memory ({names}) VALUES ({marks}) ON CONFLICT (name) DO UPDATE SET name = excluded.name "
                f"RETURNING memory_id, {_ENTRY.replace('m.', 'memory.')}"
            )
            row = _first(connection.execute(statement, astuple(content.entry)))
            memory, known = int(row[0]), MemoryEntry(*row[1:])
            if known.revision and not again and replace(content.entry, revision=known.revision) == known:
                return known
            same = known.revision and known.sha256 == content.entry.sha256
            entry = replace(content.entry, revision=known.revision + (not same))
            own = ", ".join(f"{f.name} = %s" for f in _ENTRY_FIELDS)
            connection.execute(
                f"UPDATE memory SET {own}, added_at = now() WHERE memory_id = %s", (*astuple(entry), memory)
            )
            if known.revision:
                self._forget(connection, memory)
            _copy_instances(connection, memory, content)
            for space, held in spaces:
                _copy_vectors(connection, memory, space, held)
            return entry

    def _spaces_for(
        self, connection: psycopg.Connection[Any], spaces: Sequence[SpaceVectors]
    ) -> list[tuple[int, SpaceVectors]]:
        """Return the number of each space that has vectors here; the table of a new one is made."""
        out = []
        for held in spaces if self.has_vectors else ():
            dimension = held.vectors.shape[1]
            known = _first(connection.execute("SELECT space_id, dimension FROM space WHERE name = %s", (held.space,)))
            if not known:
                connection.execute("SELECT pg_advisory_xact_lock(%s)", (_SCHEMA_LOCK,))
                known = _first(
                    connection.execute("SELECT space_id, dimension FROM space WHERE name = %s", (held.space,))
                )
            if not known:
                statement = "INSERT INTO space (name, dimension) VALUES (%s, %s) RETURNING space_id, dimension"
                known = _first(connection.execute(statement, (held.space, dimension)))
                connection.execute(vector_table(known[0], dimension).encode())
            check_dimension(held, known[1])
            out.append((int(known[0]), held))
        return out

    def drop(self, name: str) -> bool:
        with self._connected(_WRITTEN) as connection, connection.transaction():
            known = _first(connection.execute("DELETE FROM memory WHERE name = %s RETURNING memory_id", (name,)))
            if known:
                self._forget(connection, int(known[0]))
            return bool(known)

    def _forget(self, connection: psycopg.Connection[Any], memory: int) -> None:
        tables = ["instance", "relation"]
        tables += [f"vector_{int(n)}" for (n,) in connection.execute("SELECT space_id FROM space").fetchall()]
        for table in tables:
            connection.execute(f"DELETE FROM {table} WHERE memory_id = %s", (memory,))

    @contextlib.contextmanager
    def loading(self, *, many: bool) -> Iterator[None]:
        """Write memories; at the end vectors that have become many get an index, or one of more lists.

        Where `many` are written, indices are made again at the end and not kept up meanwhile: until then `similar` over
        all compares all vectors. An index that is missing, since a load was ended, is made.
        """
        if many:
            with self._connected(_WRITTEN) as connection:
                for (n,) in connection.execute("SELECT space_id FROM space").fetchall():
                    connection.execute(f"DROP INDEX IF EXISTS vector_{int(n)}_alike")
        yield
        with self._connected(_WRITTEN) as connection, _unhurried(connection):
            for (n,) in connection.execute("SELECT space_id FROM space ORDER BY space_id").fetchall():
                _keep_index(connection, n)
            if many:
                connection.execute("ANALYZE")

    # ------------------------------------------------------------------ asking

    def _entries(self, names: Sequence[str] | None) -> list[Any]:
        rows = super()._entries(names)
        self._numbers |= {str(name): int(number) for number, name, *_ in rows}
        return rows

    def near(
        self, memory: str, point: Sequence[float], k: int, filters: CatalogFilters
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        passing, values = filters_sql(filters, "i")
        return self._placed(memory, f"{passing} ORDER BY i.bounds <-> ?::cube LIMIT ?", [*values, _corner(point), k])

    def inside(
        self, memory: str, lower: Sequence[float], upper: Sequence[float], filters: CatalogFilters, limit: int
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        passing, values = filters_sql(filters, "i")
        region = f"{_corner(lower)},{_corner(upper)}"
        given = [region, *values, None if limit < 0 else limit]
        return self._placed(memory, f"i.bounds && ?::cube AND {passing} ORDER BY i.id LIMIT ?", given)

    def _placed(
        self, memory: str, which: str, values: Sequence[Any]
    ) -> tuple[MemoryEntry, list[CatalogInstance]] | None:
        """Return a memory and its instances that meet a condition, in one round trip. With the known number of the
        memory the plan reads one partition; if it is gone, it is looked up again. It is passed with the type of the
        column: psycopg sends small numbers as `smallint`, for which the index of (memory, box) is scanned over all
        memories of the partition.
        """
        chosen = f"(SELECT {OF_ONE} FROM instance i WHERE i.memory_id = ?::integer AND {which}) i"
        query = f"SELECT {_ENTRY}, i.* FROM memory m LEFT JOIN {chosen} ON TRUE WHERE m.memory_id = ?"
        for _ in range(2):
            number = self._number(memory)
            rows = self._rows(query, (number, *values, number)) if number else []
            if rows:
                entry = MemoryEntry(*rows[0][: len(_ENTRY_FIELDS)])
                of_instances = (row[len(_ENTRY_FIELDS) :] for row in rows)
                return entry, [self._instance((memory, *row)) for row in of_instances if row[0] is not None]
            self._numbers.pop(memory, None)
        return None

    def spaces(self, memory: str | None) -> list[str]:
        self._need_vectors()
        known = self._rows("SELECT name, space_id FROM space ORDER BY name", ())
        if memory is None:
            return [str(name) for name, _ in known]
        query, number = "SELECT EXISTS (SELECT 1 FROM vector_{} WHERE memory_id = ?)", self._number(memory)
        return [str(name) for name, n in known if self._rows(query.format(int(n)), (number,))[0][0]]

    def dimension(self, space: str) -> int | None:
        self._need_vectors()
        rows = self._rows("SELECT dimension FROM space WHERE name = ?", (space,))
        return int(rows[0][0]) if rows else None

    def _need_vectors(self) -> None:
        if not self.has_vectors:
            raise CatalogError(
                f"the server at {self._where} has no pgvector; install it and run `list3r catalog rebuild`"
            )

    def vector(self, memory: str, instance_id: int, space: str) -> NDArray[np.float32] | None:
        query = f"SELECT v::real[] FROM vector_{self._space(space)} WHERE memory_id = ? AND id = ?"
        rows = self._rows(query, (self._number(memory), instance_id))
        return np.array(rows[0][0], np.float32) if rows else None

    def alike(
        self, memory: str | None, space: str, vector: NDArray[np.float32], k: int, filters: CatalogFilters
    ) -> list[tuple[CatalogInstance, float]]:
        """Return the k most similar: exact in one memory, over all through the index of vectors. Ties are ordered by
        name and id, so that an answer does not depend on the order in which memories were written.
        """
        asked, count = _halfvec(vector), k
        only, apart = "", "v <=> ?::halfvec"
        given: tuple[int, ...] = ()
        if memory is not None:  # an order by the sum is one that the index of vectors does not know
            only, apart, given = " WHERE memory_id = ?", f"({apart}) + 0", (self._number(memory),)
        query = (
            f"SELECT memory_id, id, 1 - apart FROM (SELECT memory_id, id, v <=> ?::halfvec AS apart "
            f"FROM vector_{self._space(space)}{only} ORDER BY {apart} FETCH FIRST (?) ROWS WITH TIES) near LIMIT ?"
        )
        ask = self._rows if len(vector) <= _WIDE else self._rows_in_fewer_lists
        while True:
            rows = ask(query, (asked, *given, asked, count, _MOST_ALIKE))
            found = self._passing([row[:2] for row in rows], filters)
            out = [(found[n, i], float(c)) for n, i, c in rows if (n, i) in found]
            if len(out) >= k or len(rows) < count or count >= _MOST_ALIKE:
                return sorted(out, key=lambda f: (-f[1], f[0].memory, f[0].id))[:k]
            count = min(4 * count, _MOST_ALIKE)

    def _passing(self, ids: Sequence[Any], filters: CatalogFilters) -> dict[tuple[int, int], CatalogInstance]:
        """Return the given instances that pass the filters, by memory and id."""
        passing, values = filters_sql(filters, "i")
        query = (
            f"SELECT {INSTANCE}, i.memory_id FROM unnest(?::integer[], ?::bigint[]) a (memory_id, id) "
            f"JOIN instance i USING (memory_id, id) JOIN memory m USING (memory_id) WHERE {passing}"
        )
        rows = self._rows(query, ([n for n, _ in ids], [i for _, i in ids], *values))
        return {(int(row[-1]), int(row[1])): self._instance(row[:-1]) for row in rows}

    def _number(self, memory: str) -> int:
        """Return the number that a memory had when it was last asked for, 0 where there is none of that name.

        A number is never given twice: that of a memory which is gone leads to nothing.
        """
        if memory not in self._numbers:
            self.memories([memory])
        return self._numbers.get(memory, 0)

    def _space(self, space: str) -> int:
        rows = self._rows("SELECT space_id FROM space WHERE name = ?", (space,))
        if not rows:
            raise CatalogError(f"the catalogue at {self._where} has no vectors of {space}")
        return int(rows[0][0])

    def close(self) -> None:
        self._connections.close()

    def _of(self, memory: str, alias: str) -> Condition:
        return f"{alias}.memory_id = ?", [self._number(memory)]

    def _wanted(self, wanted: Wanted, alias: str, memory: str | None, *, nested: bool = False) -> Condition:
        return wanted_sql(wanted, alias, _bearing, joined=memory is None and not nested)

    def _weight(self, words: Sequence[str]) -> Condition:
        return "(SELECT avg(w.n) FROM unnest(i.words, i.weights) w (word, n) WHERE w.word = ANY(?))", [list(words)]

    def _box(self, stored: Any) -> NDArray[np.float64]:
        return np.array(stored, np.float64)

    def _rows(self, query: str, values: Sequence[Any]) -> list[Any]:
        """Ask; once more where the connection was lost, as when the server was started again meanwhile."""
        try:
            with self._connections.one() as connection:
                return _asked(connection, query, values)
        except psycopg.OperationalError as error:
            if not _lost(error):
                raise self._failed("asked", error) from error
        except psycopg.Error as error:
            raise self._failed("asked", error) from error
        with self._connected("asked") as connection:
            return _asked(connection, query, values)

    def _rows_in_fewer_lists(self, query: str, values: Sequence[Any]) -> list[Any]:
        with self._connected("asked") as connection, connection.transaction():
            connection.execute(f"SET LOCAL ivfflat.probes = {_LISTS_OF_WIDE}")
            return _asked(connection, query, values)

    @contextlib.contextmanager
    def _connected(self, what: str) -> Iterator[psycopg.Connection[Any]]:
        try:
            with self._connections.one() as connection:
                yield connection
        except psycopg.Error as error:
            raise self._failed(what, error) from error

    def _failed(self, what: str, error: psycopg.Error) -> CatalogError:
        if what == _WRITTEN:
            what += "; running the same command again is safe" if _lost(error) else "; nothing was changed"
        return CatalogError(f"the catalogue at {self._where} cannot be {what}: {_first_line(error)}")


def _lost(error: psycopg.Error) -> bool:
    """Whether the connection was lost, so that the end of a running transaction is unknown."""
    return isinstance(error, psycopg.OperationalError) and (error.sqlstate or "08").startswith(("57P", "08"))


def _asked(connection: psycopg.Connection[Any], query: str, values: Sequence[Any]) -> list[Any]:
    found: list[Any] = connection.execute(_marked(query), values, binary=True).fetchall()
    return found


def _checked(url: str) -> str:
    """Return host and name of a URL for messages. Raises `CatalogError` for one that carries a password."""
    parts = urlsplit(url)
    if parts.password is not None or "password=" in parts.query:
        raise CatalogError(
            "a password in the URL can be read by everyone on this machine; "
            "put it into PGPASSWORD, ~/.pgpass or a service file"
        )
    return f"{parts.hostname or 'this machine'}{parts.path}"


def _first_line(error: Exception) -> str:
    """Return the message of the server or the library in one line."""
    text = getattr(getattr(error, "diag", None), "message_primary", None) or str(error).strip() or type(error).__name__
    return str(text).splitlines()[0]


def _made(connection: psycopg.Connection[Any]) -> bool:
    """Make the schema where there is none; return whether the database has vectors. Raises `CatalogError`."""
    if not _first(connection.execute("SELECT to_regclass('list3r.version')"))[0]:
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (_SCHEMA_LOCK,))
        connection.execute("CREATE SCHEMA IF NOT EXISTS list3r")
        connection.execute("CREATE TABLE IF NOT EXISTS version (number integer PRIMARY KEY)")
        for name in ("cube", "btree_gist"):
            connection.execute(f"CREATE EXTENSION IF NOT EXISTS {name} SCHEMA public")
        if connection.execute("SELECT 1 FROM pg_available_extensions WHERE name = 'vector'").fetchone():
            connection.execute("CREATE EXTENSION IF NOT EXISTS vector SCHEMA public")
        if not connection.execute("SELECT 1 FROM version").fetchone():  # nobody made it meanwhile
            connection.execute(SCHEMA.encode())
            connection.execute("INSERT INTO version VALUES (%s)", (SCHEMA_VERSION,))
    held = _first(connection.execute("SELECT max(number) FROM version"))[0]
    if held != SCHEMA_VERSION:
        raise CatalogError(
            f"the catalogue has schema {held}, this list3r {SCHEMA_VERSION}: use the list3r that made it"
        )
    return connection.execute("SELECT 1 FROM pg_extension WHERE extname = 'vector'").fetchone() is not None


@contextlib.contextmanager
def _unhurried(connection: psycopg.Connection[Any]) -> Iterator[None]:
    """Let statements take as long, and as much memory, as an index of vectors needs."""
    connection.execute(f"SET statement_timeout = 0; SET maintenance_work_mem = '{_BUILD_MEMORY}'")
    try:
        yield
    finally:
        if not connection.closed:
            connection.execute("RESET statement_timeout; RESET maintenance_work_mem")


def _keep_index(connection: psycopg.Connection[Any], space: int) -> None:
    """Make the index of the vectors of a space where there is none, or one of less than half the lists they need.

    Where another process does that, it is left to it.
    """
    query = (
        "SELECT option_value::integer FROM pg_class, pg_options_to_table(reloptions) "
        f"WHERE oid = to_regclass('vector_{int(space)}_alike') AND option_name = 'lists'"
    )
    held = (_first(connection.execute(query.encode())) or (0,))[0]
    if 2 * held > lists_of(sys.maxsize):  # there is nothing to count for
        return
    count = _first(connection.execute(f"SELECT count(*) FROM vector_{int(space)}".encode()))[0]
    lists, lock = lists_of(count), (_SCHEMA_LOCK, space)
    if lists == 0 or lists < 2 * held or not _first(connection.execute("SELECT pg_try_advisory_lock(%s, %s)", lock))[0]:
        return
    try:
        for statement in vector_index(space, lists):
            connection.execute(statement.encode())
    finally:
        if not connection.closed:
            connection.execute("SELECT pg_advisory_unlock(%s, %s)", lock)


def _copy_instances(connection: psycopg.Connection[Any], memory: int, content: MemoryContent) -> None:
    with connection.cursor() as cursor:
        with cursor.copy("COPY instance FROM STDIN") as copy:
            for t in content.instances:
                bounds = ",".join(map(_corner, t.bounds()))
                values = (t.label, t.description, t.state, t.structure, t.confidence, t.sigma, t.component)
                words = list(t.words), list(t.words.values())
                copy.write_row((memory, t.id, *values, t.box_numbers(), bounds, *words))
        with cursor.copy("COPY relation FROM STDIN") as copy:
            for row in content.relations:
                copy.write_row((memory, *row))


def _copy_vectors(connection: psycopg.Connection[Any], memory: int, space: int, held: SpaceVectors) -> None:
    """Write vectors as PostgreSQL reads them fastest: rows of three fields, each after its length, big-endian."""
    count, dimension = held.vectors.shape
    lengths = [("fields", ">i2"), ("l0", ">i4"), ("memory", ">i4"), ("l1", ">i4"), ("id", ">i8"), ("l2", ">i4")]
    rows = np.zeros(count, np.dtype([*lengths, ("dim", ">i2"), ("unused", ">i2"), ("v", ">f2", (dimension,))]))
    rows["fields"], rows["l0"], rows["l1"], rows["l2"] = 3, 4, 8, 4 + 2 * dimension
    rows["memory"], rows["id"], rows["dim"], rows["v"] = memory, held.ids, dimension, unit(held.vectors)
    with connection.cursor() as cursor, cursor.copy(f"COPY vector_{space} FROM STDIN (FORMAT binary)") as copy:
        copy.write(b"PGCOPY\n\xff\r\n\0" + struct.pack(">ii", 0, 0) + rows.tobytes() + struct.pack(">h", -1))


def _corner(point: Sequence[float]) -> str:
    """Return a point as `cube` reads it."""
    return f"({','.join(map(repr, point))})"


def _halfvec(vector: NDArray[np.float32]) -> str:
    """Return a vector of unit length as pgvector reads it."""
    return "[" + ",".join(f"{x:.5g}" for x in vector.tolist()) + "]"


def _bearing(alias: str, words: Sequence[str]) -> tuple[str, list[Any]]:
    return f"{alias}.words @> ?::text[]", [list(words)]


def _marked(query: str) -> bytes:
    """Return a query with this database's placeholders. Values are never part of its text."""
    return query.replace("?", "%s").encode()


def _first(cursor: psycopg.Cursor[Any]) -> Any:
    return cursor.fetchone() or ()
