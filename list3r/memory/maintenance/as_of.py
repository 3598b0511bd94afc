"""The memory as it was after an earlier session, for every question to be asked of.

A connection of its own to the same file, in which temporary tables and views stand before those of the file: nothing
is written, what sessions saw later is not there, and what they moved is where it was. Sizes and words are those of
today. Relations among what has not changed since are those of the file; the others are found anew.
"""

from __future__ import annotations

import contextlib
import sqlite3
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from list3r.memory.geometry import Array
from list3r.memory.library.rules import settings_of
from list3r.memory.maintenance.history import world_at
from list3r.memory.records import Instance, Relation
from list3r.memory.relations import predicates
from list3r.memory.relations.instance_geometry import InstanceGeometry
from list3r.memory.store.committed import Committed
from list3r.memory.store.connection import Connection
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.read_checks import ReadChecks
from list3r.memory.store.store import Store

_BY_SESSION = ("sessions", "chunks", "frames", "events")
_BY_CHUNK = ("keyframes", "local_instances", "supports", "placements", "bends", "votes")
_REACH_M = 2.0
"""How far from what has changed relations may have been others."""


def store_at(store: Store, session_id: int) -> Store:
    """Return a store to read, as it was after a session; close it like any other. Raises `OptionError` for no such
    session.
    """
    connection = _PastConnection.open(store.path)
    past = _PastStore(connection)
    connection.take_in = partial(_take_in, weakref.proxy(past), session_id)
    try:
        with past.snapshot():
            return past
    except BaseException:
        past.close()
        raise


class _PastConnection(Connection):
    """A connection whose tables end with a session; what is read is checked in the file itself, by another one.
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
                if kind == "view" or name in ("instances", "relations", "instance_boxes"):
                    self._database.execute(f"DROP {kind} temp.{name}")
        self.forget()

    def believed(self, table: str, rows: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Return the rows: they are others than those that the checksums were written of."""
        return rows


class _PastStore(Store):
    """A store whose tables end with a session."""

    def verify(self) -> list[str]:
        """Return every damage of the file itself."""
        with Store.open(self.path) as store:
            return store.verify()


def _take_in(past: Store, session_id: int) -> None:
    """Show the file as it is now, as far as it was known after a session."""
    then, now = world_at(past, session_id), {i.id: i for i in past.instances.all()}
    known = past.relations.all()
    vertical = past.facts.gravity != "unknown"
    _show(past, session_id, then)
    changed = {i.id for i in then if _has_changed(i, now.get(i.id))}
    relations = [*_kept(known, then, changed), *_found_anew(past, then, changed, vertical)]
    with past.connection.temporary():
        past.relations.replace(None, relations)


def _show(past: Store, session_id: int, instances: Sequence[Instance]) -> None:
    """Let a store read only what was known after a session, from now on."""
    connection = past.connection
    connection.forget()
    made = dict(connection.rows("SELECT name, sql FROM main.sqlite_master WHERE sql IS NOT NULL"))
    last = int(session_id)
    chunks = f"(SELECT chunk_id FROM main.chunks WHERE session_id <= {last})"
    ids = "(SELECT id FROM temp.instances)"
    views = {t: f"session_id <= {last}" for t in _BY_SESSION} | {t: f"chunk_id IN {chunks}" for t in _BY_CHUNK}
    views["edges"] = f"u IN {chunks} AND v IN {chunks}"
    views["observations"] = f"chunk_id IN {chunks} AND instance IN {ids}"
    views["embeddings"] = views["detected_labels"] = f"instance IN {ids}"
    views["words"] = f"word = '' OR instance IN {ids}"
    with connection.temporary():
        for table in ("instances", "relations"):
            connection.execute(made[table].replace("CREATE TABLE", "CREATE TEMP TABLE", 1))
        boxes = made["instance_boxes"].replace("VIRTUAL TABLE instance_boxes", "VIRTUAL TABLE temp.instance_boxes", 1)
        connection.execute(boxes)
        past.instances.put(instances)
        for table, condition in views.items():
            connection.execute(f"CREATE TEMP VIEW {table} AS SELECT * FROM main.{table} WHERE {condition}")


def _has_changed(then: Instance, now: Instance | None) -> bool:
    gone = now is not None and (now.state == "removed") != (then.state == "removed")
    return now is None or gone or not np.array_equal(then.center, now.center)


def _kept(known: Sequence[Relation], then: Sequence[Instance], changed: set[int]) -> list[Relation]:
    """Return relations among what was there then and has not changed since."""
    same = {i.id for i in then} - changed
    return [r for r in known if r.subject in same and r.object in same]


def _found_anew(past: Store, then: Sequence[Instance], changed: set[int], vertical: bool) -> list[Relation]:
    """Return relations of what has changed since."""
    out: list[Relation] = []
    first = min((c.component for c in past.chunks.all()), default=0)
    for component in sorted({i.component for i in then if i.id in changed}):
        here = [i for i in then if i.component == component and i.state != "removed" and not i.dynamic]
        moved = [i for i in here if i.id in changed]
        near = [i for i in here if any(_gap(i.aabb, m.aabb) <= _REACH_M for m in moved)]
        middle = np.mean([i.center for i in here], axis=0) if here else np.zeros(3)
        instances = [b for i in near if (b := _body(past, i, middle)) is not None]
        told = settings_of(past, None).relations
        upright = vertical and component == first
        found = predicates.relations(instances, gravity_known=upright, settings=told) if moved else []
        out += [r for r in found if r.subject in changed or r.object in changed]
    return out


def _gap(a: Array, b: Array) -> float:
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(a[0] - b[1], b[0] - a[1]))))


def _body(past: Store, instance: Instance, middle: Array) -> InstanceGeometry | None:
    """Return an instance as relations see it, from the surface that was known then."""
    points = past.surfaces.points(instance.id).astype(np.float64)
    slack = 1e-3 * float(np.linalg.norm(instance.aabb[1] - instance.aabb[0]))
    points = points[np.all((points >= instance.aabb[0] - slack) & (points <= instance.aabb[1] + slack), axis=1)]
    if len(points) == 0:
        return None
    points = points[:: max(1, len(points) // 2000)]
    normal = None
    if instance.structure is not None and len(points) > 3:
        axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
        normal = axis if (middle - points.mean(axis=0)) @ axis > 0 else -axis
    return InstanceGeometry(
        id=instance.id,
        points=points,
        rgb=np.zeros((len(points), 3), np.uint8),
        box=instance.box,
        aabb=instance.aabb,
        normal=normal,
        structure=instance.structure,
        component=instance.component,
        confidence=instance.confidence,
    )
