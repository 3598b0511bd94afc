"""One memory file: opening, migrating, transactions and the key-value table."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from list3r.memory.codec import MAX_BLOB_BYTES, from_json, to_json
from list3r.memory.errors import List3rError, MemoryFileError
from list3r.memory.read_checks import FAILURES, WHOLE_BYTES, ReadChecks, unbelieved
from list3r.memory.schema import APPLICATION_ID, MIGRATIONS, SCHEMA_VERSION, expected_schema, read_schema
from list3r.memory.sums import Sums, write_all
from list3r.memory.word_index import WordIndex, up_to_date, write_words
from list3r.memory.writer_lock import WriterLock, lock_path

PAGE_BYTES = 16384
"""Pages of new files. A row of a clustered table stays in its page up to a quarter of it. Vectors of up to 1,000
numbers do; in pages of 4 KiB each of 256 takes a page of overflow, four times the room and one more page to read.
"""
_CACHE_KIB = 65536
"""Pages that a connection keeps."""
_WAIT_S = 30.0
"""How long one process waits for what another holds only for a moment."""


class Connection:
    """The file and its transactions; the verbs of the store stand on it.

    One object may be used by several threads; a snapshot or a transaction of one keeps the others waiting.
    """

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        self.path = path
        self._database = database
        self._lock = lock
        self._followers = () if lock is None else (WordIndex(database), Sums(database))
        """What follows the rows that a transaction changes; in this order as it commits."""
        self._checks = ReadChecks(database) if _size(database) <= WHOLE_BYTES else None
        self._writing = False
        self._guard = threading.RLock()
        self.rollbacks = 0
        """How often something written was taken back: an id may then stand for something else."""
        self.unsettled = 0
        """How often a chunk was unsettled, see `memory.library_verbs`."""

    @classmethod
    def create(cls, path: str | Path) -> Self:
        """A new, empty memory, open for writing. Raises `MemoryFileError` when the path is taken or not writable.

        The file appears under its name only when it is whole.
        """
        path = Path(path)
        if not path.parent.is_dir():
            raise MemoryFileError(f"the folder {path.parent} does not exist; create it first")
        if path.exists():
            raise MemoryFileError(f"{path} exists already; use --resume to go on with it or --force to replace it")
        lock = WriterLock(path.resolve())
        new = path.resolve().with_name(f"{path.resolve().name}-new")
        try:
            if path.exists():
                raise MemoryFileError(f"{path} exists already; use --resume to go on with it or --force to replace it")
            remove_memory(new)
            _write_empty(path, new)
            new.rename(path.resolve())
            return cls._connect(path, lock)
        except BaseException:
            remove_memory(new)
            lock.release()
            raise

    @classmethod
    def open(cls, path: str | Path, *, writable: bool = False) -> Self:
        """An existing memory. Raises `MemoryFileError` for anything else, and for a memory of a newer schema.

        A memory of an older schema is migrated where it lies, or, where it may not be written or another process
        writes it, in a copy that ends with the connection. Nothing in the file is executed: a trigger or view, or
        anything else that the schema does not have, is refused.
        """
        path = Path(path)
        if not path.exists():
            raise MemoryFileError(f"{path} does not exist; make it with `list3r build SOURCE -m {path}`")
        if path.is_dir():
            raise MemoryFileError(f"{path} is a folder, not a memory file")
        if not writable:
            return cls._open_to_read(path)
        try:
            return cls._connect(path, WriterLock(path.resolve()))
        except FAILURES as error:
            raise MemoryFileError(_explain(path, error)) from error

    @classmethod
    def _open_to_read(cls, path: Path) -> Self:
        try:
            database = _database(path, "ro")
            try:
                version = _identify(path, database)
            except sqlite3.OperationalError as error:
                database.close()
                if getattr(error, "sqlite_errorname", "") not in _UNFINISHED or not _writable_now(cls, path):
                    raise
                database = _database(path, "ro")
                version = _identify(path, database)
            except BaseException:
                database.close()
                raise
            if version < SCHEMA_VERSION:
                database.close()
                database = _database(path, "ro") if _writable_now(cls, path) else _migrated_copy(path)
            database.execute("PRAGMA query_only=ON")
            return cls(path, database, None)
        except FAILURES as error:
            raise MemoryFileError(_explain(path, error)) from error

    @classmethod
    def _connect(cls, path: Path, lock: WriterLock) -> Self:
        database: sqlite3.Connection | None = None
        try:
            database = _database(path, "rw")
            version = _identify(path, database)
            if version < SCHEMA_VERSION:
                _migrate(database, version)
            _use_write_ahead_log(database)
            opened = cls(path, database, lock)
            if not up_to_date(database):
                with opened.transaction():
                    write_words(database)
            opened._rows("SELECT 1 FROM memory LIMIT 1")  # the first read of a new log ends what holds off checkpoints
            return opened
        except BaseException as error:
            if database is not None:
                database.close()
            lock.release()
            if isinstance(error, FAILURES):
                raise MemoryFileError(_explain(path, error)) from error
            raise

    def close(self) -> None:
        """Fold the write-ahead log into the one file, release the lock. A second call does nothing."""
        if self._lock is not None:
            with contextlib.suppress(sqlite3.Error):
                if any(follower.pending for follower in self._followers):
                    with self.transaction():
                        pass
            for statement in ("wal_checkpoint(TRUNCATE)", "journal_mode=DELETE"):
                with contextlib.suppress(sqlite3.Error):
                    self._database.execute(f"PRAGMA {statement}").fetchall()
        self._database.close()
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        found = self._damage() if isinstance(error, Exception) and not isinstance(error, List3rError | OSError) else []
        self.close()
        if found:
            raise MemoryFileError(_damaged(self.path, found[0])) from error

    def _damage(self) -> list[str]:
        """What explains that something read could not be understood."""
        return []

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """All that is written inside is written together or not at all. Not re-entrant."""
        with self._guard:
            try:
                self._database.execute("BEGIN IMMEDIATE")
                self._writing = True
                try:
                    yield
                    for follower in self._followers:
                        follower.write()
                except BaseException:
                    self._roll_back()
                    raise
                self._database.execute("COMMIT")
            except sqlite3.Error as error:
                self._roll_back()
                raise MemoryFileError(_explain(self.path, error)) from error
            finally:
                self._writing = False

    def _roll_back(self) -> None:
        self.rollbacks += 1
        for follower in self._followers:
            follower.forget()
        if self._database.in_transaction:
            self._database.execute("ROLLBACK")

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All that is read inside belongs to one state of the memory, whatever a writer commits meanwhile."""
        with self._guard:
            if self._database.in_transaction:
                yield
                return
            self._rows("BEGIN")
            try:
                yield
            finally:
                if self._database.in_transaction:
                    with contextlib.suppress(sqlite3.DatabaseError):  # nothing was written; damage was met on the way
                        self._database.execute("ROLLBACK")

    def get_value(self, key: str, default: Any = None) -> Any:
        """A value of the key-value table, decoded from JSON.

        Keys in use: `scale_kind`, `scale_source`, `gravity` (known, estimated, unknown), `T_world_graph` (4x4),
        `gravity_estimate` (up and floor in the graph's frame, see `memory.gravity`), `library` (what all things are
        derived with, see `memory.library_rules`), `feature_space`, `last_id`, `created_by`.
        """
        rows = self._rows("SELECT value FROM memory WHERE key = ?", (key,))
        return from_json(rows[0][0], f"the value {key} of {self.path}") if rows else default

    def set_value(self, key: str, value: object) -> None:
        """Set a value of the key-value table; anything JSON holds."""
        self._database.execute("INSERT OR REPLACE INTO memory VALUES (?, ?)", (key, to_json(value)))

    def _rows(self, query: str, arguments: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        try:
            rows = self._database.execute(query, arguments).fetchall()
            if self._checks is not None and self._checks.pending and not self._writing:
                found = self._checks.found()
                if found is not None:
                    raise MemoryFileError(_damaged(self.path, found))
            return rows
        except FAILURES as error:
            raise MemoryFileError(_explain(self.path, error)) from error

    def _believed(self, table: str, rows: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Whole rows of a table, the id first, as they are: checked one by one where the table is not as a whole."""
        if self._checks is None and not self._writing:
            try:
                bad = unbelieved(self._database, table, rows)
            except FAILURES as error:
                raise MemoryFileError(_explain(self.path, error)) from error
            if bad:
                raise MemoryFileError(_damaged(self.path, f"{table} {bad[0]}: the row is not as it was written"))
        return rows


_UNFINISHED = ("SQLITE_READONLY_ROLLBACK", "SQLITE_READONLY_RECOVERY", "SQLITE_CANTOPEN", "SQLITE_READONLY")
"""What a reader meets where a killed writer left a journal that only a writer may undo."""


def remove_memory(path: Path) -> None:
    """Delete a memory file and what lies beside it while it is written."""
    for part in (path, *(Path(f"{path}{end}") for end in ("-wal", "-shm", "-journal")), lock_path(path)):
        part.unlink(missing_ok=True)


def _damaged(path: Path, found: str) -> str:
    return f"{path} is damaged ({found}); `list3r repair {path}` saves what is sound"


def _size(database: sqlite3.Connection) -> int:
    """Bytes of a database, what is only in its log included."""
    pages = [database.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size")]
    return int(pages[0]) * int(pages[1])


def _explain(path: Path, error: Exception) -> str:
    text = str(error)
    if "not a database" in text:
        return f"{path} is not a memory file; make one with `list3r build SOURCE -m MEMORY`"
    if "full" in text or "disk I/O" in text:
        return f"{path} could not be written, the disk is full or failing ({text}); free some space and go on"
    if "readonly" in text:
        return f"{path} is read-only; make it writable or copy it"
    if "locked" in text:
        return f"{path} is being written by another process; wait for it to end"
    return f"{path}: {text}; run `list3r verify {path}`, `list3r repair {path}` saves what is sound"


def _database(path: Path, mode: str) -> sqlite3.Connection:
    """A connection that runs nothing that the file brings along and holds no value larger than a blob may be."""
    uri = f"file:{quote(str(path.resolve()))}?mode={mode}"
    database = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_WAIT_S, check_same_thread=False)
    protect(database)
    return database


def protect(database: sqlite3.Connection) -> None:
    """Settings under which the file of a stranger may be read."""
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BLOB_BYTES + 2**20)
    for setting in ("trusted_schema=OFF", "cell_size_check=ON", "temp_store=MEMORY", f"cache_size=-{_CACHE_KIB}"):
        database.execute(f"PRAGMA {setting}")


def _identify(path: Path, database: sqlite3.Connection) -> int:
    """The schema version of a memory. Raises `MemoryFileError` for what is none, is newer, or holds what none does."""
    application = int(database.execute("PRAGMA application_id").fetchone()[0])
    version = int(database.execute("PRAGMA user_version").fetchone()[0])
    if application != APPLICATION_ID:
        if path.stat().st_size < _SMALLEST:
            raise MemoryFileError(f"{path} is not a memory file; make one with `list3r build SOURCE -m MEMORY`")
        raise MemoryFileError(f"{path} is an SQLite file, but not a LIST3R memory")
    if version > SCHEMA_VERSION:
        raise MemoryFileError(
            f"{path} has schema version {version}, this program knows up to {SCHEMA_VERSION}; update list3r"
        )
    if version < 1:
        raise MemoryFileError(f"{path} has schema version {version}, which there never was; the file is damaged")
    check_schema(path, database, version)
    return version


_SMALLEST = 512
"""Bytes of the smallest SQLite file."""


def check_schema(path: Path, database: sqlite3.Connection, version: int) -> None:
    """Raise `MemoryFileError` when the file holds anything else than its schema: tables, triggers, views, indices."""
    expected, found = expected_schema(version), read_schema(database)
    for kind, name in sorted(found.keys() - expected.keys()):
        raise MemoryFileError(f"{path} holds a {kind} {name!r}, which no memory has; it is not opened")
    for kind, name in sorted(expected.keys()):
        if found.get((kind, name)) != expected[kind, name]:
            state = "is not the one of" if (kind, name) in found else "is missing for"
            raise MemoryFileError(
                f"{path}: the {kind} {name} {state} schema version {version}; the file is damaged or not ours"
            )


def _write_empty(path: Path, new: Path) -> None:
    """A memory without rows, whole and on the disk. Raises `MemoryFileError`."""
    try:
        os.close(os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644))
        database = _database(new, "rw")
        try:
            database.execute(f"PRAGMA page_size = {PAGE_BYTES}")
            database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            _migrate(database, 0)
        finally:
            database.close()
    except OSError as error:
        raise MemoryFileError(f"{path} cannot be created: {error.strerror}") from error
    except sqlite3.Error as error:
        raise MemoryFileError(_explain(path, error)) from error


def _use_write_ahead_log(database: sqlite3.Connection) -> None:
    """Readers may hold the file for a moment as the journal changes; that is waited for."""
    end = time.monotonic() + _WAIT_S
    while True:
        try:
            database.execute("PRAGMA journal_mode=WAL").fetchall()
            break
        except sqlite3.OperationalError as error:
            if "locked" not in str(error) or time.monotonic() > end:
                raise
            time.sleep(0.01)
    database.execute("PRAGMA synchronous=NORMAL")


def _writable_now(kind: type[Connection], path: Path) -> bool:
    """Open for writing and close, which migrates and recovers a file; False where that may not be now."""
    if not (os.access(path, os.W_OK) and path.stat().st_mode & 0o222):
        return False
    try:
        kind.open(path, writable=True).close()
    except MemoryFileError:
        return False
    return True


def _migrated_copy(path: Path) -> sqlite3.Connection:
    """A copy of an older file in the present schema, in a nameless file of SQLite that ends with the connection."""
    with contextlib.closing(_database(path, "ro")) as source:
        copy = sqlite3.connect("", isolation_level=None, check_same_thread=False)
        try:
            source.backup(copy)
            protect(copy)
            _migrate(copy, _identify(path, copy))
        except BaseException:
            copy.close()
            raise
        return copy


def _migrate(database: sqlite3.Connection, version: int) -> None:
    """Bring a file forward to the present schema, in one transaction."""
    database.execute("BEGIN IMMEDIATE")
    try:
        for migration in MIGRATIONS[version:]:
            for statement in migration.split(";"):
                database.execute(statement)
        write_words(database)
        write_all(database)
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        database.execute("COMMIT")
    except BaseException:
        if database.in_transaction:
            database.execute("ROLLBACK")
        raise
