"""A connection to one file by SQLite, which reads states of it that are whole and sound, and seals what it writes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import apsw

from list3r.memory.store.pages import PageDamaged, WatchedFile, check_state, schema_of, seal, unsealed

FAILURES = (apsw.Error, UnicodeError)
"""What SQLite raises on a damaged file; a damaged name in its message cannot even be decoded."""
_MODES = {
    "ro": ("ro", apsw.SQLITE_OPEN_READONLY),
    "rw": ("rw", apsw.SQLITE_OPEN_READWRITE),
    "file": ("ro&immutable=1", apsw.SQLITE_OPEN_READONLY),
}
_LOG_PAGES = 1000
"""Pages in the write-ahead log from which they are folded into the file."""
_SUMS = "SELECT first, sums FROM main.pages"


class Database(apsw.Connection):
    """One file, opened by `memory.store.file.connected`."""

    def __init__(self, path: Path, mode: str) -> None:
        """`mode` is ro, rw or file (see `connected`); the file must be there."""
        self._watched = WatchedFile()
        how, flags = _MODES[mode]
        uri = f"file:{quote(bytes(path.resolve()))}?mode={how}"
        super().__init__(uri, flags | apsw.SQLITE_OPEN_URI, self._watched.name)
        self._version: int | None = None
        self._broken: PageDamaged | None = None
        self.wal_autocheckpoint(0)

    def begin(self, how: str = "") -> int:
        """Begin to read, or with IMMEDIATE to write, one state of the file; its `data_version`. What is read from now
        on is compared with the sums of that state. Raises `apsw.Error`, `PageDamaged` where the sums are damaged.
        """
        if self._broken is not None:
            raise PageDamaged(str(self._broken))
        self._watched.unjudged = {}
        self.execute(f"BEGIN {how}")
        try:
            version = int(self.execute("PRAGMA main.data_version").fetchall()[0][0])  # type: ignore[arg-type]
            rows = None
            if version != self._version:
                rows = unsealed(self.execute(_SUMS).fetchall())  # type: ignore[arg-type]
                check_state(self, rows)
            self._watched.judge(rows)
            self._version = version
            return version
        except PageDamaged as error:  # what was read is kept by SQLite, which will not ask for it again
            self._broken = error
            self._roll_back()
            raise
        except BaseException:
            self._roll_back()
            raise

    def _roll_back(self) -> None:
        if self.in_transaction:
            with contextlib.suppress(apsw.Error):
                self.execute("ROLLBACK")

    def commit(self) -> None:
        """End a transaction that wrote, with the sums of the pages that it changed."""
        sums, watched = seal(self, self._watched), self._watched
        self.execute("COMMIT")
        if sums is not None:
            watched.sums = sums
            assert watched.agrees(sums), "a page changed after it was summed"
        watched.checking = True
        watched.forget()

    @contextlib.contextmanager
    def writing_into_the_file(self) -> Iterator[None]:
        """Inside, transactions write into the file itself, which has no log then, and pages are summed there."""
        self._watched.direct = True
        try:
            yield
        finally:
            self._watched.direct = False

    def fold_in_long_log(self) -> None:
        """Write the log into the file where it has become long; what readers hold stays for the next time."""
        log = Path(f"{self.db_filename('main')}-wal")
        if log.exists() and log.stat().st_size > _LOG_PAGES * self._watched.page_bytes:
            with contextlib.suppress(apsw.BusyError):
                self.wal_checkpoint("main", apsw.SQLITE_CHECKPOINT_PASSIVE)

    def roll_back(self) -> None:
        """Take back what a transaction wrote, or end reading."""
        self._watched.forget()
        if self.in_transaction:
            self.execute("ROLLBACK")

    def start(self, page_bytes: int) -> None:
        """Say that the file is empty yet, and of what size its pages will be."""
        self._watched.page_bytes = page_bytes
        self._watched.unjudged, self._watched.checking = None, False
        self.execute(f"PRAGMA page_size = {page_bytes}")

    def sum_again(self) -> None:
        """Take every page as it is, in a transaction: of a file that SQLite wrote without our sums."""
        self._watched.checking, self._watched.unjudged = True, {}
        self.execute("BEGIN IMMEDIATE")
        self.execute("PRAGMA integrity_check").fetchall()
        self._watched.written, self._watched.unjudged, self._watched.checking = self._watched.unjudged, None, False
        version = int(self.execute("PRAGMA user_version").fetchall()[0][0])  # type: ignore[arg-type]
        self.execute(f"DELETE FROM log_mark; DELETE FROM pages; PRAGMA user_version = {schema_of(version)}")
        self.commit()

    def close(self, force: bool = False) -> None:
        """Let the file go. SQLite asks for it alone, to fold in a log, and does without; what that says is no error."""
        self._watched.count = bytes
        with contextlib.suppress(apsw.IOError, apsw.BusyError):
            super().close(force)
        self._watched.unregister()

    def trust(self) -> None:
        """Take pages as they are from now on: the sums of them are damaged themselves."""
        self._watched.checking, self._watched.unjudged, self._broken = False, None, None

    @contextlib.contextmanager
    def noting(self) -> Iterator[set[int]]:
        """Inside, pages that are not as they were written are noted in this set instead of being refused."""
        self.execute("PRAGMA shrink_memory").fetchall()
        try:
            with self._watched.noting() as found:
                yield found
        finally:
            self.execute("PRAGMA shrink_memory").fetchall()
