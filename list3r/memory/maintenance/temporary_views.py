"""A memory shown otherwise than it is: a connection of its own, in which temporary tables and views stand before those
of the file. Nothing is written to it.
"""

from __future__ import annotations

import contextlib
import sqlite3
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from list3r.memory.records import Instance
from list3r.memory.store.committed import Committed
from list3r.memory.store.connection import Connection
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.read_checks import ReadChecks
from list3r.memory.store.store import Store

_TABLES = ("instances", "relations", "instance_boxes", "observations", "embeddings")
"""Tables that temporary ones may stand before."""


def store_shown(path: Path, take_in: Callable[[Store], None]) -> Store:
    """Return a store to read that `take_in` shows otherwise, now and whenever the file has changed."""
    connection = _ShownConnection.open(path)
    shown = _ShownStore(connection)
    connection.take_in = partial(take_in, weakref.proxy(shown))
    try:
        with shown.snapshot():
            return shown
    except BaseException:
        shown.close()
        raise


def put_before(shown: Store, instances: Sequence[Instance], *tables: str) -> None:
    """Let a store hold these instances and no others from now on, and empty tables before others of the file."""
    connection = shown.connection
    connection.forget()
    made = dict(connection.rows("SELECT name, sql FROM main.sqlite_master WHERE sql IS NOT NULL"))
    with connection.temporary():
        for table in ("instances", *tables):
            connection.execute(made[table].replace("CREATE TABLE", "CREATE TEMP TABLE", 1))
        boxes = made["instance_boxes"].replace("VIRTUAL TABLE instance_boxes", "VIRTUAL TABLE temp.instance_boxes", 1)
        connection.execute(boxes)
        shown.instances.put(instances)


class _ShownConnection(Connection):
    """A connection with tables before those of the file; what is read is checked in the file itself, by another one.
    What another process writes is taken in when the next snapshot begins, all of it or nothing.
    """

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        super().__init__(path, database, lock)
        file = database.execute("SELECT file FROM pragma_database_list WHERE name = 'main'").fetchone()[0]
        self._plain = Committed(path)
        self._shown: int | None = None
        self.take_in: Callable[[], None] = lambda: None
        """Show the file as it is now; called when it has changed."""
        if file and Path(file).exists():  # else a copy of our own, whose rows were checked as it was made
            self._checks = ReadChecks(database, self._plain, whole=not self._checks.by_part("supports"))

    def close(self) -> None:
        """Let the file go. A second call does nothing."""
        self._plain.close()
        super().close()

    @contextlib.contextmanager
    def _state(self) -> Iterator[None]:
        with self._guard:
            if self._database.in_transaction:
                yield
                return
            self._database.execute("BEGIN")
            try:
                self._database.execute("SELECT 1 FROM main.memory LIMIT 1").fetchall()
                version = int(self._database.execute("PRAGMA main.data_version").fetchone()[0])
                if version != self._shown:
                    self._take_back()
                    self.take_in()
                    self._shown = version
                yield
            finally:
                if self._database.in_transaction:
                    self._database.execute("COMMIT")

    def _take_back(self) -> None:
        """Show the file itself."""
        with self.temporary():
            for kind, name in self._database.execute("SELECT type, name FROM sqlite_temp_master").fetchall():
                if kind == "view" or name in _TABLES:
                    self._database.execute(f"DROP {kind} temp.{name}")
        self.forget()

    def believed(self, table: str, rows: list[tuple[Any, ...]], *, keep: bool = True) -> list[tuple[Any, ...]]:
        """Return the rows: instances are others than those that the checksums were written of, vectors are not."""
        if table == "embeddings":
            self.sound(table, (row[0] for row in rows))
        return rows

    def seals(self, table: str) -> dict[int, bytes]:
        """Return nothing: rows that are shown may be others than those of the file."""
        return {}


class _ShownStore(Store):
    """A store that shows the file otherwise than it is."""

    def verify(self) -> list[str]:
        """Return every damage of the file itself."""
        with Store.open(self.path) as store:
            return store.verify()
