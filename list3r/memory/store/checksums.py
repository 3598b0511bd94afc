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
PART_BITS = 4
"""Two to the power of this: how many neighbouring ids share a part."""
_FRAMES_OF_A_PART = 6
_SESSION_BITS = 32
_PARTS = 1_000
"""Parts that are read together."""

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
        return f"(%s.{first} >> {PART_BITS})" if self.numbered else "0"

    def part_of_first(self, key: int) -> int:
        """The part of the rows whose first column of the key is this number; not for `frames`."""
        if self.key[0] == "chunk_id" and len(self.key) > 1:
            return key
        return key >> PART_BITS if self.numbered else 0

    def part_of(self, row: str) -> str:
        """`part` over the columns of a named row."""
        return self.part.replace("%s", row)

    def where(self, parts: range) -> tuple[str, tuple[int, ...]]:
        """A condition that holds for the rows of parts side by side and that the primary key can answer."""
        first, last = parts[0], parts[-1]
        if self.name == "frames":
            numbers = (1 << _SESSION_BITS) - 1
            frames = (first & numbers) << _FRAMES_OF_A_PART, ((last & numbers) + 1 << _FRAMES_OF_A_PART) - 1
            return "session_id = ? AND frame_index BETWEEN ? AND ?", (first >> _SESSION_BITS, *frames)
        if not self.numbered:
            return "1", ()
        bits = 0 if self.key[0] == "chunk_id" and len(self.key) > 1 else PART_BITS
        return f"{self.key[0]} BETWEEN ? AND ?", (first << bits, (last + 1 << bits) - 1)


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
    """Every table of a schema by name, but `sums`, `log_mark` and what is derived from the instances: the R*Tree and
    `words`.
    """
    with scratch_database(version) as database:
        names = database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'instance_boxes%' AND name != 'sums'"
            " AND name NOT IN ('words', 'log_mark') AND name NOT LIKE 'sqlite_%' ORDER BY name"
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
        for name, parts in side_by_side(self._touched):
            yield from bad_rows_of(committed, summed_tables()[name], parts)

    def write(self) -> None:
        """Sum what was touched since the last call; inside the transaction that touched it."""
        for name, parts in side_by_side(self._touched):
            write_parts(self._database, summed_tables()[name], parts)
        self._touched.clear()

    def forget(self) -> None:
        """What was touched was rolled back."""
        self._touched.clear()

    @property
    def pending(self) -> bool:
        """Whether something was touched that is not summed yet."""
        return bool(self._touched)


def write_parts(database: sqlite3.Connection, table: SummedTable, parts: range) -> None:
    """Sum some parts of a table side by side again."""
    held = {part: (name, part, sealed) for name, part, sealed in _sealed(database, table, parts)}
    database.executemany("INSERT OR REPLACE INTO sums VALUES (?, ?, ?)", held.values())
    gone = [(table.name, part) for part in parts if part not in held]
    database.executemany("DELETE FROM sums WHERE name = ? AND part = ?", gone)


def _sealed(
    database: sqlite3.Connection, table: SummedTable, parts: range | None = None
) -> Iterator[tuple[str, int, bytes]]:
    """Rows of `sums` of a table, or of some of its parts side by side."""
    for part, rows in groupby(_rows_of(database, table, parts), key=lambda row: row[-1]):
        crcs = b"".join(row_crc(row[:-1]) for row in rows)
        yield table.name, part, crcs + _seal(table.name, part, crcs)


def _rows_of(database: sqlite3.Connection, table: SummedTable, parts: range | None) -> Iterator[Row]:
    """What is summed of the rows of a table, or of some of its parts side by side, in order, each with its part."""
    clause, arguments = ("1", ()) if parts is None else table.where(parts)
    return database.execute(
        f"SELECT {', '.join(table.summed)}, {table.part_of(table.name)} FROM {table.name}"
        f" WHERE {clause} ORDER BY {', '.join(table.key)}",
        arguments,
    )


def write_all(database: sqlite3.Connection) -> None:
    """Sum every row again: after a migration, or when a file is made of the sound rows of another."""
    database.execute("DELETE FROM sums")
    for table in summed_tables().values():
        write_table(database, table)


def write_table(database: sqlite3.Connection, table: SummedTable) -> None:
    """Sum every row of a table again."""
    database.executemany("INSERT OR REPLACE INTO sums VALUES (?, ?, ?)", _sealed(database, table))


def row_crc(row: Row) -> bytes:
    """CRC-32 of the values of a row, little-endian. Shape (4,) bytes."""
    plain = repr([len(v) if type(v) is bytes else v for v in row])
    value = zlib.crc32(plain.encode("utf-8", "surrogatepass"))
    for v in row:
        if type(v) is bytes:
            value = zlib.crc32(v, value)
    return value.to_bytes(4, "little")


def side_by_side(parts: Iterable[tuple[str, int]]) -> Iterator[tuple[str, range]]:
    """Parts of tables in order, those that lie side by side together, `_PARTS` at the most.

    Parts that are no numbers are left out: they are of rows that no program of ours writes.
    """
    start, count = ("", 0), 0
    for name, part in sorted(p for p in parts if isinstance(p[1], int)):
        if count and (name, part) == (start[0], start[1] + count) and count < _PARTS:
            count += 1
            continue
        if count:
            yield start[0], range(start[1], start[1] + count)
        start, count = (name, part), 1
    if count:
        yield start[0], range(start[1], start[1] + count)


def stored_sums(
    database: sqlite3.Connection, table: SummedTable, parts: range | None = None
) -> tuple[dict[int, list[bytes]], list[int]]:
    """Sums of a table's rows by part, of all or of some parts side by side, and those whose sums are damaged."""
    good: dict[int, list[bytes]] = {}
    bad: list[int] = []
    clause, arguments = ("1", ()) if parts is None else ("part BETWEEN ? AND ?", (parts[0], parts[-1]))
    query = f"SELECT part, crcs FROM sums WHERE name = ? AND {clause} ORDER BY part"
    for part, sealed in database.execute(query, (table.name, *arguments)):
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


def stored_seals(database: sqlite3.Connection, table: str) -> dict[int, bytes]:
    """What changes when any row of a part does, by part: the CRC-32 over the sums of its rows, which says nothing of
    whether the rows still match these. Parts whose sums are none are left out.
    """
    query = "SELECT part, substr(crcs, -4) FROM sums WHERE name = ? AND typeof(part) = 'integer' ORDER BY part"
    return {part: seal for part, seal in database.execute(query, (table,)) if type(seal) is bytes and len(seal) == 4}


def bad_rows(database: sqlite3.Connection, version: int = SCHEMA_VERSION) -> Iterator[BadRow]:
    """Every row that is damaged, not as it was written, or missing. Raises `sqlite3.Error` where a page is broken."""
    for table in summed_tables(version).values():
        yield from bad_rows_of(database, table)


def bad_rows_of(database: sqlite3.Connection, table: SummedTable, parts: range | None = None) -> Iterator[BadRow]:
    """`bad_rows` of one table, or of some of its parts side by side."""
    sums, broken = stored_sums(database, table, parts)
    for part in broken:
        yield BadRow("sums", (table.name, part), "the checksums of these rows are damaged")
    for part, group in groupby(_rows_of(database, table, parts), key=lambda row: row[-1]):
        rows = list(group)
        found, written = [row_crc(row[:-1]) for row in rows], sums.pop(part, [])
        if found != written and part not in broken:
            yield from _differing(table, rows, found, written)
    for crcs in sums.values():
        yield BadRow(table.name, None, _missing(len(crcs)))


def _differing(table: SummedTable, rows: list[Row], found: list[bytes], written: list[bytes]) -> Iterator[BadRow]:
    """Rows of one part whose sums are not among those that were written of them."""
    keys = [table.summed.index(column) for column in table.key]
    left = Counter(written)
    for row, crc in zip(rows, found, strict=True):
        if left[crc] > 0:
            left[crc] -= 1
        else:
            yield BadRow(table.name, tuple(row[k] for k in keys), "the row is not as it was written; it is damaged")
    missing = len(written) - len(rows)
    if missing > 0:
        yield BadRow(table.name, None, _missing(missing))


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
