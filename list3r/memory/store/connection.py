"""One memory file: opening, migrating, transactions, and the statements that all tables are read and written by."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from traceback import walk_tb
from types import TracebackType
from typing import Any, Self, cast

from list3r.memory.errors import MemoryFileError, OptionError
from list3r.memory.store.beside import not_alone, opened_to_read, take_up_log
from list3r.memory.store.checksums import PART_BITS, Sums, stored_seals
from list3r.memory.store.committed import Committed
from list3r.memory.store.file import (
    check_beside,
    connected,
    explained,
    fold_in,
    identified,
    migrate,
    migrated_copy,
    taken,
    use_write_ahead_log,
    write_empty,
)
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.log_mark import LogMark
from list3r.memory.store.read_checks import FAILURES, WHOLE_BYTES, ReadChecks, any_text, unbelieved
from list3r.memory.store.schema import SCHEMA_VERSION
from list3r.memory.store.word_index import WordIndex, up_to_date, write_words

_LAST_WAIT_MS = 2000
"""How long a writer that closes waits for readers."""
Arguments = Sequence[Any] | Mapping[str, Any]
"""Values of a statement by place or by name."""


@dataclass(frozen=True)
class Done:
    """What a statement did."""

    row: int
    """Number of the row that it inserted last."""
    count: int
    """How many rows it changed."""


class Connection:
    """The file and its transactions; the tables of the store stand on it.

    One object may be used by several threads; a snapshot or a transaction of one keeps the others waiting.
    """

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        self.path = path
        self._database = database
        self._lock = lock
        self._process = os.getpid()
        self._committed = None if lock is None else Committed(path)
        self._sums = None if lock is None else Sums(database)
        self._followers = () if self._sums is None else (WordIndex(database), self._sums, LogMark(database))
        """What follows the rows that a transaction changes; in this order as it commits."""
        self._checks = ReadChecks(database, self._committed, whole=_size(database) <= WHOLE_BYTES)
        self._writing = False
        self._held_version: int | None = None
        self._guard = threading.RLock()
        self._on_forget: list[weakref.WeakMethod[Callable[[], None]]] = []
        self.rollbacks = 0
        """How often something written was taken back: an id may then stand for something else."""

    @property
    def writable(self) -> bool:
        """Whether this is the one connection that may write."""
        return self._lock is not None

    def beside(self) -> str | None:
        """What is to be known of a file that is not whole by itself; None where it is."""
        try:
            return not_alone(self.path, self._database)
        except FAILURES as error:
            raise MemoryFileError(explained(self.path, error)) from error

    @classmethod
    def create(cls, path: str | Path) -> Self:
        """A new, empty memory, open for writing. Raises `MemoryFileError` when the path is taken or not writable.

        The file appears under its name only when it is whole.
        """
        path = Path(path)
        if not path.parent.is_dir():
            raise MemoryFileError(f"the folder {path.parent} does not exist; create it first")
        if path.exists():
            raise MemoryFileError(taken(path))
        real = path.resolve()
        lock = WriterLock(real)
        try:
            if os.path.lexists(real):
                raise MemoryFileError(taken(path))
            check_beside(real)
            write_empty(real)
            return cls._connect(path, lock)
        except BaseException:
            lock.release()
            raise

    @classmethod
    def open(cls, path: str | Path, *, writable: bool = False) -> Self:
        """An existing memory. Raises `MemoryFileError` for anything else, and for a memory of a newer schema.

        Reading writes nothing: a memory of an older schema is migrated where it lies only when it is opened to be
        written, else in a copy that ends with the connection. Nothing in the file is executed: a trigger or view, or
        anything else that the schema does not have, is refused.
        """
        path = Path(path)
        if not path.exists():
            raise MemoryFileError(f"{path} does not exist; make it with `list3r build SOURCE -m {path}`")
        if path.is_dir():
            raise MemoryFileError(f"{path} is a folder, not a memory file")
        if not path.is_file():
            raise MemoryFileError(f"{path} is a device or pipe, not a memory file")
        check_beside(path.resolve())
        if not writable:
            return cls._open_to_read(path)
        try:
            return cls._connect(path, WriterLock(path.resolve()))
        except FAILURES as error:
            raise MemoryFileError(explained(path, error)) from error

    @classmethod
    def _open_to_read(cls, path: Path) -> Self:
        database: sqlite3.Connection | None = None
        try:
            database = opened_to_read(path.resolve())
            if identified(path, database) < SCHEMA_VERSION:
                with contextlib.closing(database) as older:
                    database = migrated_copy(path, older)
            database.execute("PRAGMA query_only=ON")
            return cls(path, database, None)
        except BaseException as error:
            if database is not None:
                database.close()
            if isinstance(error, FAILURES):
                raise MemoryFileError(explained(path, error)) from error
            raise

    @classmethod
    def _connect(cls, path: Path, lock: WriterLock) -> Self:
        database: sqlite3.Connection | None = None
        try:
            take_up_log(path.resolve())
            database = connected(path, "rw")
            version = identified(path, database)
            if version < SCHEMA_VERSION:
                migrate(database, version)
            use_write_ahead_log(path, database)
            opened = cls(path, database, lock)
            if not up_to_date(database):
                with opened.transaction():
                    write_words(database)
            opened.rows("SELECT 1 FROM memory LIMIT 1")  # the first read of a new log ends what holds off checkpoints
            return opened
        except BaseException as error:
            if database is not None:
                database.close()
            lock.release()
            if isinstance(error, FAILURES):
                raise MemoryFileError(explained(path, error)) from error
            raise

    def __del__(self) -> None:
        with contextlib.suppress(Exception):  # what is dropped lets go of the file
            self.close()

    def close(self) -> None:
        """Fold the write-ahead log into the one file, release the lock. A second call does nothing.

        Where a reader is amid a snapshot the log stays, beside the file, for the next that writes to fold in.
        """
        if isinstance(self._database, _Closed):
            return
        if self._lock is not None and self._committed is not None and os.getpid() == self._process:
            self._write_followers()
            self._committed.close()
            fold_in(self._database, _LAST_WAIT_MS)
        self._database.close()
        self._database = cast(sqlite3.Connection, _Closed(self.path))
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    def _write_followers(self) -> None:
        """Write what follows from the rows and was left for later."""
        if any(follower.pending for follower in self._followers):
            with contextlib.suppress(sqlite3.Error), self.transaction():
                pass

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """All that is written inside is written together or not at all. Not re-entrant."""
        with self._guard:
            self._check_process()
            try:
                self._database.execute("BEGIN IMMEDIATE")
                self._held_version = None
                self._writing = True
                try:
                    yield
                    self._finish_writing()
                except BaseException:
                    self._roll_back()
                    raise
                self._database.execute("COMMIT")
            except sqlite3.Error as error:
                self._roll_back()
                raise MemoryFileError(explained(self.path, error)) from error
            except UnicodeEncodeError as error:  # a name of a file may hold any bytes
                raise OptionError(f"{str(error.object)[:200]} is not valid UTF-8; rename it") from error
            finally:
                self._writing = False

    def _finish_writing(self) -> None:
        """Check what was written, and what it was written over, then write what follows from it."""
        self.refuse(self._checks.found())
        self.refuse(self._written_over())
        for follower in self._followers:
            follower.write()

    def _written_over(self) -> str | None:
        """The first damage of what the transaction that runs writes over, which must not be signed again."""
        if self._sums is None or self._committed is None:
            return None
        return next((str(bad) for bad in self._sums.damaged_before(self._committed())), None)

    def refuse(self, found: str | None) -> None:
        """Raise `MemoryFileError` where damage was found, and say so each time."""
        if found is not None:
            raise MemoryFileError(damaged(self.path, found))

    def _roll_back(self) -> None:
        self.rollbacks += 1
        for follower in self._followers:
            follower.forget()
        if self._database.in_transaction:
            self._database.execute("ROLLBACK")
        self.forget()

    def on_forget(self, forget: Callable[[], None]) -> None:
        """Call this method whenever what a table keeps of its rows may not hold any more. It keeps no table alive."""
        self._on_forget.append(weakref.WeakMethod(forget))

    def forget(self) -> None:
        """Let every table read its rows again when they are next asked for."""
        for known in self._on_forget:
            forget = known()
            if forget is not None:
                forget()

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All that is read inside belongs to one state of the memory, whatever a writer commits meanwhile."""
        self.refuse(self._checks.damage)
        with self._state():
            yield

    @contextlib.contextmanager
    def _state(self) -> Iterator[None]:
        """`snapshot`, of a damaged memory too."""
        with self._guard:
            if self._database.in_transaction:
                yield
                return
            try:
                self._database.execute("BEGIN")
                self._held_version = None
            except FAILURES as error:
                raise MemoryFileError(explained(self.path, error)) from error
            try:
                yield
            finally:
                self._end_reading()

    def _end_reading(self) -> None:
        if self._database.in_transaction:
            with contextlib.suppress(sqlite3.DatabaseError):  # nothing was written; damage was met on the way
                self._database.execute("ROLLBACK")

    @contextlib.contextmanager
    def unchecked(self) -> Iterator[sqlite3.Connection]:
        """One state of the file as SQLite reads it, damaged text too, for what looks for damage; other threads wait."""
        with self._guard:
            before, self._database.text_factory = self._database.text_factory, any_text
            try:
                with self._state(), self._checks.resting():
                    yield self._database
            finally:
                self._database.text_factory = before

    @contextlib.contextmanager
    def temporary(self) -> Iterator[None]:
        """Temporary tables may be made and written inside, of a file that is only read."""
        self._database.execute("PRAGMA query_only=OFF")
        try:
            yield
        finally:
            self._database.execute("PRAGMA query_only=ON")

    def execute(self, statement: str, arguments: Arguments = ()) -> Done:
        """Run one statement that writes; inside `transaction()`."""
        cursor = self._database.execute(statement, arguments)
        return Done(int(cursor.lastrowid or 0), cursor.rowcount)

    def execute_many(self, statement: str, arguments: Iterable[Arguments]) -> None:
        """Run a statement that writes for many rows; inside `transaction()`."""
        self._database.executemany(statement, arguments)

    @property
    def data_version(self) -> int:
        """Another number as soon as another connection has changed the file; what is open stands on one state of it."""
        self._check_process()
        if self._held_version is None or not self._database.in_transaction:
            self._held_version = int(self.rows("PRAGMA data_version")[0][0])
        return self._held_version

    def stamp(self) -> tuple[int, int, int]:
        """Changes whenever the content may have: by other processes, by this store, by a rollback."""
        return self.data_version, self._database.total_changes, self.rollbacks

    def rows(self, query: str, arguments: Arguments = ()) -> list[tuple[Any, ...]]:
        """All rows of a question, checked as `read_checks` says."""
        self._check_process()
        try:
            rows = self._database.execute(query, arguments).fetchall()
            self.refuse(self._checks.found())
            return rows
        except FAILURES as error:
            raise MemoryFileError(explained(self.path, error)) from error

    def _check_process(self) -> None:
        """Raise `MemoryFileError` in a forked child: the locks of the file are those of its parent."""
        if os.getpid() != self._process:
            raise MemoryFileError(f"{self.path} was opened by the process that this one was forked from; open it again")

    def by_part(self, table: str) -> bool:
        """Whether the rows of a table are checked as they are read, and not all when the first of them is."""
        return self._checks.by_part(table)

    def believed(self, table: str, rows: list[tuple[Any, ...]], *, keep: bool = True) -> list[tuple[Any, ...]]:
        """Whole rows of a table, the id first, as they are: checked one by one where the table is not as a whole, and
        then known to `rows_unchecked` where that is to be kept.
        """
        if self._checks.by_part(table):
            sound, written = self._checks.sound_parts(table), self._written(table)
            asked = [row for row in rows if (part := int(row[0]) >> PART_BITS) not in sound and part not in written]
            try:
                bad = unbelieved(self._database, table, asked)
            except FAILURES as error:
                raise MemoryFileError(explained(self.path, error)) from error
            self.refuse(f"{table} {bad[0]}: the row is not as it was written" if bad else None)
            if keep:
                self._checks.keep_sound(table, (row[0] for row in asked))
        return rows

    def _written(self, table: str) -> frozenset[int]:
        """Parts of a table that the transaction that runs has changed."""
        return frozenset() if self._sums is None else self._sums.touched(table)

    def seals(self, table: str) -> dict[int, bytes]:
        """What changes when any row of a part of a table does, by part; empty for those that the transaction that runs
        has changed.
        """
        try:
            return stored_seals(self._database, table) | dict.fromkeys(self._written(table), b"")
        except FAILURES as error:
            raise MemoryFileError(explained(self.path, error)) from error

    def rows_unchecked(self, table: str, ids: Iterable[int]) -> list[int]:
        """Those of some ids whose rows were not checked yet, of a table that is checked row by row."""
        return self._checks.unchecked(table, ids)

    def sound(self, table: str, keys: Iterable[int]) -> None:
        """Check what rows with these first keys stand in, where the table is not checked as a whole."""
        self.refuse(self._checks.found_in_parts(table, keys))


class _Closed:
    """What stands in the place of the file once it is closed."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __getattr__(self, name: str) -> Any:
        raise MemoryFileError(f"{self._path} is closed; open it again")


def is_ours(trace: TracebackType | None) -> bool:
    """Whether an error came out of this package, and not of what its user does beside."""
    return any(str(frame.f_globals.get("__name__", "")).startswith("list3r.") for frame, _ in walk_tb(trace))


def remove_memory(path: Path) -> None:
    """Delete a memory file and what SQLite leaves beside it."""
    for part in (path, *(Path(f"{path}{end}") for end in ("-wal", "-shm", "-journal"))):
        part.unlink(missing_ok=True)


def damaged(path: Path, found: str) -> str:
    """Return what is said of a damaged file."""
    return f"{path} is damaged ({found}); `list3r repair {path}` saves what is sound"


def _size(database: sqlite3.Connection) -> int:
    """Bytes of a database, what is only in its log included."""
    pages = [database.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size")]
    return int(pages[0]) * int(pages[1])
