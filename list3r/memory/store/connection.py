"""One memory file: opening, transactions, and the statements that all tables are read and written by."""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from traceback import walk_tb
from types import TracebackType
from typing import Any, Self, cast

import apsw

from list3r.memory.core.errors import MemoryFileError, OptionError
from list3r.memory.store.beside import not_alone, opened_to_read, take_up_log
from list3r.memory.store.database import FAILURES, Database
from list3r.memory.store.file import (
    check_beside,
    connected,
    explained,
    fold_in,
    identified,
    migrate,
    private_copy,
    taken,
    use_write_ahead_log,
    write_empty,
)
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.log_mark import LogMark
from list3r.memory.store.schema import SCHEMA_VERSION
from list3r.memory.store.verify import damage_of

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

    def __init__(self, path: Path, database: Database, lock: WriterLock | None) -> None:
        self.path = path
        self._database = database
        self._lock = lock
        self._mark = LogMark(database)
        self._process = os.getpid()
        self._version = 0
        self.writing = False
        """Whether a transaction runs that writes."""
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
        database: Database | None = None
        try:
            database = opened_to_read(path.resolve())
            if identified(path, database) < SCHEMA_VERSION:
                database.close()
                database = private_copy(path)
            database.execute("PRAGMA query_only=ON").fetchall()
            return cls(path, database, None)
        except BaseException as error:
            if database is not None:
                database.close()
            if isinstance(error, FAILURES):
                raise MemoryFileError(explained(path, error)) from error
            raise

    @classmethod
    def _connect(cls, path: Path, lock: WriterLock) -> Self:
        database: Database | None = None
        try:
            take_up_log(path.resolve())
            database = connected(path, "rw")
            version = identified(path, database)
            use_write_ahead_log(path, database)
            if version < SCHEMA_VERSION:
                migrate(database, version)
            opened = cls(path, database, lock)
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
        if self._lock is not None and os.getpid() == self._process:
            fold_in(self._database, _LAST_WAIT_MS)
        self._database.close()
        self._database = cast(Database, _Closed(self.path))
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """All that is written inside is written together or not at all. Not re-entrant."""
        with self._guard:
            self._check_process()
            try:
                self._version = self._database.begin("IMMEDIATE")
                self.writing = True
                try:
                    yield
                    self._mark.write()
                    self._database.commit()
                    self._mark.forget()
                except BaseException:
                    self._roll_back()
                    raise
                self._database.fold_in_long_log()
            except FAILURES as error:
                if isinstance(error, UnicodeEncodeError):  # a name of a file may hold any bytes
                    raise OptionError(f"{str(error.object)[:200]} is not valid UTF-8; rename it") from error
                raise MemoryFileError(explained(self.path, error)) from error
            finally:
                self.writing = False

    def _roll_back(self) -> None:
        self.rollbacks += 1
        self._database.roll_back()
        self._mark.forget()
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
        with self._guard:
            if self._database.in_transaction:
                yield
                return
            self._begin_reading()
            try:
                yield
            finally:
                with contextlib.suppress(apsw.Error):  # nothing was written; damage was met on the way
                    self._database.roll_back()

    def _begin_reading(self) -> None:
        self._check_process()
        try:
            self._version = self._database.begin()
        except FAILURES as error:
            raise MemoryFileError(explained(self.path, error)) from error

    @contextlib.contextmanager
    def temporary(self) -> Iterator[None]:
        """Temporary tables may be made and written inside, of a file that is only read."""
        self._database.execute("PRAGMA query_only=OFF").fetchall()
        try:
            yield
        finally:
            self._database.execute("PRAGMA query_only=ON").fetchall()

    def execute(self, statement: str, arguments: Arguments = ()) -> Done:
        """Run one statement that writes; inside `transaction()`."""
        self._database.execute(statement, arguments)
        return Done(self._database.last_insert_rowid(), self._database.changes())

    def execute_many(self, statement: str, arguments: Iterable[Arguments]) -> None:
        """Run a statement that writes for many rows; inside `transaction()`."""
        self._database.executemany(statement, arguments)

    @property
    def data_version(self) -> int:
        """Another number as soon as another connection has changed the file; what is open stands on one state of it."""
        self._check_process()
        with self.snapshot():
            return self._version

    def stamp(self) -> tuple[int, int, int]:
        """Changes whenever the content may have: by other processes, by this store, by a rollback."""
        return self.data_version, self._database.total_changes(), self.rollbacks

    def rows(self, query: str, arguments: Arguments = ()) -> list[tuple[Any, ...]]:
        """All rows of a question; the pages that they were read from are as they were written."""
        with self._guard:
            self._check_process()
            if not self._database.in_transaction:
                with self.snapshot():
                    return self.rows(query, arguments)
            try:
                return self._database.execute(query, arguments).fetchall()
            except FAILURES as error:
                raise MemoryFileError(explained(self.path, error)) from error

    def damage(self) -> list[str]:
        """Every damage found, in one pass over the file."""
        try:
            with self.snapshot():
                return list(damage_of(self._database))
        except MemoryFileError as error:
            if error.__cause__ is None:
                raise
            return [str(error.__cause__)]

    def _check_process(self) -> None:
        """Raise `MemoryFileError` in a forked child: the locks of the file are those of its parent."""
        if os.getpid() != self._process:
            raise MemoryFileError(f"{self.path} was opened by the process that this one was forked from; open it again")


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
