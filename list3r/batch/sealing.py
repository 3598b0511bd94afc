"""A finished memory as a file that depends on the video and the settings alone, byte for byte."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import apsw

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.store.facts import Fact
from list3r.memory.store.file import connected, file_hash, fold_in
from list3r.memory.store.store import Store

BATCH_KEYS = Fact[tuple[str, ...]]("batch_keys", tuple[str, ...], ())
"""Keys of the batch tasks contained in a memory, in their order."""


def seal(memory: Path, sealed: Path, keys: Sequence[str], source: str) -> str:
    """Write a finished memory to `sealed`; return the SHA-256 of the file.

    Differences between runs are left out: durations of stages, the path of a fetched video (`source` is named instead,
    for the last session), and SQLite's page layout. Raises `MemoryFileError`.
    """
    with Store.open(memory, writable=True) as store, store.transaction():
        store.chunks.forget_seconds()
        store.facts[BATCH_KEYS] = tuple(keys)
        last = store.sessions.all()[-1]
        if last.source != source:
            store.sessions.put(replace(last, source=source))
    part = sealed.with_name(f"{sealed.name}.part")
    part.unlink(missing_ok=True)
    try:
        with contextlib.closing(connected(memory, "ro")) as database:
            database.execute("VACUUM INTO ?", (str(part),))
        with contextlib.closing(connected(part, "rw")) as database:
            for setting in ("journal_mode=WAL", "secure_delete=ON"):
                database.execute(f"PRAGMA {setting}").fetchall()
            database.sum_again()
            fold_in(database, 0)
    except apsw.Error as error:
        part.unlink(missing_ok=True)
        raise MemoryFileError(f"{sealed} cannot be written: {error}") from error
    part.replace(sealed)
    return file_hash(sealed)


def batch_keys(memory: Path) -> tuple[str, ...]:
    """Return the keys of the tasks contained in a published memory. Raises `MemoryFileError`."""
    with Store.open(memory) as store:
        return store.facts[BATCH_KEYS]
