"""One table of the memory as records: asked for, put in, taken out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Generic, TypeVar

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.store.connection import Arguments, Connection
from list3r.memory.store.rows.codec import checksum
from list3r.memory.store.rows.columns import UNREADABLE, Columns, Value

R = TypeVar("R")
BATCH = 500
"""Rows asked for by id in one statement."""


class Table(Generic[R]):
    """Rows of one table, or of several joined, as records. What writes is called inside `transaction()`."""

    def __init__(
        self,
        connection: Connection,
        name: str,
        columns: Columns[R],
        order: str,
        *,
        source: str = "",
        summed: tuple[str, ...] = (),
    ) -> None:
        """`order` are the columns that rows are ordered by, `source` what rows come from where that is a join; the
        column `crc` tells one content of the `summed` columns from another.
        """
        self._connection = connection
        self._name = name
        self._columns = columns
        self._order = order
        self._key = [name for name in order.split(", ") if name in columns.names]
        self._source = source or name
        self._sealed = summed
        self._select = f"SELECT {', '.join(columns.names)} FROM {self._source}"

    def all(self, where: str = "", arguments: Arguments = ()) -> list[R]:
        """Return the records for which a condition of SQL holds, all without one, in order."""
        condition = f" WHERE {where}" if where else ""
        return self._records(f"{self._select}{condition} ORDER BY {self._order}", arguments)

    def in_batches(self, size: int = 1024) -> Iterator[list[R]]:
        """Yield all records in the order of the one integer that is their key, so many at a time: a large table takes
        no more room, and those that were yielded may be written.
        """
        query = f"{self._select} WHERE {self._order} > ? ORDER BY {self._order} LIMIT {size}"
        last = -1
        while records := self._records(query, (last,)):
            yield records
            last = getattr(records[-1], self._order)

    def first(self, where: str, arguments: Arguments = ()) -> R | None:
        """Return one record for which a condition holds."""
        found = self._records(f"{self._select} WHERE {where} LIMIT 1", arguments)
        return found[0] if found else None

    def among(self, column: str, values: Iterable[int], where: str = "", arguments: Sequence[Any] = ()) -> list[R]:
        """Return the records whose column is one of some integers, in no order, and for which a condition holds."""
        more = f" AND {where}" if where else ""
        query = f"{self._select} WHERE {column} IN ({{}}){more}"
        return [
            record
            for part, marks in batches(values)
            for record in self._records(query.format(marks), (*part, *arguments))
        ]

    def values(self, field: str, where: str, arguments: Arguments = ()) -> list[Any]:
        """Return one field of the records for which a condition holds, in order, without reading the others."""
        column = self._columns.column(field)
        query = f"SELECT {', '.join(column.names)} FROM {self._source} WHERE {where} ORDER BY {self._order}"
        rows = self._connection.rows(query, arguments)
        try:
            return list(column.read(*zip(*rows, strict=True))[column.fields.index(field)]) if rows else []
        except UNREADABLE as error:
            what = f"{', '.join(column.names)} of a row of {self._name} cannot be read ({error})"
            raise MemoryFileError(f"{what}; run `list3r verify` on the file") from error

    def columns_of(self, names: Sequence[str], ids: Iterable[int]) -> Iterator[tuple[Any, ...]]:
        """Yield some columns, as they are stored, of the rows with some ids, in no order."""
        query = f"SELECT {', '.join(names)} FROM {self._source} WHERE id IN ({{}})"
        for part, marks in batches(ids):
            yield from self._connection.rows(query.format(marks), part)

    def add(self, record: R, **more: Value) -> int:
        """Insert a record; the number of its row. `more` are columns that are none of its fields or override them."""
        statement, rows = self._written([record], more, "INSERT")
        return self._connection.execute(statement, rows[0]).row

    def put(self, records: Iterable[R], **more: Value) -> None:
        """Insert records; those of the same key are replaced."""
        self._connection.execute_many(*self._written(list(records), more, "INSERT OR REPLACE"))

    def add_all(self, records: Iterable[R], **more: Value) -> None:
        """Insert records, none of whose keys is there."""
        self._connection.execute_many(*self._written(list(records), more, "INSERT"))

    def set(self, where: str, arguments: Sequence[Any], **fields: Any) -> None:
        """Set some fields of the records for which a condition holds; of one where a checksum covers them."""
        values = self._columns.some(**fields)
        if not values.keys().isdisjoint(self._sealed):
            held = self._connection.rows(f"SELECT {', '.join(self._sealed)} FROM {self._name} WHERE {where}", arguments)
            blobs = dict(zip(self._sealed, held[0], strict=True)) | values
            values["crc"] = checksum(*(blobs[name] for name in self._sealed))
        names = ", ".join(f"{name} = ?" for name in values)
        self._connection.execute(f"UPDATE {self._name} SET {names} WHERE {where}", (*values.values(), *arguments))

    def delete(self, where: str = "", arguments: Arguments = ()) -> int:
        """Take out the rows for which a condition holds, all without one; how many there were."""
        return self._connection.execute(f"DELETE FROM {self._name}{where and f' WHERE {where}'}", arguments).count

    def count(self, where: str = "", arguments: Arguments = ()) -> int:
        """Return for how many rows a condition holds."""
        return int(
            self._connection.rows(f"SELECT count(*) FROM {self._source}{where and f' WHERE {where}'}", arguments)[0][0]
        )

    def _records(self, query: str, arguments: Arguments) -> list[R]:
        rows = self._connection.rows(query, arguments)
        return self._columns.records(rows, self._name, self._key)

    def _written(self, records: list[R], more: dict[str, Value], verb: str) -> tuple[str, list[tuple[Value, ...]]]:
        """The statement that inserts records, and its arguments."""
        kept = [k for k, name in enumerate(self._columns.names) if name not in more]
        names = [self._columns.names[k] for k in kept] + list(more)
        rows = self._columns.rows(records) if records else []
        if more:
            rows = [(*(row[k] for k in kept), *more.values()) for row in rows]
        if self._sealed:
            blobs = [names.index(name) for name in self._sealed]
            rows = [(*row, checksum(*(row[k] for k in blobs))) for row in rows]  # type: ignore[arg-type]
            names.append("crc")
        marks = ", ".join("?" * len(names))
        return f"{verb} INTO {self._name} ({', '.join(names)}) VALUES ({marks})", rows


def batches(values: Iterable[int], size: int = BATCH) -> Iterator[tuple[tuple[int, ...], str]]:
    """Yield integers in parts that one statement can ask for, each with its question marks."""
    known = [int(v) for v in values]
    for start in range(0, len(known), size):
        part = tuple(known[start : start + size])
        yield part, ",".join("?" * len(part))
