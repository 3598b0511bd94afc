"""Memories that lie: well-formed files with valid checksums that hold what no program of ours writes.

A lie takes a sound memory, changes one value or all of a column (another type, out of range, too short or long, not
finite, in a circle, twice, huge, text that is none, JSON and arrays of another shape), or the rows of a table, and
signs everything anew. `lies` is a strategy of hypothesis, so that a test shrinks what it finds.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from list3r.memory.errors import MemoryFileError
from list3r.memory.store.checksums import OWN_CRC, SummedTable, summed_tables, write_all
from list3r.memory.store.rows.codec import pack, unpack
from list3r.memory.store.word_index import write_words

UNSIGNED = {
    "sums": ("name", "part", "crcs"),
    "words": ("word", "instance", "weight"),
    "instance_boxes": ("id", "min_x", "max_x", "min_y", "max_z"),
}
"""Tables that follow from others, and columns of them that may lie."""
_TYPES = (None, "text", 7, 0.5, b"\x00\x01\x02", b"", "")
_WHOLES = (0, -1, 1, 2, 255, 2**31, 2**53, 2**62, -(2**62))
_REALS = (0.5, -0.5, 1e7, 1e300, -1e300, float("inf"), -float("inf"), 1e-300)
_TEXTS = ("x", "\x1b[2J\n9 forged", "a\x00b", "é" * 5000, "'\"<script>&\\", "[]", "{}", "null", "NaN", "\u202etxt")
_JSON: tuple[Any, ...] = (None, True, -1, 2**70, 1e300, "x", "\x1b[2J", [], {}, [[]], {"": {}}, [None], float("nan"))
_JSON_TEXTS = ("[" * 3000, '{"a":' * 2000, "1e400", "-" * 50, '{"a":1,"a":2}', "[1e400, -1e400]", '"\\ud800"')
_HUGE = 2**21
_MANY = 5000


@dataclass(frozen=True)
class Lie:
    """Statements of SQL that make a sound memory lie."""

    statements: tuple[tuple[str, tuple[Any, ...]], ...]
    signed: bool
    """Whether checksums are made anew after them."""
    tables: frozenset[str]
    """Tables they change; the checksums of signed ones follow."""

    def __repr__(self) -> str:
        return "; ".join(f"{sql} {tuple(_short(a) for a in arguments)}" for sql, arguments in self.statements)


@dataclass(frozen=True)
class _Rows:
    """Rows of a table that may be false."""

    name: str
    key: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    signed: bool

    @property
    def touched(self) -> frozenset[str]:
        """Return the tables that change with it: those derived from instances do."""
        return frozenset((self.name, *(UNSIGNED if self.name == "instances" else ())))

    def where(self, row: tuple[Any, ...]) -> tuple[str, tuple[Any, ...]]:
        """Return the condition that holds for one row alone."""
        held = dict(zip(self.columns, row, strict=True))
        return " AND ".join(f"{k} IS ?" for k in self.key), tuple(held[k] for k in self.key)

    def values(self, column: str) -> list[Any]:
        """Return the values of one column."""
        at = self.columns.index(column)
        return [row[at] for row in self.rows]


def lies(memory: Path) -> st.SearchStrategy[Lie]:
    """Return lies about what a memory holds: of every column of every table that is not empty, and of rows."""
    tables = _contents(memory)
    columns = [(table, column) for table in tables for column in table.columns]
    of_values = st.sampled_from(columns).flatmap(lambda pair: _value_lies(*pair))
    of_rows = st.sampled_from(tables).flatmap(_row_lies)
    return st.one_of(of_values, of_values, of_values, of_values, of_rows, st.tuples(of_values, of_values).map(_both))


def write_lie(base: Path, path: Path, lie: Lie) -> None:
    """Copy a memory and make it lie; statements that SQLite refuses are not tried."""
    shutil.copyfile(base, path)
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute("PRAGMA synchronous=OFF")
        database.execute("PRAGMA journal_mode=MEMORY")
        database.execute("BEGIN")
        try:
            changed = [database.execute(sql, arguments).rowcount for sql, arguments in lie.statements]
        except (sqlite3.Error, OverflowError):
            changed = []
        assume(any(changed))
        if lie.signed:
            sign(database)
        database.execute("COMMIT")


def sign(database: sqlite3.Connection) -> None:
    """Make every checksum match its rows."""
    database.text_factory = bytes
    for name, blobs in OWN_CRC.items():
        keys = summed_tables()[name].key
        where = " AND ".join(f"{k} IS ?" for k in keys)
        for row in database.execute(f"SELECT {', '.join((*keys, *blobs))} FROM {name}").fetchall():
            value = 0
            for blob in row[len(keys) :]:
                value = zlib.crc32(blob if isinstance(blob, bytes) else repr(blob).encode(), value)
            database.execute(f"UPDATE {name} SET crc = ? WHERE {where}", (value, *row[: len(keys)]))
    database.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
    with contextlib.suppress(sqlite3.Error, UnicodeError):
        write_all(database)
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    with contextlib.suppress(sqlite3.Error, UnicodeError):
        write_words(database)


# ------------------------------------------------------------------------------------------- what may be lied about


def _contents(memory: Path) -> list[_Rows]:
    with contextlib.closing(sqlite3.connect(memory)) as database:
        found = [_signed_rows(database, table) for table in summed_tables().values()]
        found += [_unsigned_rows(database, name, columns) for name, columns in UNSIGNED.items()]
    return [table for table in found if table.rows]


def _signed_rows(database: sqlite3.Connection, table: SummedTable) -> _Rows:
    columns = tuple(c for c in table.columns if c != "crc")
    rows = database.execute(f"SELECT {', '.join(columns)} FROM {table.name} ORDER BY {', '.join(table.key)}")
    return _Rows(table.name, table.key, columns, tuple(rows.fetchall()), True)


def _unsigned_rows(database: sqlite3.Connection, name: str, columns: tuple[str, ...]) -> _Rows:
    key = columns[:1] if name == "instance_boxes" else columns[:2]
    rows = database.execute(f"SELECT {', '.join(columns)} FROM {name}").fetchall()
    return _Rows(name, key, columns, tuple(sorted(rows)), False)


def _both(pair: tuple[Lie, Lie]) -> Lie:
    one, two = pair
    return Lie(one.statements + two.statements, one.signed or two.signed, one.tables | two.tables)


@st.composite
def _value_lies(draw: st.DrawFn, table: _Rows, column: str) -> Lie:
    """One value of a column, or all of them, is another."""
    row = draw(st.sampled_from(table.rows))
    value = dict(zip(table.columns, row, strict=True))[column]
    expression, argument = draw(_other(value, table.values(column)))
    everywhere = draw(st.integers(0, 3)) == 3
    condition, key = ("1", ()) if everywhere else table.where(row)
    sql = f"UPDATE OR FAIL {table.name} SET {column} = {expression} WHERE {condition}"
    return Lie(((sql, (argument, *key)),), table.signed, table.touched)


@st.composite
def _row_lies(draw: st.DrawFn, table: _Rows) -> Lie:
    """Rows are missing, or there are more of them."""
    row = draw(st.sampled_from(table.rows))
    condition, key = table.where(row)
    kind = draw(st.sampled_from(("missing", "empty", "twice", "many")))
    if kind in ("missing", "empty"):
        where = (condition, key) if kind == "missing" else ("1", ())
        return Lie(((f"DELETE FROM {table.name} WHERE {where[0]}", where[1]),), table.signed, table.touched)
    first = table.key[-1] if draw(st.booleans()) else table.key[0]
    others = [c for c in table.columns if c != first]
    count = 1 if kind == "twice" else _MANY
    sql = (
        f"WITH RECURSIVE n(k) AS (VALUES(?) UNION ALL SELECT k + 1 FROM n LIMIT {count}) "
        f"INSERT OR IGNORE INTO {table.name} ({', '.join((first, *others))}) "
        f"SELECT {first} + n.k, {', '.join(others)} FROM {table.name}, n WHERE {condition}"
    )
    return Lie(
        ((_with_crc(sql, table), (draw(st.sampled_from((1, 7, 1000, -30_000, 2**40))), *key)),),
        table.signed,
        table.touched,
    )


def _with_crc(sql: str, table: _Rows) -> str:
    """Large blobs have a checksum in their row, which is never empty."""
    if table.name not in OWN_CRC:
        return sql
    return sql.replace(") SELECT ", ", crc) SELECT ", 1).replace(
        f" FROM {table.name}, n", f", crc FROM {table.name}, n"
    )


# ------------------------------------------------------------------------------------------- other values

Replacement = tuple[str, Any]
"""An expression of SQL with one parameter, and its argument."""


def _other(value: Any, column: list[Any]) -> st.SearchStrategy[Replacement]:
    """Return replacements of a value, by kind of lie where the value's type is known."""
    kinds = {
        "type": st.sampled_from(_TYPES).map(_plain),
        "range": st.sampled_from((*_WHOLES, *_REALS)).map(_plain),
        "text": st.one_of(st.sampled_from(_TEXTS).map(_plain), st.just(("CAST(? AS TEXT)", b"caf\xe9 \xff"))),
        "duplicate or circle": st.sampled_from(column).map(_plain),
        "huge": st.sampled_from((("CAST(zeroblob(?) AS TEXT)", _HUGE), ("zeroblob(?)", _HUGE), ("?", "x" * _HUGE))),
    }
    if isinstance(value, bytes):
        kinds |= {"length": st.sampled_from(_lengths(value)).map(_plain), "numbers": _numbers(value).map(_plain)}
        kinds |= {"arrays": _arrays(value).map(_plain)} if value[:2] == b"PK" else {}
    elif isinstance(value, str):
        kinds |= {"length": st.sampled_from(_lengths(value)).map(_plain)}
        kinds |= {"json": _json(value).map(_plain)} if value[:1] in ("{", "[") else {}
    elif isinstance(value, int | float):
        near = (value + 1, value - 1, -value, value + 1000, value * 7 + 3)
        kinds |= {"near": st.sampled_from(near).map(_plain)}
    return st.sampled_from(sorted(kinds)).flatmap(kinds.__getitem__)


def _plain(value: Any) -> Replacement:
    return "?", value


def _lengths(value: Any) -> list[Any]:
    return [
        value[:0],
        value[:1],
        value[:-1],
        value[: len(value) // 2],
        value * 2,
        value * 50 if len(value) < 9e4 else value,
    ]


def _numbers(value: bytes) -> st.SearchStrategy[bytes]:
    """One number in a blob is another, as a double or a float."""

    def put(place: int, number: float, kind: str) -> bytes:
        size = np.dtype(kind).itemsize
        count = len(value) // size
        if not count:
            return value + b"\x00"
        at = size * (place % count)
        with np.errstate(over="ignore"):
            return value[:at] + np.array(number, kind).tobytes() + value[at + size :]

    numbers = st.sampled_from((float("nan"), float("inf"), 1e300, -1e300, 0.0, 1e-300, -1.0, 12345.0))
    return st.builds(put, st.integers(0, 10_000), numbers, st.sampled_from(("<f8", "<f4")))


@st.composite
def _arrays(draw: st.DrawFn, value: bytes) -> bytes:
    """The same archive with one of its arrays changed."""
    try:
        arrays = dict(unpack(value, "a row"))
    except MemoryFileError:
        return value[:-1]
    name = draw(st.sampled_from(sorted(arrays)))
    array = arrays[name]
    change = draw(st.sampled_from(("drop", "type", "shape", "numbers", "empty", "bomb", "more")))
    if change == "drop":
        del arrays[name]
    elif change == "type":
        arrays[name] = array.astype(draw(st.sampled_from(("<f8", "|b1", "<i8", "<u1", "<f2"))))
    elif change == "shape":
        arrays[name] = array.reshape(-1) if array.ndim != 1 else array.reshape(1, -1)
    elif change == "empty":
        arrays[name] = array[:0] if array.ndim else array.reshape(-1)[:0]
    elif change == "bomb":
        arrays[name] = np.zeros((4_000_000,), array.dtype)
    elif change == "more":
        arrays[name] = np.concatenate([array, array]) if array.ndim else np.tile(array, 2)
    else:
        numbers = st.sampled_from((-1.0, 2.0**31 - 1, 0.0, 250.0, float("nan"), float("inf"), 1e30))
        arrays[name] = _filled(array, draw(numbers), draw(st.booleans()))
    return pack(arrays)


def _filled(array: np.ndarray[Any, Any], number: float, everywhere: bool) -> np.ndarray[Any, Any]:
    """Return the array with a number in all places or the first."""
    held = array.astype(np.float64).copy()
    held.reshape(-1)[: None if everywhere else 1] = number
    with np.errstate(all="ignore"):
        return held.astype(array.dtype)


@st.composite
def _json(draw: st.DrawFn, text: str) -> str:
    """The same JSON with one value changed, or none at all."""
    value = json.loads(text)
    if draw(st.integers(0, 4)) == 0:
        return draw(st.sampled_from(_JSON_TEXTS))
    holder = {"all": value}
    places = list(_places(holder))
    where, key = places[draw(st.integers(0, len(places) - 1))]
    where[key] = draw(st.sampled_from(_JSON))
    return json.dumps(holder["all"])


def _places(value: Any) -> Any:
    """Every value inside a value: its container and its key."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, held in inside:
        yield value, key
        yield from _places(held)


def _short(argument: Any) -> Any:
    message = repr(argument)
    return argument if len(message) <= 80 else f"{message[:60]}... ({len(message)})"
