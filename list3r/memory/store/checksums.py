"""Checksums of rows: every row of a memory is covered, and what changes in a transaction is summed as it commits.

The rows of a table are summed in parts, runs of neighbouring keys: one row of `sums` holds a CRC-32 for every row of a
part, in the order of the keys, and a CRC-32 over itself. So a damaged row is named, a lost one is missed, and a chunk
that comes in sums only the parts that it touched. Large blobs have a checksum of their own in their row's column `crc`,
which is what is summed here in their place. Triggers of the connection, never of the file, say which parts changed.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from typing import Any

from list3r.memory.store.schema import SCHEMA_VERSION, scratch_database

OWN_CRC: Mapping[str, tuple[str, ...]] = {
    "chunks": ("cannot_link", "overlap"),
    "keyframes": ("descriptor", "features", "jpeg"),
    "local_instances": ("feature", "track"),
    "supports": ("grid", "points", "confidence", "rgb"),
}
"""Blobs that the column `crc` of their own row covers."""

SUMS_SINCE = 3
"""The first schema whose rows are summed."""
_ROWS_OF_A_PART = 4
"""Two to the power of this: how many neighbouring ids share a part."""
_FRAMES_OF_A_PART = 6
_SESSION_BITS = 32

Row = tuple[Any, ...]


@dataclass(frozen=True)
class SummedTable:
    """One table and how its rows fall into parts."""

    name: str
    key: tuple[str, ...]
    """Columns of the primary key."""
    summed: tuple[str, ...]
    """Columns that are summed: all but those with a checksum of their own."""
    columns: tuple[str, ...]
    """All columns."""
    numbered: bool
    """Whether the first column of the key is an integer; a table without is one part."""

    @property
    def part(self) -> str:
        """The part of a row, as an expression of SQL over the columns of the key."""
        first = self.key[0]
        if self.name == "frames":
            return f"((%s.session_id << {_SESSION_BITS}) | (%s.frame_index >> {_FRAMES_OF_A_PART}))"
        if first == "chunk_id" and len(self.key) > 1:
            return f"%s.{first}"
        return f"(%s.{first} >> {_ROWS_OF_A_PART})" if self.numbered else "0"

    def part_of_first(self, key: int) -> int:
        """The part of the rows whose first column of the key is this number; not for `frames`."""
        if self.key[0] == "chunk_id" and len(self.key) > 1:
            return key
        return key >> _ROWS_OF_A_PART if self.numbered else 0

    def part_of(self, row: str) -> str:
        """`part` over the columns of a named row."""
        return self.part.replace("%s", row)

    def where(self, part: int) -> tuple[str, tuple[int, ...]]:
        """A condition that holds for the rows of a part and that the primary key can answer."""
        first = self.key[0]
        if self.name == "frames":
            low = (part & (1 << _SESSION_BITS) - 1) << _FRAMES_OF_A_PART
            clause = "session_id = ? AND frame_index BETWEEN ? AND ?"
            return clause, (part >> _SESSION_BITS, low, low + (1 << _FRAMES_OF_A_PART) - 1)
        if first == "chunk_id" and len(self.key) > 1:
            return "chunk_id = ?", (part,)
        if not self.numbered:
            return "1", ()
        low = part << _ROWS_OF_A_PART
        return f"{first} BETWEEN ? AND ?", (low, low + (1 << _ROWS_OF_A_PART) - 1)


@dataclass(frozen=True)
class BadRow:
    """A row that is not as it was written."""

    table: str
    key: tuple[Any, ...] | None
    """None where a row is missing and its key unknown."""
    what: str

    def __str__(self) -> str:
        name = "" if self.key is None else " " + ":".join(str(k) for k in self.key)
        return f"{self.table}{name}: {self.what}"


@cache
def summed_tables(version: int = SCHEMA_VERSION) -> dict[str, SummedTable]:
    """Every table of a schema by name, but `sums` and what is derived from the instances: the R*Tree and `words`."""
    with scratch_database(version) as database:
        names = database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'instance_boxes%' AND name != 'sums'"
            " AND name != 'words' AND name NOT LIKE 'sqlite_%' ORDER BY name"
        ).fetchall()
        return {name: _table(name, database.execute(f"PRAGMA table_info({name})").fetchall()) for (name,) in names}


def _table(name: str, info: list[Row]) -> SummedTable:
    columns = tuple(str(row[1]) for row in info)
    key = tuple(str(row[1]) for row in sorted((r for r in info if r[5]), key=lambda r: r[5]))
    own = OWN_CRC.get(name, ())
    numbered = any(row[1] == key[0] and row[2] == "INTEGER" for row in info)
    return SummedTable(name, key, tuple(c for c in columns if c not in own), columns, numbered)


class Sums:
    """Keeps the sums of one writing connection."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database
        self._touched: set[tuple[str, int]] = set()
        database.execute("PRAGMA temp_store=MEMORY")
        database.create_function("list3r_touch", 2, self._touch)
        for table in summed_tables().values():
            for event, rows in (("INSERT", ("NEW",)), ("DELETE", ("OLD",)), ("UPDATE", ("OLD", "NEW"))):
                calls = " ".join(f"SELECT list3r_touch('{table.name}', {table.part_of(row)});" for row in rows)
                database.execute(
                    f"CREATE TEMP TRIGGER touch_{table.name}_{event} AFTER {event} ON main.{table.name}"
                    f" BEGIN {calls} END"
                )

    def _touch(self, table: str, part: int) -> None:
        self._touched.add((table, part))

    def touched(self, table: str) -> frozenset[int]:
        """Parts of a table that were changed since the last call of `write`."""
        return frozenset(part for name, part in self._touched if name == table)

    def damaged_before(self, committed: sqlite3.Connection) -> Iterator[BadRow]:
        """Rows of the parts that were touched that were damaged before, in the file as it was last committed."""
        for name, part in sorted(self._touched):
            yield from bad_rows_of_part(committed, summed_tables()[name], part)

    def write(self) -> None:
        """Sum what was touched since the last call; inside the transaction that touched it."""
        for name, part in sorted(self._touched):
            write_part(self._database, summed_tables()[name], part)
        self._touched.clear()

    def forget(self) -> None:
        """What was touched was rolled back."""
        self._touched.clear()

    @property
    def pending(self) -> bool:
        """Whether something was touched that is not summed yet."""
        return bool(self._touched)


def write_part(database: sqlite3.Connection, table: SummedTable, part: int) -> None:
    """Sum one part of a table again."""
    clause, arguments = table.where(part)
    query = f"SELECT {', '.join(table.summed)} FROM {table.name} WHERE {clause} ORDER BY {', '.join(table.key)}"
    crcs = b"".join(row_crc(row) for row in database.execute(query, arguments))
    if crcs:
        sealed = crcs + _seal(table.name, part, crcs)
        database.execute("INSERT OR REPLACE INTO sums VALUES (?, ?, ?)", (table.name, part, sealed))
    else:
        database.execute("DELETE FROM sums WHERE name = ? AND part = ?", (table.name, part))


def write_all(database: sqlite3.Connection) -> None:
    """Sum every row again: after a migration, or when a file is made of the sound rows of another."""
    database.execute("DELETE FROM sums")
    for table in summed_tables().values():
        parts = database.execute(f"SELECT DISTINCT {table.part_of(table.name)} FROM {table.name}").fetchall()
        for (part,) in parts:
            write_part(database, table, part)


def row_crc(row: Row) -> bytes:
    """CRC-32 of the values of a row, little-endian. Shape (4,) bytes."""
    plain = repr([len(v) if type(v) is bytes else v for v in row])
    value = zlib.crc32(plain.encode("utf-8", "surrogatepass"))
    for v in row:
        if type(v) is bytes:
            value = zlib.crc32(v, value)
    return value.to_bytes(4, "little")


def stored_sums(database: sqlite3.Connection, table: SummedTable) -> tuple[dict[int, list[bytes]], list[int]]:
    """Sums of a table's rows by part, and the parts whose sums are damaged themselves."""
    good: dict[int, list[bytes]] = {}
    bad: list[int] = []
    for part, sealed in database.execute("SELECT part, crcs FROM sums WHERE name = ? ORDER BY part", (table.name,)):
        crcs = _unsealed(table.name, part, sealed)
        if crcs is None:
            bad.append(part)
        else:
            good[part] = crcs
    return good, bad


def _unsealed(name: str, part: object, sealed: object) -> list[bytes] | None:
    """Sums of the rows of a part; None where they are damaged themselves."""
    crcs = bytes(sealed[:-4]) if isinstance(sealed, bytes) else b""
    if not crcs or len(crcs) % 4 or not isinstance(part, int) or not isinstance(sealed, bytes):
        return None
    return [crcs[i : i + 4] for i in range(0, len(crcs), 4)] if sealed[-4:] == _seal(name, part, crcs) else None


def _seal(name: str, part: int, crcs: bytes) -> bytes:
    return zlib.crc32(f"{name}:{part}:".encode() + crcs).to_bytes(4, "little")


def bad_rows(database: sqlite3.Connection, version: int = SCHEMA_VERSION) -> Iterator[BadRow]:
    """Every row that is damaged, not as it was written, or missing. Raises `sqlite3.Error` where a page is broken."""
    for table in summed_tables(version).values():
        yield from bad_rows_of(database, table)


def bad_rows_of(database: sqlite3.Connection, table: SummedTable) -> Iterator[BadRow]:
    """`bad_rows` of one table."""
    sums, broken = stored_sums(database, table)
    for part in broken:
        yield BadRow("sums", (table.name, part), "the checksums of these rows are damaged")
    keys = len(table.key)
    query = (
        f"SELECT {', '.join(table.key)}, {table.part_of(table.name)}, {', '.join(table.summed)} FROM {table.name}"
        f" ORDER BY {', '.join(table.key)}"
    )
    for part, rows in groupby(database.execute(query), key=lambda row: row[keys]):
        found = [(row[:keys], row_crc(row[keys + 1 :])) for row in rows]
        if part not in broken:
            yield from compare(table.name, found, sums.pop(part, []))
    for crcs in sums.values():
        yield BadRow(table.name, None, _missing(len(crcs)))


def bad_rows_of_part(database: sqlite3.Connection, table: SummedTable, part: int) -> Iterator[BadRow]:
    """`bad_rows` of one part of a table."""
    sealed = database.execute("SELECT crcs FROM sums WHERE name = ? AND part = ?", (table.name, part)).fetchall()
    written = _unsealed(table.name, part, sealed[0][0]) if sealed else []
    if written is None:
        yield BadRow("sums", (table.name, part), "the checksums of these rows are damaged")
        return
    clause, arguments = table.where(part)
    keys = len(table.key)
    names = ", ".join((*table.key, *table.summed))
    query = f"SELECT {names} FROM {table.name} WHERE {clause} ORDER BY {', '.join(table.key)}"
    found = [(row[:keys], row_crc(row[keys:])) for row in database.execute(query, arguments)]
    yield from compare(table.name, found, written)


def compare(table: str, found: list[tuple[Row, bytes]], written: list[bytes]) -> Iterator[BadRow]:
    """Rows of one part, (key, CRC-32), against the sums that were written of them."""
    if [crc for _, crc in found] == written:
        return
    left = Counter(written)
    for key, crc in found:
        if left[crc] > 0:
            left[crc] -= 1
        else:
            yield BadRow(table, key, "the row is not as it was written; it is damaged")
    missing = len(written) - len(found)
    if missing > 0:
        yield BadRow(table, None, _missing(missing))


def _missing(count: int) -> str:
    return "a row is missing" if count == 1 else f"{count} rows are missing"


def own_crc_wrong(
    database: sqlite3.Connection, table: str, keys: Iterable[str], where: tuple[str, tuple[int, ...]] = ("1", ())
) -> Iterator[BadRow]:
    """Rows whose blobs do not match the checksum in their own row."""
    names = ", ".join(keys)
    count = len(names.split(","))
    query = f"SELECT {names}, crc, {', '.join(OWN_CRC[table])} FROM {table} WHERE {where[0]}"
    for row in database.execute(query, where[1]):
        key, crc, blobs = row[:count], row[count], row[count + 1 :]
        value = 0
        for blob in blobs:
            value = zlib.crc32(blob if isinstance(blob, bytes) else repr(blob).encode(), value)
        if value != crc:
            yield BadRow(table, key, "the checksum does not match; the row is damaged")
