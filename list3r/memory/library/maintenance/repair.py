"""A damaged memory to a sound one: every row on sound pages is kept, the rest is derived again or named."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import apsw

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import Session
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import apply_labels
from list3r.memory.store.beside import put_foreign_log_aside
from list3r.memory.store.database import FAILURES, Database
from list3r.memory.store.file import (
    check_beside,
    check_numbers,
    check_schema,
    connected,
    fold_in,
    numbers,
    rename_exclusively,
)
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.rows.codec import unpack
from list3r.memory.store.schema import SCHEMA_VERSION, tables
from list3r.memory.store.store import Store

_DERIVED = ("instances", "observations", "embeddings", "relations", "events", "detected_labels")
"""Tables that consolidation writes; a row lost there is written again."""
_PASSING = ("pair_scores", "log_mark")
"""Tables of what can be computed again, or belongs to the damaged file."""
_OF_A_CHUNK = ("placements", "bends", "frames", "keyframes", "local_instances", "supports", "observations", "votes")
_BLOBS = {"chunks": "overlap", "keyframes": "features", "local_instances": "track"}
"""Columns that must be readable as arrays for their row to be of use."""
_LAST = 2**31
_PROBES = 5000
"""Ranges of a table that are looked for rows, at most, where its pages are damaged."""

Row = tuple[Any, ...]


@dataclass(frozen=True)
class RepairReport:
    """What was damaged, what is lost, and where the files are."""

    memory: Path
    """The sound file."""
    original: Path
    """The damaged file, as it was."""
    damage: tuple[str, ...]
    """What `verify` said of the original; empty when it was sound."""
    lost: dict[str, list[str]] = field(default_factory=dict)
    """What could not be saved: by kind (chunks, frames, keyframes, ...), names such as `3` or `1:120`."""
    rebuilt: bool = False
    """Whether instances and relations were derived again from what was saved."""
    chunks: int = 0
    """Chunks in the sound file."""
    instances: int = 0
    """Instances and pieces of structure in the sound file."""

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {**asdict(self), "memory": str(self.memory), "original": str(self.original)}


def repair(path: str | Path, out: str | Path | None = None) -> RepairReport:
    """Salvage a damaged memory into a sound file.

    Without `out` the sound file takes the name and the damaged one is kept as `PATH.damaged`; with it the damaged one
    stays where it is. A memory that is sound is left alone (with `out` it is copied). Raises `MemoryFileError` when
    nothing can be read of the file, when it is being written, or when `out` is there already.
    """
    path = Path(path).resolve()
    target = path if out is None else Path(out)
    if out is not None and target.resolve() == path:
        raise MemoryFileError(
            f"--out {out} is the damaged file itself; leave --out out, and it is kept as {out}.damaged"
        )
    _check_target(path, target)
    lock = WriterLock(path)
    try:
        return _repair(path, target)
    finally:
        lock.release()


def _repair(path: Path, target: Path) -> RepairReport:
    put_foreign_log_aside(path)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}-repair-", dir=target.resolve().parent) as folder:
        copy, made = Path(folder) / "damaged.l3r", Path(folder) / "sound.l3r"
        _copy(path, copy)
        damage = _damage(copy)
        if not damage and target == path:
            _fold_in_log(path)
            return _report(path, path, (), _Lost(), rebuilt=False)
        lost = _Lost()
        with contextlib.closing(_connect(path, copy)) as damaged, Store.create(made) as store:
            _salvage(damaged, store, lost)
            rebuilt = bool(damage) and _needs_deriving(lost)
            if rebuilt:
                _derive(store)
            left = store.verify()
        if left:
            raise MemoryFileError(f"{path} could not be repaired: {left[0]}; keep the file and report this")
        original = path if target != path else _put_aside(path)
        rename_exclusively(made, target)
    return _report(target, original, tuple(damage), lost, rebuilt=rebuilt)


def _fold_in_log(path: Path) -> None:
    """Write the log beside a sound memory into it."""
    if Path(f"{path}-wal").exists():
        with contextlib.closing(connected(path, "rw")) as database:
            fold_in(database, 2000)


def _check_target(path: Path, target: Path) -> None:
    if not path.is_file():
        raise MemoryFileError(f"{path} does not exist; check the path")
    if target != path and target.exists():
        raise MemoryFileError(f"{target} already exists; give --out a new name")
    check_beside(path)
    if not target.resolve().parent.is_dir():
        raise MemoryFileError(f"the folder {target.resolve().parent} does not exist; create it first")


def _copy(path: Path, copy: Path) -> None:
    """The file and its write-ahead log, so that the original stays as it is."""
    try:
        size = sum(Path(f"{path}{end}").stat().st_size for end in ("", "-wal") if Path(f"{path}{end}").exists())
        free = shutil.disk_usage(copy.parent).free
        if 2 * size > free:
            raise MemoryFileError(
                f"{path} takes {size / 1e6:.0f} MB, and so may its repaired copy; {copy.parent.parent} has only "
                f"{free / 1e6:.0f} MB free: free some space, or name another folder with --out"
            )
        for end in ("", "-wal", "-journal"):
            if Path(f"{path}{end}").exists():
                shutil.copyfile(f"{path}{end}", f"{copy}{end}")
    except OSError as error:
        raise MemoryFileError(f"{path} cannot be copied: {error.strerror}") from error


def _damage(copy: Path) -> list[str]:
    try:
        with Store.open(copy, writable=True) as store:
            return store.verify()
    except MemoryFileError as error:
        return [str(error).replace(str(copy), "the file")]


def _connect(path: Path, copy: Path) -> Database:
    """Return the damaged file as SQLite sees it; its schema must be ours, the rest need not.

    Where the sums of pages are damaged themselves, pages are taken as they are.
    """
    try:
        database = connected(copy, "rw")
    except FAILURES as error:
        raise MemoryFileError(f"{path} cannot be repaired: {error}; use a backup") from error
    try:
        _check_ours(path, database)
        check_schema(path, database, SCHEMA_VERSION)
        try:
            database.begin()
        except FAILURES:
            database.trust()
        return database
    except MemoryFileError as error:
        database.close()
        if error.__cause__ is None and "newer" in str(error):
            raise
        raise MemoryFileError(f"{path} cannot be repaired ({error}); use a backup") from error
    except FAILURES as error:
        database.close()
        raise MemoryFileError(
            f"{path} cannot be repaired: its table of contents is damaged ({error}); use a backup"
        ) from error


def _check_ours(path: Path, database: Database) -> None:
    """Raise `MemoryFileError` for a file that can be read but belongs to another program or a newer version."""
    with contextlib.suppress(*FAILURES):
        check_numbers(path, *numbers(database))


# ------------------------------------------------------------------------------------------- rows


@dataclass
class _Lost:
    """Keys of rows that could not be saved, by table; tables that lost others, whose keys are unknown."""

    keys: dict[str, dict[Row, None]] = field(default_factory=dict)
    unnamed: set[str] = field(default_factory=set)
    instances: set[int] = field(default_factory=set)
    """Ids that the damaged file names."""

    def add(self, table: str, key: Row) -> None:
        self.keys.setdefault(table, {})[key] = None


def _salvage(damaged: Database, store: Store, lost: _Lost) -> None:
    """Write all rows on sound pages, and what belongs to them, into an empty store."""
    kept = {name: _Rows(damaged, name, lost).kept for name in tables() if name not in _PASSING}
    lost.instances = {key[0] for key in kept["instances"]} | {row[2] for row in kept["observations"].values()}
    _drop_unreadable(kept, lost)
    _drop_orphans(kept, lost)
    with store.transaction():
        for name, rows in kept.items():
            _insert(store, name, rows, lost)
        store.instances.index_again()
        _stand_in_for_lost(store, lost)


def _insert(store: Store, name: str, rows: dict[Row, Row], lost: _Lost) -> None:
    columns = tables()[name][0]
    statement = f"INSERT INTO {name} ({', '.join(columns)}) VALUES ({','.join('?' * len(columns))})"
    for key, row in rows.items():
        try:
            store.connection.execute(statement, row)
        except apsw.ConstraintError:  # what no row may hold
            lost.add(name, key)


class _Rows:
    """Rows of a table that can still be read: from both ends, and, between pages that are damaged, by halves."""

    def __init__(self, damaged: Database, name: str, lost: _Lost) -> None:
        self._damaged, self._name, self._lost = damaged, name, lost
        self._columns, self._key = tables()[name]
        self._at = [self._columns.index(column) for column in self._key]
        self._probes = _PROBES
        self.kept: dict[Row, Row] = {}
        if not self._read("1", ()) and not self._read_by_number(()):
            lost.unnamed.add(name)

    def _read(self, where: str, arguments: Row) -> bool:
        """Read what meets a condition, from both ends; whether that is all of it."""
        self._probes -= 1
        for order in ("ASC", "DESC"):
            ordered = ", ".join(f"{column} {order}" for column in self._key)
            query = f"SELECT {', '.join(self._columns)} FROM {self._name} WHERE {where} ORDER BY {ordered}"
            try:
                for row in self._damaged.execute(query, arguments):
                    self.kept.setdefault(tuple(row[k] for k in self._at), row)
                return True
            except FAILURES:
                pass
        return False

    def _read_by_number(self, before: Row) -> bool:
        """Read rows whose key begins with some values by halves of the next number; whether all could be named."""
        if len(before) == len(self._key) or self._name == "memory":
            return False
        same = "".join(f"{column} = ? AND " for column in self._key[: len(before)])
        column, waiting, named = self._key[len(before)], [(-1, _LAST)], True
        while waiting and self._probes > 0:
            low, high = waiting.pop()
            if self._read(f"{same}{column} BETWEEN ? AND ?", (*before, low, high)):
                continue
            if low < high:
                middle = (low + high) // 2
                waiting += [(middle + 1, high), (low, middle)]
            else:
                named &= self._read_by_number((*before, low)) or self._name_lost((*before, low))
        return named and not waiting

    def _name_lost(self, before: Row) -> bool:
        """Name rows whose keys can be read, and the rest cannot."""
        same = " AND ".join(f"{column} = ?" for column in self._key[: len(before)])
        try:
            keys = self._damaged.execute(f"SELECT {', '.join(self._key)} FROM {self._name} WHERE {same}", before)
            for key in keys.fetchall():
                if key not in self.kept:
                    self._lost.add(self._name, key)
            return True
        except FAILURES:
            return False


def _drop_unreadable(kept: dict[str, dict[Row, Row]], lost: _Lost) -> None:
    """Rows whose arrays cannot be read are of no use."""
    for name, column in _BLOBS.items():
        at = tables()[name][0].index(column)
        for key, row in list(kept[name].items()):
            try:
                unpack(row[at], name)
            except MemoryFileError:
                lost.add(name, key)
                del kept[name][key]


def _drop_orphans(kept: dict[str, dict[Row, Row]], lost: _Lost) -> None:
    """What hung on a row that is lost goes with it."""

    def column(name: str, row: Row, wanted: str) -> Any:
        return row[tables()[name][0].index(wanted)]

    def drop(name: str, gone: list[Row]) -> None:
        for key in gone:
            lost.add(name, key)
            del kept[name][key]

    chunks = {key[0] for key in kept["chunks"]}
    for name in _OF_A_CHUNK:
        orphans = {k: column(name, row, "chunk_id") for k, row in kept[name].items()}
        for chunk in sorted({c for c in orphans.values() if c not in chunks}):
            _name_missing(lost, "chunks", (chunk,))
        drop(name, [k for k, chunk in orphans.items() if chunk not in chunks])
    drop("edges", [k for k in kept["edges"] if k[0] not in chunks or k[1] not in chunks])
    pairs = kept["local_instances"].keys() & kept["supports"].keys()
    for name, other in (("local_instances", "supports"), ("supports", "local_instances")):
        for key in [k for k in kept[name] if k not in pairs]:
            lost.add(other, key)
            del kept[name][key]
    drop("observations", [k for k in kept["observations"] if k not in pairs])


def _name_missing(lost: _Lost, table: str, key: Row) -> None:
    """A row that is missing, whose key something else still tells."""
    lost.add(table, key)


def _stand_in_for_lost(store: Store, lost: _Lost) -> None:
    """What the rest cannot do without: a session of which only chunks are left, the kind of scale."""
    _place_lost(store, lost)
    held = {s.session_id for s in store.sessions.all()}
    frames: dict[int, int] = {}
    for f in store.frames.all():
        frames[f.session_id] = max(frames.get(f.session_id, 0), f.frame_index + 1)
    for session_id in sorted({c.session_id for c in store.chunks.all()} - held):
        _name_missing(lost, "sessions", (session_id,))
        store.sessions.put(Session(session_id, "unknown", "", {}, frames.get(session_id, 0), "complete"))
    if store.facts.scale_kind is None and any(c.scale_kind != "metric" for c in store.chunks.all()):
        store.facts.scale_kind = "relative"
    ids = [o.instance_id for o in store.observations.all()]
    store.facts.last_id = max([store.ids.next() - 1, *ids])


def _place_lost(store: Store, lost: _Lost) -> None:
    """Chunks whose place is lost are put where a relation to a chunk that has one puts them, or apart."""
    missing = store.chunks.place_unplaced()
    left = dict.fromkeys(missing)
    edges = [e for e in store.edges.all() if e.accepted]
    while ties := [e for e in edges if (e.u in left) != (e.v in left)]:
        u, v, S_v_u = ties[0].u, ties[0].v, ties[0].S_v_u
        here, lost_one, S_here_lost = (u, v, S_v_u.inverse()) if v in left else (v, u, S_v_u)
        row = store.chunks.get(here)
        store.chunks.place({lost_one: row.S_world_chunk @ S_here_lost}, {lost_one: row.component})
        del left[lost_one]
    for k in missing:
        _name_missing(lost, "placements", (k,))


def _needs_deriving(lost: _Lost) -> bool:
    touched = {*lost.keys, *lost.unnamed}
    return bool(touched & {"chunks", "placements", "frames", "local_instances", "supports", *_DERIVED, "memory"})


def _derive(store: Store) -> None:
    """Derive the library again from the chunks: ids stay where the observations or the row of an instance stayed."""
    with store.transaction():
        if not store.chunks.all():
            for name in _DERIVED:
                store.connection.execute(f"DELETE FROM {name}")
            store.connection.execute("DELETE FROM instance_boxes")
            return
        consolidate(store)
        apply_labels(store)


# ------------------------------------------------------------------------------------------- report


def _put_aside(path: Path) -> Path:
    aside, n = path.with_name(f"{path.name}.damaged"), 1
    while aside.exists():
        n += 1
        aside = path.with_name(f"{path.name}.damaged{n}")
    path.rename(aside)
    for end in ("-wal", "-journal"):
        if Path(f"{path}{end}").exists():
            Path(f"{path}{end}").rename(f"{aside}{end}")
    Path(f"{path}-shm").unlink(missing_ok=True)
    return aside


def _report(target: Path, original: Path, damage: tuple[str, ...], lost: _Lost, *, rebuilt: bool) -> RepairReport:
    names = {
        table: sorted((":".join(str(k) for k in key) for key in keys), key=lambda n: (len(n), n))
        for table, keys in lost.keys.items()
        if keys and not (rebuilt and table in _DERIVED)
    }
    for table in sorted(lost.unnamed):
        if not (rebuilt and table in _DERIVED) and table not in names:
            names[table] = ["rows on damaged pages"]
    with Store.open(target) as store:
        ids = {i.id for i in store.instances.all()}
        chunks = len(store.chunks.all())
        gone = sorted(lost.instances - ids - store.ids.aliases().keys())
    if gone:
        names["instances"] = [str(n) for n in gone]
    return RepairReport(target, original, damage, names, rebuilt, chunks, len(ids))
