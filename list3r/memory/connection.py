"""One memory file: opening, migrating, locking, transactions and the key-value table."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from list3r.memory.codec import to_json
from list3r.memory.errors import MemoryFileError
from list3r.memory.schema import APPLICATION_ID, MIGRATIONS, SCHEMA_VERSION


class Connection:
    """The file and its transactions; the verbs of the store stand on it."""

    def __init__(self, path: Path, database: sqlite3.Connection, lock: int | None) -> None:
        self.path = path
        self._database = database
        self._lock = lock

    @classmethod
    def create(cls, path: str | Path) -> Self:
        """A new, empty memory, open for writing. Raises `MemoryFileError` when the path is taken or not writable."""
        path = Path(path)
        if path.exists():
            raise MemoryFileError(f"{path} exists already; use --resume to go on with it or --force to replace it")
        if not path.parent.is_dir():
            raise MemoryFileError(f"the folder {path.parent} does not exist; create it first")
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        except OSError as error:
            raise MemoryFileError(f"{path} cannot be created: {error.strerror}") from error
        os.close(descriptor)
        try:
            return cls._connect(path, writable=True, fresh=True)
        except BaseException:
            remove_memory(path)
            raise

    @classmethod
    def open(cls, path: str | Path, *, writable: bool = False) -> Self:
        """An existing memory; older schemas are migrated forward. Raises `MemoryFileError` for anything else."""
        path = Path(path)
        if not path.exists():
            raise MemoryFileError(f"{path} does not exist; make it with `list3r build SOURCE -m {path}`")
        if path.is_dir():
            raise MemoryFileError(f"{path} is a folder, not a memory file")
        try:
            with path.open("rb") as file:
                header = file.read(100)
        except OSError as error:
            raise MemoryFileError(f"{path} cannot be read: {error.strerror}") from error
        if len(header) < 100 or not header.startswith(b"SQLite format 3\x00"):
            raise MemoryFileError(f"{path} is not a memory file; make one with `list3r build SOURCE -m MEMORY`")
        if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
            raise MemoryFileError(f"{path} is an SQLite file, but not a LIST3R memory")
        return cls._connect(path, writable=writable, fresh=False)

    @classmethod
    def _connect(cls, path: Path, *, writable: bool, fresh: bool) -> Self:
        lock = _take_writer_lock(path) if writable else None
        database: sqlite3.Connection | None = None
        try:
            mode = "rw" if writable else "ro"
            uri = f"file:{quote(str(path.resolve()))}?mode={mode}"
            database = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=30.0, check_same_thread=False)
            database.execute("PRAGMA trusted_schema=OFF")
            version = int(database.execute("PRAGMA user_version").fetchone()[0])
            if version > SCHEMA_VERSION:
                raise MemoryFileError(
                    f"{path} has schema version {version}, this program knows up to {SCHEMA_VERSION}; update list3r"
                )
            if version < SCHEMA_VERSION and not writable:
                raise MemoryFileError(f"{path} has the old schema version {version}; open it once for writing")
            if writable:
                # Before the write-ahead log: so the file itself says what it is, whatever happens next.
                _migrate(database, version, fresh)
                database.execute("PRAGMA journal_mode=WAL")
                database.execute("PRAGMA synchronous=NORMAL")
        except sqlite3.DatabaseError as error:
            _release(database, lock)
            raise MemoryFileError(_explain(path, error)) from error
        except BaseException:
            _release(database, lock)
            raise
        return cls(path, database, lock)

    def close(self) -> None:
        """Fold the write-ahead log into the one file, release the lock. A second call does nothing."""
        if self._lock is not None:
            with contextlib.suppress(sqlite3.Error):
                self._database.execute("PRAGMA journal_mode=DELETE")
        _release(self._database, self._lock)
        self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """All that is written inside is written together or not at all. Not re-entrant."""
        try:
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise
            self._database.execute("COMMIT")
        except sqlite3.Error as error:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
            raise MemoryFileError(_explain(self.path, error)) from error

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All that is read inside belongs to one state of the memory, whatever a writer commits meanwhile."""
        if self._database.in_transaction:
            yield
            return
        self._database.execute("BEGIN")
        try:
            yield
        finally:
            if self._database.in_transaction:
                self._database.execute("COMMIT")

    def get_value(self, key: str, default: Any = None) -> Any:
        """A value of the key-value table, decoded from JSON.

        Keys in use: `scale_kind`, `scale_source`, `gravity` (known, estimated, unknown), `T_world_graph` (4x4),
        `gravity_estimate` (up and floor in the graph's frame, see `memory.gravity`), `feature_space`, `last_id`,
        `created_by`.
        """
        row = self._database.execute("SELECT value FROM memory WHERE key = ?", (key,)).fetchone()
        return default if row is None else json.loads(row[0])

    def set_value(self, key: str, value: object) -> None:
        """Set a value of the key-value table; anything JSON holds."""
        self._database.execute("INSERT OR REPLACE INTO memory VALUES (?, ?)", (key, to_json(value)))

    def _rows(self, query: str, arguments: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        try:
            return self._database.execute(query, arguments).fetchall()
        except sqlite3.DatabaseError as error:
            raise MemoryFileError(_explain(self.path, error)) from error


def remove_memory(path: Path) -> None:
    """Delete a memory file and the write-ahead log beside it."""
    for part in (path, Path(f"{path}-wal"), Path(f"{path}-shm")):
        part.unlink(missing_ok=True)


def _explain(path: Path, error: sqlite3.Error) -> str:
    text = str(error)
    if "full" in text or "disk I/O" in text:
        return f"{path} could not be written, the disk is full or failing ({text}); free some space and go on"
    if "readonly" in text:
        return f"{path} is read-only; make it writable or copy it"
    if "locked" in text:
        return f"{path} is being written by another process; wait for it to end"
    return f"{path}: {text}; run `list3r verify {path}`"


def _take_writer_lock(path: Path) -> int:
    """An advisory lock on the file, held until `close`; SQLite's own locks are of another kind and stay apart."""
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError as error:
        raise MemoryFileError(f"{path} cannot be written: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise MemoryFileError(f"{path} is being written by another process; wait for it to end") from error
    return descriptor


def _release(database: sqlite3.Connection | None, lock: int | None) -> None:
    if database is not None:
        database.close()
    if lock is not None:
        os.close(lock)


def _migrate(database: sqlite3.Connection, version: int, fresh: bool) -> None:
    if version == SCHEMA_VERSION:
        return
    statements = "\n".join(MIGRATIONS[version:])
    identity = f"PRAGMA application_id = {APPLICATION_ID};" if fresh else ""
    database.executescript(f"BEGIN IMMEDIATE; {identity} {statements} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;")
