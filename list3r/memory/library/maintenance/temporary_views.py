"""A memory shown otherwise than it is: a connection of its own, in which temporary tables and views stand before those
of the file. Nothing is written to it.
"""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import apsw

from list3r.memory.core.records import Instance
from list3r.memory.store.connection import Connection
from list3r.memory.store.database import Database
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.store import Store

_TABLES = ("instances", "relations", "instance_boxes", "words", "observations", "embeddings")
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
        for table in ("instance_boxes", "words"):
            connection.execute(made[table].replace(f"VIRTUAL TABLE {table}", f"VIRTUAL TABLE temp.{table}", 1))
        shown.instances.put(instances)


class _ShownConnection(Connection):
    """A connection with tables before those of the file. What another process writes is taken in when the next snapshot
    begins, all of it or nothing.
    """

    def __init__(self, path: Path, database: Database, lock: WriterLock | None) -> None:
        super().__init__(path, database, lock)
        self._shown: int | None = None
        self.take_in: Callable[[], None] = lambda: None
        """Show the file as it is now; called when it has changed."""

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All that is read inside belongs to one state of the memory, shown otherwise."""
        with self._guard:
            if self._database.in_transaction:
                yield
                return
            self._begin_reading()
            try:
                if self._version != self._shown:
                    self._take_back()
                    self.take_in()
                    self._shown = self._version
                yield
            finally:
                with contextlib.suppress(apsw.Error):
                    self._database.execute("COMMIT")

    def _take_back(self) -> None:
        """Show the file itself."""
        with self.temporary():
            for kind, name in self._database.execute("SELECT type, name FROM sqlite_temp_master").fetchall():
                if kind == "view" or name in _TABLES:
                    self._database.execute(f"DROP {kind} temp.{name}")
        self.forget()


class _ShownStore(Store):
    """A store that shows the file otherwise than it is."""

    def verify(self) -> list[str]:
        """Return every damage of the file itself."""
        with Store.open(self.path) as store:
            return store.verify()
