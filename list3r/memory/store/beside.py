"""The write-ahead log beside a memory: whether it is that of the file, and what is done with another one."""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from pathlib import Path

import apsw

from list3r.memory.core.errors import MemoryFileError, MemoryFileWarning
from list3r.memory.store.database import Database
from list3r.memory.store.file import connected, identified, private_copy, reader, rename_exclusively
from list3r.memory.store.log_mark import Log, Mark, mark_of_file

_LOOKS = 20
"""How often a log is looked at that a writer changes meanwhile, and"""
_PAUSE_S = 0.02
"""the time in between."""
_LEFT = "left by a writer that was killed before this file took the name"


def opened_to_read(path: Path) -> Database:
    """A connection for reading: see `reader`. The log of another file is left out, with a `MemoryFileWarning`.

    Raises `MemoryFileError` or `apsw.Error` for a file that is cut off.
    """
    log, own = _log_beside(path)
    if log is not None and not own:
        _check_alone(path)
        _warn(
            f"{_log_path(path).name} is the log of another file than {path}, {_LEFT}; it is not read, and "
            f"`list3r repair {path}` moves it out of the way"
        )
        return private_copy(path, log=False)
    if log is not None:
        _check_complete(path, log)
    return reader(path)


def take_up_log(path: Path) -> None:
    """See to it that a file that is about to be written has no log beside it but its own.

    For the holder of the lock. A log of another file gets another name, with a `MemoryFileWarning`. Raises
    `MemoryFileError` or `apsw.Error` for a file that cannot be opened; nothing is changed then.
    """
    log, own = _log_beside(path)
    if log is not None and own:
        _check_complete(path, log)
        with contextlib.closing(reader(path)) as database:
            identified(path, database)
    elif log is not None:
        _check_alone(path)
        _put_aside(path)


def put_foreign_log_aside(path: Path) -> None:
    """Give a log that is not that of the file another name, whatever the file is; for the holder of the lock."""
    log, own = _log_beside(path)
    if log is not None and not own:
        _put_aside(path)


def not_alone(path: Path, database: Database) -> str | None:
    """One sentence where a file lacks what was written last, which lies in the log beside it or did; None where not."""
    log = _log_path(path.resolve())
    size = log.stat().st_size if log.exists() else 0
    if size and has_foreign_log(path.resolve()):
        return f"{log.name} is the log of another file and is not read"
    if size:
        return (
            f"what was written last lies in {log.name} ({size / 1e6:.2f} MB): a copy needs both files; "
            f"`list3r repair {path}` folds it in when nobody writes"
        )
    copied = database.execute("PRAGMA journal_mode").fetchall()[0][0] == "off"
    return f"it was copied while {log.name} was beside it; what was written last may be missing" if copied else None


def has_foreign_log(path: Path) -> bool:
    """Whether the log beside a file is that of another one."""
    log, own = _log_beside(path)
    return log is not None and not own


def _log_path(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def _log_beside(path: Path) -> tuple[Log | None, bool]:
    """The log beside a file, None where nothing is in it, and whether it is that of the file.

    A writer may change both between two looks: a log is another file's if two looks in a row say so of the same state.
    """
    log, before = None, None
    for look in range(_LOOKS):
        if look:
            time.sleep(_PAUSE_S)
        log = Log.read(_log_path(path))
        if log is None:
            break
        mark = _mark(path)
        if log.belongs_to(mark):
            return log, True
        if (log, mark) == before:
            break
        before = log, mark
    return log, False


def _mark(path: Path) -> Mark | None:
    """The mark in a file; also where a checkpoint that was killed left it shorter than it is with its log."""
    try:
        with contextlib.closing(connected(path, "file", whole=False)) as alone:
            return mark_of_file(alone)
    except apsw.Error:
        return None


def _check_alone(path: Path) -> None:
    """Raise `MemoryFileError` or `apsw.Error` for a file that is no whole memory without its log."""
    with contextlib.closing(connected(path, "file")) as database:
        identified(path, database)


def _check_complete(path: Path, log: Log) -> None:
    """Raise `MemoryFileError` for a file that lacks pages which its log does not hold either.

    Pages that SQLite needs no more it does not write: without them the database is whole all the same.
    """
    if not log.missing(path.stat().st_size):
        return
    try:
        with contextlib.closing(private_copy(path)) as copy:
            found = copy.execute("PRAGMA quick_check(1)").fetchall()[0][0]
    except apsw.Error as error:
        found = str(error)
    if found != "ok":
        raise MemoryFileError(
            f"{path} is cut off, or a part of a copy ({found}); copy it again, with {_log_path(path).name}, or use a "
            "backup"
        )


def _put_aside(path: Path) -> None:
    """Rename the log, and what its readers share, to the first names that are free."""
    log, shared, n = _log_path(path), path.with_name(f"{path.name}-shm"), 1
    while any(os.path.lexists(f"{part}.foreign-{n}") for part in (log, shared)):
        n += 1
    with contextlib.suppress(FileNotFoundError):
        rename_exclusively(shared, Path(f"{shared}.foreign-{n}"))
    rename_exclusively(log, Path(f"{log}.foreign-{n}"))
    _warn(
        f"{log.name} was the log of another file than {path}, {_LEFT}; it was not applied and is kept as "
        f"{log.name}.foreign-{n}"
    )


def _warn(text: str) -> None:
    warnings.warn(text, MemoryFileWarning, stacklevel=3)
