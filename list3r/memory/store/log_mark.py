"""Which write-ahead log belongs to which file: a mark that the file holds, and every transaction in its log.

SQLite applies any log that has the right name, also one that a killed writer left beside a backup that was put in the
place of its memory. So a writer that begins writes a random number into the file itself, before there is a log, and
every transaction counts one more beside it. A log is that of a file where both have the same number and the file holds
all that was committed before the first transaction of the log. That can be read from the two files alone: they may be
moved and copied together.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import apsw

from list3r.memory.store.database import Database

_START = bytes.fromhex("c3a5f00d9be14c7e8f02d6b1774ae9d5")
"""How a mark begins; no text does, in any encoding that SQLite has."""
_FIELDS = struct.Struct(">16s16sQq")
_LOG_HEAD_BYTES = 32
_FRAME_HEAD_BYTES = 24
_LEAF = 13
"""The first byte of a page that holds rows of a table."""
_CELL_HEAD_BYTES = 16
"""A row of a mark has at most so many bytes before it."""
_LOCK_BYTE = 2**30
"""The page at this place is never written."""
_PAGE_BYTES = tuple(2**k for k in range(9, 17))
LOG_STARTS = (bytes.fromhex("377f0682"), bytes.fromhex("377f0683"))
"""How a log begins."""


@dataclass(frozen=True)
class Mark:
    """Who wrote a file, and how much of it."""

    writer: bytes
    """A number of the writer that no other has. 16 bytes."""
    commits: int
    """Transactions of this writer that changed something."""
    layout: int
    """The schema cookie of SQLite: a copy by VACUUM, in which pages lie elsewhere, has another."""

    def packed(self) -> bytes:
        """The mark as the file holds it."""
        return _FIELDS.pack(_START, self.writer, self.commits, self.layout)

    @classmethod
    def unpacked(cls, held: object) -> Self | None:
        """The mark in a value, or at the start of it; None where there is none."""
        if not isinstance(held, bytes) or len(held) < _FIELDS.size:
            return None
        start, *fields = _FIELDS.unpack(held[: _FIELDS.size])
        return cls(*fields) if start == _START else None


class LogMark:
    """Counts the transactions of one writing connection."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._changes = database.total_changes()

    def write(self) -> None:
        """Count the transaction that runs, where it changed anything."""
        if self._database.total_changes() != self._changes:
            held = _held(self._database)
            assert held is not None, "a writer begins with `begin_marking`"
            self._database.execute("UPDATE log_mark SET mark = ?", (_next(held).packed(),))

    def forget(self) -> None:
        """What was written so far is counted or rolled back."""
        self._changes = self._database.total_changes()


def begin_marking(database: Database) -> None:
    """Write the mark of a new writer into the file itself, which has no log then.

    Where a reader keeps the log of the last writer from being folded in, that writer is continued. Raises
    `apsw.BusyError` while others read.
    """
    if database.execute("PRAGMA journal_mode").fetchall()[0][0] == "wal":
        try:
            database.execute("PRAGMA journal_mode=DELETE").fetchall()
        except apsw.BusyError:
            if _held(database) is None:
                raise
            return
    layout = int(database.execute("PRAGMA schema_version").fetchall()[0][0])  # type: ignore[arg-type]
    mark = Mark(secrets.token_bytes(16), 0, layout)
    with database.writing_into_the_file():
        database.begin("IMMEDIATE")
        try:
            database.execute("INSERT OR REPLACE INTO log_mark VALUES (1, ?)", (mark.packed(),))
            database.commit()
        except BaseException:
            database.roll_back()
            raise


def _held(database: Database) -> Mark | None:
    rows = database.execute("SELECT mark FROM log_mark").fetchall()
    return Mark.unpacked(rows[0][0]) if rows else None


def _next(mark: Mark) -> Mark:
    return Mark(mark.writer, mark.commits + 1, mark.layout)


def mark_of_file(alone: Database) -> Mark | None:
    """The mark in a file that was opened without its log, as far as it can be read."""
    try:
        mark, ((layout,),) = _held(alone), alone.execute("PRAGMA schema_version").fetchall()
    except (apsw.Error, UnicodeError):
        return None
    return mark if mark is not None and mark.layout == layout else None


@dataclass(frozen=True)
class Log:
    """What is committed in a write-ahead log."""

    first: Mark | None
    """The mark of its first transaction."""
    last: Mark | None
    """The mark of its last one."""
    pages: frozenset[int]
    """Numbers of the pages in it."""
    size: int
    """Pages of the whole database."""
    page_bytes: int

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """The log in a file; None where nothing is committed in it, or it cannot be read."""
        with contextlib.suppress(FileNotFoundError, PermissionError), path.open("rb", buffering=0) as file:
            return cls._read(file.fileno())
        return None

    @classmethod
    def _read(cls, descriptor: int) -> Self | None:
        head = os.pread(descriptor, _LOG_HEAD_BYTES, 0)
        page_bytes, salts = int.from_bytes(head[8:12], "big"), head[16:24]
        if len(head) < _LOG_HEAD_BYTES or not head.startswith(LOG_STARTS) or page_bytes not in _PAGE_BYTES:
            return None
        numbers: list[int] = []
        count = size = 0
        for number, pages in _frames(descriptor, page_bytes, salts):
            numbers.append(number)
            if pages:
                count, size = len(numbers), pages
        if not count:
            return None
        first = _first_mark(descriptor, page_bytes, range(count))
        last = _first_mark(descriptor, page_bytes, range(count - 1, -1, -1))
        return cls(first, last, frozenset(numbers[:count]), size, page_bytes)

    def belongs_to(self, mark: Mark | None) -> bool:
        """Whether this is the log of a file with that mark."""
        if mark is None or self.first is None or self.last is None:
            return False
        same = mark.writer == self.first.writer == self.last.writer and mark.layout == self.last.layout
        return same and self.first.commits - 1 <= mark.commits <= self.last.commits

    def missing(self, file_bytes: int) -> list[int]:
        """Pages that neither the log holds nor a file of that size."""
        there = file_bytes // self.page_bytes
        lock_page = _LOCK_BYTE // self.page_bytes + 1
        return [p for p in range(there + 1, self.size + 1) if p not in self.pages and p != lock_page]


def _frames(descriptor: int, page_bytes: int, salts: bytes) -> Iterator[tuple[int, int]]:
    """The page of each frame of a log, and how many pages there are where it ends a transaction, else 0."""
    end, step = os.fstat(descriptor).st_size, _FRAME_HEAD_BYTES + page_bytes
    for at in range(_LOG_HEAD_BYTES, end - step + 1, step):
        head = os.pread(descriptor, _FRAME_HEAD_BYTES, at)
        if len(head) < _FRAME_HEAD_BYTES or head[8:16] != salts:  # a writer may have emptied the log since
            return
        yield int.from_bytes(head[:4], "big"), int.from_bytes(head[4:8], "big")


def _first_mark(descriptor: int, page_bytes: int, frames: range) -> Mark | None:
    for k in frames:
        at = _LOG_HEAD_BYTES + k * (_FRAME_HEAD_BYTES + page_bytes) + _FRAME_HEAD_BYTES
        mark = _mark_on(os.pread(descriptor, page_bytes, at))
        if mark is not None:
            return mark
    return None


def _mark_on(page: bytes) -> Mark | None:
    """The mark on a page of the table that holds only that; None for any other page."""
    if len(page) < _FIELDS.size or page[0] != _LEAF or page[3:5] != b"\x00\x01":
        return None
    cell = int.from_bytes(page[8:10], "big")
    start = page.find(_START, cell, cell + _CELL_HEAD_BYTES + len(_START))
    return None if start < 0 else Mark.unpacked(page[start:])
