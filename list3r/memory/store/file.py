"""The memory file as such: how it is opened, what is refused, how older ones are brought forward."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import time
from pathlib import Path
from urllib.parse import quote

from list3r.memory.errors import MemoryFileError
from list3r.memory.store.checksums import write_all
from list3r.memory.store.codec import MAX_BLOB_BYTES
from list3r.memory.store.schema import APPLICATION_ID, MIGRATIONS, SCHEMA_VERSION, expected_schema, read_schema
from list3r.memory.store.word_index import write_words

PAGE_BYTES = 16384
"""Pages of new files. A row of a clustered table stays in its page up to a quarter of it. Vectors of up to 1,000
numbers do; in pages of 4 KiB each of 256 takes a page of overflow, four times the room and one more page to read.
"""
_CACHE_KIB = 65536
"""Pages that a connection keeps to read;"""
_WRITER_CACHE_KIB = 16384
"""and one that writes, which touches little at a time."""
_WAIT_S = 30.0
"""How long one process waits for what another holds only for a moment."""


_SMALLEST = 512
"""Bytes of the smallest SQLite file."""


def explained(path: Path, error: Exception) -> str:
    text = str(error)
    if "not a database" in text:
        return f"{path} is not a memory file; make one with `list3r build SOURCE -m MEMORY`"
    if "full" in text or "disk I/O" in text:
        return (
            f"{path} could not be written, the disk is full or failing ({text}); free some space and give the command "
            "again, a build or an update with --resume"
        )
    if "readonly" in text:
        return f"{path} is read-only; make it writable or copy it"
    if "locked" in text:
        return f"{path} is being written by another process; wait for it to end"
    return f"{path}: {text}; run `list3r verify {path}`, `list3r repair {path}` saves what is sound"


def connected(path: Path, mode: str) -> sqlite3.Connection:
    """A connection that runs nothing that the file brings along and holds no value larger than a blob may be."""
    uri = f"file:{quote(str(path.resolve()))}?mode={mode}"
    database = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_WAIT_S, check_same_thread=False)
    try:
        protect(database)
    except BaseException:
        database.close()
        raise
    return database


def protect(database: sqlite3.Connection) -> None:
    """Settings under which the file of a stranger may be read."""
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BLOB_BYTES + 2**20)
    for setting in ("trusted_schema=OFF", "cell_size_check=ON", "temp_store=MEMORY", f"cache_size=-{_CACHE_KIB}"):
        database.execute(f"PRAGMA {setting}")


def identified(path: Path, database: sqlite3.Connection) -> int:
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


def write_empty(path: Path, new: Path) -> None:
    """A memory without rows, whole and on the disk. Raises `MemoryFileError`."""
    try:
        os.close(os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644))
        database = connected(new, "rw")
        try:
            database.execute(f"PRAGMA page_size = {PAGE_BYTES}")
            database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            migrate(database, 0)
        finally:
            database.close()
    except OSError as error:
        raise MemoryFileError(f"{path} cannot be created: {error.strerror}") from error
    except sqlite3.Error as error:
        raise MemoryFileError(explained(path, error)) from error


def use_write_ahead_log(database: sqlite3.Connection) -> None:
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
    database.execute(f"PRAGMA cache_size=-{_WRITER_CACHE_KIB}")


def migrated_copy(path: Path) -> sqlite3.Connection:
    """A copy of an older file in the present schema, in a nameless file of SQLite that ends with the connection."""
    with contextlib.closing(connected(path, "ro")) as source:
        copy = sqlite3.connect("", isolation_level=None, check_same_thread=False)
        try:
            source.backup(copy)
            protect(copy)
            migrate(copy, identified(path, copy))
        except BaseException:
            copy.close()
            raise
        return copy


def migrate(database: sqlite3.Connection, version: int) -> None:
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
