"""Sums of pages: what SQLite reads of a memory is checked page by page as it is read, and no more than that.

The table `pages` holds a CRC-32 of every page of the file, and a transaction writes those of the pages that it changed.
So a flipped byte, a page that was zeroed or swapped, and one of another state of the file are refused where a question
reads them, be they of a table, an index, the R*Tree or the words; and none is written over unseen.

A file system of our own between SQLite and the disk (`apsw.VFS`) sees each page as it is read or written. Each row of
the table of sums ends with a sum of its own. Page 1 is only seen as a transaction ends; what it holds, the schema, how
many pages there are and are free, and how many transactions there were, is summed as a row of its own.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import count
from typing import cast

import apsw

TABLE = "CREATE TABLE pages (first INTEGER PRIMARY KEY, sums BLOB NOT NULL) STRICT"
PAGES_OF_A_ROW = 1024
_STATE = -1
"""Number of the row that holds what page 1 says."""
_FRAME_HEADER = 24
_LOG_HEADER = 32
_FILE_HEADER = 100
_SIZE_AT = slice(16, 18)
_COUNT_AT = slice(24, 28)
_SCHEMA, _MOST_VERSION = 0xFF, 0x7FFFFFFF
_numbers = count()


class PageDamaged(apsw.IOError):
    """A page is not as it was written."""


class Sums:
    """The sums of all pages, as rows of the table."""

    def __init__(self, rows: Mapping[int, bytes]) -> None:
        self.rows = dict(rows)
        """By the number of the row, the sums of its pages, little-endian."""

    def of(self, page: int) -> int:
        """Return the sum of a page; 0 where it has none."""
        row, at = divmod(page, PAGES_OF_A_ROW)
        return int.from_bytes(self.rows.get(row, b"")[4 * at : 4 * at + 4], "little")

    def changed(self, sums: Mapping[int, int]) -> dict[int, bytes]:
        """Return the rows that hold some pages, with these sums in the place of theirs."""
        rows: dict[int, bytearray] = {}
        for page, value in sums.items():
            row, at = divmod(page, PAGES_OF_A_ROW)
            held = rows.setdefault(row, bytearray(self.rows.get(row, bytes(4 * PAGES_OF_A_ROW))))
            held[4 * at : 4 * at + 4] = value.to_bytes(4, "little")
        return {row: bytes(held) for row, held in rows.items()}


def sealed(first: int, sums: bytes) -> bytes:
    """Return what a row of the table holds: sums, and a sum of these."""
    return sums + zlib.crc32(sums, first & 0xFFFFFFFF).to_bytes(4, "little")


def unsealed(rows: Iterable[tuple[int, bytes]]) -> dict[int, bytes]:
    """Return the sums that rows hold. Raises `PageDamaged`."""
    found = {}
    for first, blob in rows:
        if type(first) is not int or type(blob) is not bytes or sealed(first, blob[:-4]) != blob:
            raise PageDamaged("the sums of its pages are damaged")
        found[first] = blob[:-4]
    return found


class WatchedFile(apsw.VFS):
    """The file system of one connection: it sums what passes, and knows what it should be."""

    def __init__(self) -> None:
        self.page_bytes = 0
        """Zero of a file that is empty yet."""
        self.sums = Sums({})
        """As of the last transaction."""
        self.written: dict[int, int] = {}
        """Sums of the pages that the transaction that runs has written so far."""
        self.unjudged: dict[int, int] | None = {}
        """What was read while the sums of the state that is read are not known yet; None once they are."""
        self.checking = True
        self.count: Callable[[], bytes] = bytes
        """How often the file was changed, as its first page says: big-endian."""
        self.direct = False
        """Whether transactions write into the file itself, not into a log."""
        self._noted: set[int] | None = None
        self.name = f"list3r-{next(_numbers)}"
        super().__init__(self.name, "unix")

    def xOpen(self, name: str | apsw.URIFilename | None, flags: list[int]) -> apsw.VFSFile:
        """Open a file of SQLite's."""
        if flags[0] & apsw.SQLITE_OPEN_MAIN_DB:
            return _Main(self, name, flags)
        return _Log(self, name, flags) if flags[0] & apsw.SQLITE_OPEN_WAL else super().xOpen(name, flags)

    def note_read(self, page: int, data: bytes) -> None:
        """Compare a page that was read with its sum. Raises `PageDamaged`."""
        if page == 1 or not self.checking:
            return
        found = _sum(data)
        if self.unjudged is not None:
            self.unjudged[page] = found
        else:
            self._compare(page, found, self.written.get(page) or self.sums.of(page))

    def _compare(self, page: int, found: int, known: int) -> None:
        if found == known:
            return
        if self._noted is None:
            raise PageDamaged(f"page {page} is not as it was written")
        self._noted.add(page)

    @contextlib.contextmanager
    def noting(self) -> Iterator[set[int]]:
        """Note damaged pages in a set instead of refusing them."""
        self._noted = set()
        try:
            yield self._noted
        finally:
            self._noted = None

    def check_log(self, first_page: bytes) -> None:
        """Compare the first page in a log with that in the file, which knows no changes that the log does not. Every
        transaction ends with the first page. Raises `PageDamaged`.
        """
        if self.checking and self.count() > first_page[_COUNT_AT]:
            raise PageDamaged("the log beside it is of another file or of an earlier state of this one")

    def note_written(self, page: int, data: bytes) -> None:
        """Take down the sum of a page."""
        if page > 1:
            self.written[page] = _sum(data)

    def agrees(self, sums: Sums) -> bool:
        """Return whether these are the sums of what the transaction that runs has written."""
        return all(sums.of(page) == found for page, found in self.written.items())

    def judge(self, rows: Mapping[int, bytes] | None) -> None:
        """Compare what was read before the sums were known; None where they are those of before. Raises
        `PageDamaged`.
        """
        if rows is not None:
            self.sums = Sums(rows)
        read, self.unjudged = self.unjudged or {}, None
        for page, found in read.items():
            self._compare(page, found, self.sums.of(page))

    def forget(self) -> None:
        """What was written was taken back."""
        self.written.clear()


class _Main(apsw.VFSFile):
    def __init__(self, watched: WatchedFile, name: str | apsw.URIFilename | None, flags: list[int]) -> None:
        super().__init__("unix", cast(str, name), flags)
        self._watched = watched
        head = super().xRead(_FILE_HEADER, 0)
        if len(head) == _FILE_HEADER and (size := int.from_bytes(head[_SIZE_AT], "big")):
            watched.page_bytes = 2**16 if size == 1 else size
        watched.count = lambda: super(_Main, self).xRead(4, _COUNT_AT.start)

    def xRead(self, amount: int, offset: int) -> bytes:
        """Read; of a large value SQLite asks for the first bytes of a page alone."""
        size = self._watched.page_bytes
        if offset < size or size == 0:
            return super().xRead(amount, offset)
        skipped = offset % size
        data = super().xRead(size, offset - skipped)
        self._watched.note_read(offset // size + 1, data)
        return data if amount == size else data[skipped : skipped + amount]

    def xWrite(self, data: bytes, offset: int) -> None:
        """Write a page: one of the log that is folded in, or of a transaction without a log."""
        super().xWrite(data, offset)
        if self._watched.direct:
            self._watched.note_written(offset // self._watched.page_bytes + 1, bytes(data))


class _Log(apsw.VFSFile):
    def __init__(self, watched: WatchedFile, name: str | apsw.URIFilename | None, flags: list[int]) -> None:
        super().__init__("unix", cast(str, name), flags)
        self._watched = watched

    def xRead(self, amount: int, offset: int) -> bytes:
        """Read, a frame or what its page holds."""
        data = super().xRead(amount, offset)
        if self._is_page(amount, offset):
            page = self._page(offset)
            if page == 1:
                self._watched.check_log(data)
            self._watched.note_read(page, data)
        return data

    def xWrite(self, data: bytes, offset: int) -> None:
        """Write a head, or a page, perhaps once more in the same transaction."""
        super().xWrite(data, offset)
        if self._is_page(len(data), offset):
            self._watched.note_written(self._page(offset), bytes(data))

    def _is_page(self, amount: int, offset: int) -> bool:
        size = self._watched.page_bytes
        at = offset - _LOG_HEADER - _FRAME_HEADER
        return amount == size and at >= 0 and at % (size + _FRAME_HEADER) == 0

    def _page(self, offset: int) -> int:
        return int.from_bytes(super().xRead(4, offset - _FRAME_HEADER), "big")


def seal(database: apsw.Connection, watched: WatchedFile) -> Sums | None:
    """Write the sums of what a transaction changed, as its last act; what they are once it is committed, None where it
    changed nothing.

    What SQLite writes is known when it is written, so that comes first. Then the table of sums is written, until that
    changes no other sum: a new row may take a page. The sum of a page of this table does not change with what its rows
    say, for a CRC over something and its own CRC is always the same.
    """
    database.execute("SAVEPOINT whole; RELEASE whole")  # the words are written as late as that
    database.cache_flush()
    if not watched.written and state(database) == watched.sums.rows.get(_STATE):
        return None
    sums = Sums(watched.sums.rows)
    _count_on(database)
    while True:
        rows = sums.changed({page: found for page, found in watched.written.items() if found != sums.of(page)})
        rows[_STATE] = state(database)
        sums.rows |= rows
        for first, held in rows.items():
            blob = sealed(first, held)
            database.execute("UPDATE pages SET sums = ? WHERE first = ?", (blob, first))
            if not database.changes():
                database.execute("INSERT INTO pages VALUES (?, ?)", (first, blob))
        database.cache_flush()
        if rows[_STATE] == state(database) and watched.agrees(sums):
            return sums


def schema_of(user_version: int) -> int:
    """Return the version of the schema; what is above it counts transactions, so that the first page tells one state of
    the file from another.
    """
    return user_version & _SCHEMA


def _count_on(database: apsw.Connection) -> None:
    version = int(database.execute("PRAGMA main.user_version").fetchall()[0][0])  # type: ignore[arg-type]
    after = (version & ~_SCHEMA) + _SCHEMA + 1 & _MOST_VERSION
    database.execute(f"PRAGMA main.user_version = {after | schema_of(version)}")


def state(database: apsw.Connection) -> bytes:
    """Return a sum of what page 1 says: the schema with where its tables lie, how many pages there are and are free,
    and the count of transactions.
    """
    schema = database.execute("SELECT type, name, rootpage, sql FROM main.sqlite_master ORDER BY rowid").fetchall()
    numbers = [
        database.execute(f"PRAGMA main.{name}").fetchall()
        for name in ("page_count", "freelist_count", "user_version", "application_id")
    ]
    return zlib.crc32(repr((schema, numbers)).encode("utf-8", "surrogateescape")).to_bytes(4, "little")


def check_state(database: apsw.Connection, rows: Mapping[int, bytes]) -> None:
    """Compare what page 1 says with the sum of it. Raises `PageDamaged`."""
    if rows.get(_STATE) != state(database):
        raise PageDamaged("its first page is not as it was written")


def _sum(data: bytes) -> int:
    return zlib.crc32(data) or 1
