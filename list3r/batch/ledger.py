"""The manifest of a batch: a row for each task with its state, in one SQLite file next to the memories.

It shows progress and avoids checks of finished tasks. The proof is the published file, which names its tasks: a lost
manifest is written again without building anything twice.
"""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Self

from list3r.batch.tasks import BatchTask
from list3r.batch.work import Outcome
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.store.lock import WriterLock

_SCHEMA = """
CREATE TABLE IF NOT EXISTS tasks (
    memory TEXT NOT NULL, source TEXT NOT NULL, source_hash TEXT NOT NULL, settings_hash TEXT NOT NULL,
    state TEXT NOT NULL, attempts INTEGER NOT NULL, reason TEXT NOT NULL, sha256 TEXT NOT NULL, bytes INTEGER NOT NULL,
    frames INTEGER NOT NULL, instances INTEGER NOT NULL, seconds REAL NOT NULL, PRIMARY KEY (memory, source));
CREATE TABLE IF NOT EXISTS attempts (
    memory TEXT NOT NULL, source TEXT NOT NULL, began_at REAL NOT NULL, ended_at REAL, outcome TEXT NOT NULL,
    built INTEGER NOT NULL, reason TEXT NOT NULL, place TEXT NOT NULL);
"""
_APPLICATION_ID = 0x4C334231
"""ASCII "L3B1"."""


@dataclass(frozen=True)
class TaskRow:
    """State of one task."""

    memory: str
    source: str
    source_hash: str
    settings_hash: str
    state: str = "pending"
    """pending, running, done or failed."""
    attempts: int = 0
    """Over all runs."""
    reason: str = ""
    """Why it failed, one line."""
    sha256: str = ""
    """Of the published file when this task was in it."""
    bytes: int = 0
    frames: int = 0
    instances: int = 0
    seconds: float = 0.0
    """Wall time of the attempt that ended it."""


_COLUMNS = ", ".join(f.name for f in fields(TaskRow))
_MARKS = ", ".join("?" for _ in fields(TaskRow))


class Ledger:
    """The rows of the tasks. One batch at a time holds it; a killed one lets go of it."""

    def __init__(self, path: Path) -> None:
        """Raises `MemoryFileError` where another batch holds it, or it is no manifest of a batch."""
        self._lock = WriterLock(path)
        try:
            self._database = sqlite3.connect(path, isolation_level=None)
            known = self._database.execute("PRAGMA application_id").fetchone()[0]
            if known == 0 and not self._database.execute("SELECT 1 FROM sqlite_master").fetchone():
                self._database.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
            elif known != _APPLICATION_ID:
                raise sqlite3.DatabaseError("another file has its name")
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.executescript(_SCHEMA)
        except sqlite3.Error as error:
            self._lock.release()
            raise MemoryFileError(
                f"{path} is not the state file of a batch ({error}); move it away or give --state"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(sqlite3.Error), self._transaction():
            self._release()
        self._database.close()
        self._lock.release()

    def begin(self, tasks: Sequence[BatchTask]) -> dict[BatchTask, TaskRow]:
        """Return the row of each task: the earlier one where source and settings are the same, else a new one. Tasks
        that ran when a batch was killed are pending again.
        """
        with self._transaction():
            self._release()
            for t in tasks:
                same = (t.memory, t.source, t.source_hash, t.settings_hash)
                query = "SELECT attempts FROM tasks WHERE (memory, source, source_hash, settings_hash) = (?, ?, ?, ?)"
                if self._database.execute(query, same).fetchone() is None:
                    row = astuple(TaskRow(*same))
                    self._database.execute(f"INSERT OR REPLACE INTO tasks ({_COLUMNS}) VALUES ({_MARKS})", row)
        rows = {(r.memory, r.source): r for r in self.rows()}
        return {t: rows[t.memory, t.source] for t in tasks}

    def _release(self) -> None:
        """Make tasks without a worker pending."""
        self._database.execute("UPDATE tasks SET state = 'pending' WHERE state = 'running'")
        self._database.execute(
            "UPDATE attempts SET outcome = 'lost', reason = 'the batch was ended' "
            "WHERE ended_at IS NULL AND outcome = ''"
        )

    def rows(self) -> list[TaskRow]:
        """Return all rows, by memory and in the order in which they came."""
        found = self._database.execute(f"SELECT {_COLUMNS} FROM tasks ORDER BY memory, rowid").fetchall()
        return [TaskRow(*row) for row in found]

    def started(self, task: BatchTask) -> None:
        """Write down that a task was handed to the engine."""
        with self._transaction():
            self._set(task, "state = 'running', attempts = attempts + 1")
            row = (task.memory, task.source, time.time(), "", 0, "", "")
            self._database.execute("INSERT INTO attempts VALUES (?, ?, ?, NULL, ?, ?, ?, ?)", row)

    def ended(self, outcome: Outcome, state: str) -> None:
        """Write down how an attempt ended, and the state that its task is in now."""
        task, o = outcome.task, outcome
        with self._transaction():
            self._set(
                task,
                "state = ?, reason = ?, sha256 = ?, bytes = ?, seconds = ?",
                (state, "" if state == "done" else o.reason, o.sha256, o.bytes, o.seconds),
            )
            if o.built:
                self._set(task, "frames = ?, instances = ?", (o.frames, o.instances))
            self._database.execute(
                "UPDATE attempts SET ended_at = ?, outcome = ?, built = ?, reason = ?, place = ? "
                "WHERE memory = ? AND source = ? AND ended_at IS NULL AND outcome = ''",
                (time.time(), o.state, int(o.built), o.reason, o.where, task.memory, task.source),
            )

    def _set(self, task: BatchTask, assignments: str, values: Sequence[object] = ()) -> None:
        statement = f"UPDATE tasks SET {assignments} WHERE memory = ? AND source = ?"
        self._database.execute(statement, (*values, task.memory, task.source))

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._database.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._database.execute("ROLLBACK")
            raise
        self._database.execute("COMMIT")
