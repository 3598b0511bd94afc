"""A damaged memory to a sound one: every row that is as it was written is kept, the rest is derived again or named."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from list3r.memory.errors import MemoryFileError
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import apply_labels
from list3r.memory.records import Session
from list3r.memory.store.beside import put_foreign_log_aside
from list3r.memory.store.checksums import (
    OWN_CRC,
    SUMS_SINCE,
    SummedTable,
    bad_rows,
    row_crc,
    stored_sums,
    summed_tables,
    write_table,
)
from list3r.memory.store.file import (
    check_beside,
    check_numbers,
    check_schema,
    connected,
    fold_in,
    migrate,
    numbers,
    protect,
    rename_exclusively,
)
from list3r.memory.store.lock import WriterLock
from list3r.memory.store.read_checks import FAILURES, GEOMETRY_BYTES
from list3r.memory.store.rows.codec import checksum, unpack
from list3r.memory.store.rows.values import bad_values
from list3r.memory.store.schema import SCHEMA_VERSION
from list3r.memory.store.store import Store

_DERIVED = ("instances", "observations", "embeddings", "relations", "events", "detected_labels")
"""Tables that consolidation writes; a row lost there is written again."""
_PASSING = ("pair_scores",)
"""Tables of what can be computed again."""
_OF_A_CHUNK = ("placements", "bends", "frames", "keyframes", "local_instances", "supports", "observations", "votes")
_BLOBS = {"chunks": "overlap", "keyframes": "features", "local_instances": "track"}
"""Columns that must be readable as arrays for their row to be of use."""

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
        with contextlib.closing(_connect(path, copy, lost)) as damaged, Store.create(made) as store:
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


def _connect(path: Path, copy: Path, lost: _Lost) -> sqlite3.Connection:
    """Return the damaged file as SQLite sees it; its schema must be ours, the rest need not.

    Of a file of an older schema what is not as it was written is left out, and the rest is brought forward.
    """
    database = sqlite3.connect(copy, isolation_level=None)
    try:
        _check_ours(path, database)
    except MemoryFileError:
        database.close()
        raise
    try:
        protect(database)
        database.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
        version = int(database.execute("PRAGMA user_version").fetchone()[0])
        if SUMS_SINCE <= version < SCHEMA_VERSION:
            check_schema(path, database, version)
            _drop_bad_rows(database, version, lost)
            migrate(database, version)
        check_schema(path, database, SCHEMA_VERSION)
    except (*FAILURES, MemoryFileError) as error:
        database.close()
        raise MemoryFileError(
            f"{path} cannot be repaired: its table of contents is damaged ({error}); use a backup"
        ) from error
    return database


def _drop_bad_rows(database: sqlite3.Connection, version: int, lost: _Lost) -> None:
    """Take rows out of a file of an older schema that are not as they were written, and all that was said of those."""
    tables = summed_tables(version)
    for bad in list(bad_rows(database, version)):
        table = tables.get(bad.table)
        if table is not None and bad.key is not None:
            lost.add(bad.table, bad.key)
            where = " AND ".join(f"{c} IS ?" for c in table.key)
            database.execute(f"DELETE FROM {bad.table} WHERE {where}", bad.key)
        elif table is not None:
            lost.unnamed[bad.table] = lost.unnamed.get(bad.table, 0) + 1
    for name, table in tables.items():
        write_table(database, table)
        database.execute(
            f"DELETE FROM sums WHERE name = ? AND part NOT IN (SELECT {table.part_of(name)} FROM {name})", (name,)
        )


def _check_ours(path: Path, database: sqlite3.Connection) -> None:
    """Raise `MemoryFileError` for a file that can be read but belongs to another program or a newer version."""
    with contextlib.suppress(*FAILURES):
        check_numbers(path, *numbers(database))


# ------------------------------------------------------------------------------------------- rows


@dataclass
class _Lost:
    """Keys of rows that could not be saved, by table; counts of those whose keys are unknown."""

    keys: dict[str, dict[Row, None]] = field(default_factory=dict)
    unnamed: dict[str, int] = field(default_factory=dict)
    instances: set[int] = field(default_factory=set)
    """Ids that the damaged file names."""

    def add(self, table: str, key: Row) -> None:
        self.keys.setdefault(table, {})[key] = None


def _salvage(damaged: sqlite3.Connection, store: Store, lost: _Lost) -> None:
    """Write all rows that are as they were written, and what belongs to them, into an empty store."""
    tables = {name: table for name, table in summed_tables().items() if name not in _PASSING}
    kept = {name: _sound_rows(damaged, table, lost) for name, table in tables.items()}
    lost.instances = {key[0] for key in (*kept["instances"], *lost.keys.get("instances", ()))}
    _drop_unreadable(kept, lost)
    _drop_orphans(kept, lost)
    with store.transaction():
        for name, rows in kept.items():
            table = summed_tables()[name]
            marks = ",".join("?" * len(table.columns))
            store.connection.execute_many(
                f"INSERT INTO {name} ({', '.join(table.columns)}) VALUES ({marks})", list(rows.values())
            )
        store.instances.index_boxes()
        _stand_in_for_lost(store, lost)


def _sound_rows(damaged: sqlite3.Connection, table: SummedTable, lost: _Lost) -> dict[Row, Row]:
    """Return rows of a table by key that match the checksums written of them."""
    try:
        sums, _ = stored_sums(damaged, table)
    except FAILURES:
        sums = {}
    lies = _lies(damaged, table)
    summed = [table.columns.index(c) for c in table.summed]
    kept: dict[Row, Row] = {}
    missing = {part: list(crcs) for part, crcs in sums.items()}
    for part, key, row in _readable(damaged, table, sorted(sums)):
        if key in kept:
            continue
        crc = row_crc(tuple(row[k] for k in summed))
        known = missing.get(part)
        if (known is not None and crc not in known) or not _own_crc_holds(table, row) or key in lies:
            lost.add(table.name, key)
            continue
        if known is not None:
            known.remove(crc)
        kept[key] = row
    gone = sum(map(len, missing.values())) - len(set(lost.keys.get(table.name, ())) - kept.keys())
    if gone > 0:
        lost.unnamed[table.name] = gone
    return kept


def _lies(damaged: sqlite3.Connection, table: SummedTable) -> set[Row]:
    """Keys of rows that hold what none may hold, whatever their checksums say."""
    try:
        return {bad.key for bad in bad_values(damaged, table.name) if bad.key is not None}
    except FAILURES:
        return set()


def _readable(damaged: sqlite3.Connection, table: SummedTable, parts: list[int]) -> Iterator[tuple[int, Row, Row]]:
    """Return (part, key, row) of all rows that SQLite can still reach: from both ends of the table, then part by
    part.
    """
    keys = [table.columns.index(c) for c in table.key]
    whole = True
    select = f"SELECT {table.part_of(table.name)}, {', '.join(table.columns)} FROM {table.name}"
    for order in ("ASC", "DESC"):
        ordered = ", ".join(f"{c} {order}" for c in table.key)
        whole = True
        try:
            for part, *row in damaged.execute(f"{select} ORDER BY {ordered}"):
                yield part, tuple(row[k] for k in keys), tuple(row)
        except FAILURES:
            whole = False
        if whole:
            return
    for part in parts:
        clause, arguments = table.where(range(part, part + 1))
        with contextlib.suppress(*FAILURES):
            for _, *row in damaged.execute(f"{select} WHERE {clause}", arguments):
                yield part, tuple(row[k] for k in keys), tuple(row)


def _own_crc_holds(table: SummedTable, row: Row) -> bool:
    if table.name not in OWN_CRC:
        return True
    values = dict(zip(table.columns, row, strict=True))
    blobs = [values[c] for c in OWN_CRC[table.name]]
    return all(isinstance(b, bytes) for b in blobs) and checksum(*blobs) == values["crc"]


def _drop_unreadable(kept: dict[str, dict[Row, Row]], lost: _Lost) -> None:
    """Rows without a checksum of theirs, whose sums were damaged, must at least be readable."""
    for name, column in _BLOBS.items():
        at = summed_tables()[name].columns.index(column)
        for key, row in list(kept[name].items()):
            try:
                unpack(row[at], name)
            except MemoryFileError:
                lost.add(name, key)
                del kept[name][key]

    at = summed_tables()["instances"].columns.index("geometry")
    for key, row in list(kept["instances"].items()):
        if not isinstance(row[at], bytes) or len(row[at]) != GEOMETRY_BYTES:
            lost.add("instances", key)
            del kept["instances"][key]


def _drop_orphans(kept: dict[str, dict[Row, Row]], lost: _Lost) -> None:
    """What hung on a row that is lost goes with it."""

    def column(name: str, row: Row, wanted: str) -> Any:
        return row[summed_tables()[name].columns.index(wanted)]

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
    for name in ("local_instances", "supports"):
        drop(name, [k for k in kept[name] if k not in pairs])
    drop("observations", [k for k in kept["observations"] if k not in pairs])


def _name_missing(lost: _Lost, table: str, key: Row) -> None:
    """A row that is missing, whose key something else still tells."""
    if key not in lost.keys.get(table, {}):
        lost.add(table, key)
        lost.unnamed[table] = max(0, lost.unnamed.get(table, 0) - 1)


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
    for table, count in lost.unnamed.items():
        if count > 0 and not (rebuilt and table in _DERIVED):
            names.setdefault(table, []).append(f"{count} more")
    with Store.open(target) as store:
        ids = {i.id for i in store.instances.all()}
        chunks = len(store.chunks.all())
        gone = sorted(lost.instances - ids - store.ids.aliases().keys())
    if gone:
        names["instances"] = [str(n) for n in gone]
    return RepairReport(target, original, damage, names, rebuilt, chunks, len(ids))
