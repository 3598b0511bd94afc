"""The memory file as such: how it is opened, what is refused, how older ones are brought forward."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import stat
import tempfile
import time
from pathlib import Path

import apsw

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.store.database import Database
from list3r.memory.store.log_mark import LOG_STARTS, begin_marking
from list3r.memory.store.pages import PageDamaged, schema_of
from list3r.memory.store.rows.codec import MAX_BLOB_BYTES
from list3r.memory.store.schema import APPLICATION_ID, MIGRATIONS, SCHEMA_VERSION, expected_schema, read_schema

PAGE_BYTES = 16384
"""Pages of new files. A row of a clustered table stays in its page up to a quarter of it. Vectors of up to 1,000
numbers do; in pages of 4 KiB each of 256 takes a page of overflow, four times the room and one more page to read.
"""
_CACHE_KIB = 65536
"""Pages that a connection keeps to read;"""
_WRITER_CACHE_KIB = 2048
"""and one that writes, which touches little at a time."""
_READERS_WAIT_S = 8.0
"""How long a new writer waits until nobody is amid a reading; those that begin while it writes are not in its way."""
_DRAIN_S = 0.1
"""For so long no reader is let in, and then for so long all are, while it waits."""
_WAIT_S = 30.0
"""How long one process waits for what another holds only for a moment."""


_SMALLEST = 512
"""Bytes of the smallest SQLite file."""
_UNREADABLE_HERE = {
    apsw.SQLITE_READONLY_ROLLBACK,
    apsw.SQLITE_READONLY_RECOVERY,
    apsw.SQLITE_READONLY_CANTINIT,
    apsw.SQLITE_READONLY,
    apsw.SQLITE_CANTOPEN,
    apsw.SQLITE_IOERR_LOCK,
}
"""What SQLite says of a file that it could read only by writing."""
_JOURNAL = bytes.fromhex("d9d505f920a163d7")
_BESIDE = {
    "-wal": LOG_STARTS,
    "-journal": (_JOURNAL, bytes(len(_JOURNAL))),
    "-shm": (),
}
"""What SQLite writes beside a file, and how it begins."""


def damaged(path: Path, found: str) -> str:
    """Return what is said of a damaged file."""
    return f"{path} is damaged ({found}); `list3r repair {path}` saves what is sound"


def explained(path: Path, error: Exception) -> str:
    """Return what is said where SQLite could not do something."""
    text = str(error)
    if isinstance(error, PageDamaged):
        return damaged(path, text)
    if isinstance(error, apsw.ConstraintError):
        return f"{path}: what was to be written is none of its table ({text}); nothing was changed"
    if "not a database" in text:
        return f"{path} is not a memory file; make one with `list3r build SOURCE -m MEMORY`"
    if isinstance(error, apsw.FullError | apsw.IOError):
        return (
            f"{path} could not be written, the disk is full or failing ({text}); free some space and run the command "
            "again, a build or an update with --resume"
        )
    if "readonly" in text:
        return f"{path} is read-only; make it writable or copy it"
    if "locked" in text:
        return f"{path} is being written by another process; wait for it to end"
    return f"{path}: {text}; run `list3r verify {path}`, `list3r repair {path}` saves what is sound"


def connected(path: Path, mode: str, *, alone: bool = False, whole: bool = True) -> Database:
    """A connection that runs nothing that the file brings along and holds no value larger than a blob may be.

    With `alone` it asks for the file for itself until it is told otherwise. The mode is one of SQLite, or `file`, in
    which only the file is read, as it is: no log or journal, and without a lock. Unless it is to be `whole`, a file
    that is shorter than it says is read as well.
    """
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError as error:
        raise MemoryFileError(f"the path {path} is not valid UTF-8; rename it") from error
    database = Database(path, mode)
    try:
        database.set_busy_timeout(round(1000 * _WAIT_S))
        if alone:
            database.execute("PRAGMA locking_mode=EXCLUSIVE").fetchall()
        if not whole:
            database.execute("PRAGMA writable_schema=ON")
        protect(database)
    except BaseException:
        database.close()
        raise
    return database


def protect(database: Database) -> None:
    """Settings under which the file of a stranger may be read."""
    database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_BLOB_BYTES + 2**20)
    for setting in ("trusted_schema=OFF", "cell_size_check=ON", "temp_store=MEMORY", f"cache_size=-{_CACHE_KIB}"):
        database.execute(f"PRAGMA {setting}").fetchall()


def identified(path: Path, database: Database) -> int:
    """The schema version of a memory. Raises `MemoryFileError` for what is none, is newer, or holds what none does."""
    application, version = numbers(database)
    if application != APPLICATION_ID and path.stat().st_size < _SMALLEST:
        raise MemoryFileError(f"{path} is not a memory file; make one with `list3r build SOURCE -m MEMORY`")
    check_numbers(path, application, version)
    if version < 1:
        raise MemoryFileError(f"{path} has schema version {version}, which never existed; the file is damaged")
    check_schema(path, database, version)
    return version


def numbers(database: Database) -> tuple[int, int]:
    """Return the application id and the schema version of a file."""
    application, version = (
        int(database.execute(f"PRAGMA {name}").fetchall()[0][0])  # type: ignore[arg-type]
        for name in ("application_id", "user_version")
    )
    return application, schema_of(version)


def check_numbers(path: Path, application: int, version: int) -> None:
    """Raise `MemoryFileError` for a file of another program, or of a newer version of this one."""
    if application != APPLICATION_ID:
        raise MemoryFileError(f"{path} is an SQLite file, but not a LIST3R memory; name another file")
    if version > SCHEMA_VERSION:
        raise MemoryFileError(
            f"{path} is of a newer list3r (schema {version}; this one reads up to {SCHEMA_VERSION}); update list3r"
        )


def check_schema(path: Path, database: Database, version: int) -> None:
    """Raise `MemoryFileError` when the file holds anything else than its schema: tables, triggers, views, indices."""
    expected, found = expected_schema(version), read_schema(database)
    for kind, name in sorted(found.keys() - expected.keys()):
        raise MemoryFileError(f"{path} holds a {kind} {name!r}, which no memory has; it was not opened")
    for kind, name in sorted(expected.keys()):
        if found.get((kind, name)) != expected[kind, name]:
            state = "is not the one of" if (kind, name) in found else "is missing for"
            raise MemoryFileError(
                f"{path}: the {kind} {name} {state} schema version {version}; the file is damaged or of another program"
            )


def write_empty(path: Path) -> None:
    """Write a memory without rows, whole and on the disk before it gets its name. Raises `MemoryFileError`."""
    new: Path | None = None
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name}-new-", dir=path.parent)
        new = Path(name)
        os.fchmod(descriptor, 0o666 & ~_umask())
        os.close(descriptor)
        database = connected(new, "rw")
        try:
            database.start(PAGE_BYTES)
            for setting in ("journal_mode = WAL", f"application_id = {APPLICATION_ID}"):
                database.execute(f"PRAGMA {setting}").fetchall()
            migrate(database, 0)
            fold_in(database, 0)
        finally:
            database.close()
        rename_exclusively(new, path)
    except FileExistsError as error:
        raise MemoryFileError(taken(path)) from error
    except OSError as error:
        raise MemoryFileError(f"{path} cannot be created: {error.strerror}") from error
    except apsw.Error as error:
        raise MemoryFileError(explained(path, error)) from error
    finally:
        for end in ("", "-wal", "-shm", "-journal") if new is not None else ():
            Path(f"{new}{end}").unlink(missing_ok=True)


def taken(path: Path) -> str:
    """What is said where a new memory is asked for under a name that is taken."""
    return f"{path} already exists; use --resume to continue it or --force to replace it"


def rename_exclusively(old: Path, new: Path) -> None:
    """Give a file a name that no file has. Raises `FileExistsError`; without hard links the name is looked up."""
    try:
        os.link(old, new, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:
        if os.path.lexists(new):
            raise FileExistsError(str(new)) from None
        old.rename(new)
    else:
        old.unlink()


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def use_write_ahead_log(path: Path, database: Database) -> None:
    """Readers may hold the file for a moment as the journal changes; that is waited for.

    While SQLite waits it lets no new reader in, so that those who read without a pause do not keep a writer out; in
    between all may read, since one of them may have stopped for good. Raises `MemoryFileError` naming who does not
    let go.
    """
    end = time.monotonic() + _READERS_WAIT_S
    database.execute(f"PRAGMA busy_timeout={round(1000 * _DRAIN_S)}").fetchall()
    while True:
        try:
            begin_marking(database)
            database.execute("PRAGMA journal_mode=WAL").fetchall()
            break
        except apsw.BusyError as error:
            if time.monotonic() > end:
                raise MemoryFileError(
                    f"{path} is being read by {_readers(path.resolve())} and cannot be written until it is closed there"
                ) from error
            time.sleep(_DRAIN_S)
    database.execute(f"PRAGMA busy_timeout={round(1000 * _WAIT_S)}").fetchall()
    database.execute("PRAGMA synchronous=NORMAL")
    database.execute(f"PRAGMA cache_size=-{_WRITER_CACHE_KIB}")


def _readers(path: Path) -> str:
    """Who holds a lock on a file, in words, as far as the system tells."""
    inode = f":{path.stat().st_ino}"
    held: set[int] = set()
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()
            if "->" not in words and words[5].endswith(inode):
                held.add(int(words[4]))
    if os.getpid() in held:
        return "this process itself, in a snapshot,"
    return f"process {', '.join(map(str, sorted(held)))} (is it stopped?)" if held else "another process"


def private_copy(path: Path, *, log: bool = True) -> Database:
    """A connection to a copy of a file and of its journals, in the present schema, which nobody else sees and which
    ends with it. Without `log` what is in the log beside the file is left out.
    """
    try:
        with tempfile.TemporaryDirectory(prefix="list3r-") as folder:
            copy = Path(folder) / "copy.l3r"
            ends = ("", "-wal", "-journal") if log else ("", "-journal")
            for end in (end for end in ends if Path(f"{path}{end}").exists()):
                shutil.copyfile(f"{path}{end}", f"{copy}{end}")
            return _without_journal(path, connected(copy, "rw"))
    except OSError as error:
        raise MemoryFileError(f"{path} cannot be copied to be read: {error.strerror}") from error


def _without_journal(path: Path, database: Database) -> Database:
    """The same connection once what a journal undoes is undone; closed where that fails."""
    try:
        database.execute("SELECT count(*) FROM sqlite_master").fetchall()
        if (version := identified(path, database)) < SCHEMA_VERSION:
            database.execute("PRAGMA journal_mode=WAL").fetchall()
            migrate(database, version)
        database.execute("PRAGMA journal_mode=OFF").fetchall()
    except BaseException:
        database.close()
        raise
    return database


def check_beside(path: Path) -> None:
    """Raise `MemoryFileError` where what SQLite would take for its own beside a memory is something else."""
    for end, starts in _BESIDE.items():
        beside = Path(f"{path}{end}")
        try:
            found = beside.lstat()
        except OSError:
            continue
        ours = stat.S_ISREG(found.st_mode) and found.st_nlink == 1
        if ours and found.st_size and starts:
            with contextlib.suppress(PermissionError, FileNotFoundError), beside.open("rb") as file:
                head = file.read(len(starts[0]))
                ours = not head or head in starts  # a writer may have emptied it since
        if not ours:
            raise MemoryFileError(f"{beside} has a name that {path.name} needs while it is written; move it away")


def fold_in(database: Database, wait_ms: int) -> None:
    """Write the log into the one file and leave nothing beside it, unless somebody reads for longer than that."""
    for statement in (f"busy_timeout={wait_ms}", "wal_checkpoint(TRUNCATE)", "journal_mode=DELETE"):
        with contextlib.suppress(apsw.Error):
            database.execute(f"PRAGMA {statement}").fetchall()


def reader(path: Path) -> Database:
    """A connection for reading that writes nothing beside the file or into it.

    A file in the mode of a write-ahead log without the memory that its readers share (which a writer makes; a file that
    was copied away from one, or came in an archive, lacks it) is read as a private copy, and so is one whose writer was
    killed within a commit. The lock that is asked for tells such a file, for nobody can have it on a file that is only
    read: opening the file to look at it would drop the locks of this process when it is closed.
    """
    shared = _is_shared(path)
    try:
        database = connected(path, "ro", alone=not shared)
        try:
            for mode in ("EXCLUSIVE", "NORMAL")[shared:]:
                database.execute(f"PRAGMA locking_mode={mode}").fetchall()
                database.execute("SELECT count(*) FROM sqlite_master").fetchall()
            return database
        except BaseException:
            database.close()
            raise
    except apsw.Error as error:
        if not shared and _is_shared(path):
            return reader(path)
        if {getattr(error, "result", 0), getattr(error, "extendedresult", 0)} & _UNREADABLE_HERE:
            return private_copy(path)
        raise


def _is_shared(path: Path) -> bool:
    return Path(f"{path}-wal").exists() and Path(f"{path}-shm").exists()


def migrate(database: Database, version: int) -> None:
    """Bring a file forward to the present schema, in one transaction. Raises `apsw.Error` on damage."""
    if version:
        database.begin("IMMEDIATE")
    else:
        database.execute("BEGIN IMMEDIATE")
    try:
        for migration in MIGRATIONS[version:]:
            database.execute(migration)
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        database.commit()
    except BaseException:
        database.roll_back()
        raise


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
