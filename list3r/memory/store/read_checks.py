"""What is read is checked first, so that a flipped byte is an error and no wrong answer.

A table is checked as a whole when it is first read: its pages and indices, the sums of its rows and blobs, and, for
what is derived, what it was derived from. That takes about as long as reading it, once for each connection. In files of
more than `WHOLE_BYTES` tables that no question reads whole are checked part by part as they are read: those with large
blobs, and those of more than `MOST_ROWS` rows that belong to instances. There, rows that are missing, and what the
R*Tree and the table of words leave out, are found by `verify` alone.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from typing import Any

import numpy as np

from list3r.memory.store.checksums import (
    OWN_CRC,
    PART_BITS,
    bad_rows_of,
    own_crc_wrong,
    row_crc,
    side_by_side,
    summed_tables,
)
from list3r.memory.store.rows.values import bad_references, bad_values
from list3r.memory.store.word_index import expected_words, up_to_date

WHOLE_BYTES = 128 * 2**20
"""Half a second of checking, at the most."""
MOST_ROWS = 50_000
"""Of one table; a third of a second."""
FAILURES = (sqlite3.Error, UnicodeError)
"""What SQLite raises on a damaged file; a damaged name in its message cannot even be decoded."""
GEOMETRY_BYTES = 24 * 8
_KEPT_ROWS = 500_000
"""Of one table, that are known to be sound; 50 MB."""
_PARTS = 500
"""Parts of the sums that are asked for in one statement."""
BOXES = "instance_boxes"
WORDS = "words"
_OF_INSTANCES = {name: name for name in ("instances", "relations", "observations", "embeddings", "pair_scores")} | {
    BOXES: "instances",
    WORDS: "instances",
}
"""Tables that grow with what there is to see and are read in part, and the table whose rows tell how large they are."""


class ReadChecks:
    """Knows which tables a connection has read, and which of them are sound; damage once found is never forgotten."""

    def __init__(
        self,
        database: sqlite3.Connection,
        committed: Callable[[], sqlite3.Connection] | None = None,
        *,
        whole: bool = True,
    ) -> None:
        """`committed`, for a connection that writes, leads to another that does not see what is not committed yet.

        Without `whole` the large tables are left to `found_in_parts`.
        """
        self._database = database
        self._committed = committed
        self._checked: set[str] = set()
        self._read: set[str] = set()
        self.damage: str | None = None
        """What was found; from then on every question is refused."""
        self._busy = False
        self._known = {*summed_tables(), BOXES, WORDS} - (set() if whole else _large(database))
        self._sound_parts: dict[str, set[int]] = {}
        self._sound_rows: dict[str, set[int]] = {}
        database.set_authorizer(self._note)

    def by_part(self, table: str) -> bool:
        """Whether a table is checked part by part."""
        return table not in self._known

    def _note(self, action: int, table: str | None, *_: str | None) -> int:
        if action == sqlite3.SQLITE_READ and table is not None and not self._busy:
            name = BOXES if table.startswith(BOXES) else table
            if name in self._known and name not in self._checked:
                self._read.add(name)
        return sqlite3.SQLITE_OK

    @contextlib.contextmanager
    def resting(self) -> Iterator[None]:
        """What is read inside is looked at as it is."""
        self._busy = True
        try:
            yield
        finally:
            self._busy = False

    def found(self) -> str | None:
        """The first damage of the tables that this connection has read so far."""
        if self.damage is None and self._read:
            self.damage = self._found(sorted(self._read))
        return self.damage

    def found_in_parts(self, table: str, keys: Iterable[int]) -> str | None:
        """The first damage of the parts of a table that rows with these first keys lie in."""
        if self.damage is None and self.by_part(table):
            fresh = {summed_tables()[table].part_of_first(int(k)) for k in keys} - self.sound_parts(table)
            self.damage = self._found([*side_by_side((table, part) for part in fresh)])
        return self.damage

    def sound_parts(self, table: str) -> Set[int]:
        """Parts of a table that were found sound."""
        return self._sound_parts.get(table, frozenset())

    def keep_sound(self, table: str, ids: Iterable[int]) -> None:
        """Remember rows that were checked one by one."""
        kept = self._sound_rows.setdefault(table, set())
        if len(kept) > _KEPT_ROWS:
            kept.clear()
        kept.update(ids)

    def unchecked(self, table: str, ids: Iterable[int]) -> list[int]:
        """Those of some ids whose rows were not checked one by one."""
        kept = self._sound_rows.get(table, set[int]())
        return [n for n in ids if n not in kept]

    def _found(self, names: Sequence[str] | Sequence[tuple[str, range]]) -> str | None:
        """The first damage of tables, or of parts of tables."""
        database = self._database if self._committed is None else self._committed()
        self._busy, opened = True, not database.in_transaction
        text_factory, database.text_factory = database.text_factory, any_text
        try:
            if opened:
                database.execute("BEGIN")
            for name in names:
                for text in damage_of(database, name) if isinstance(name, str) else damage_of_parts(database, *name):
                    return text
                if isinstance(name, str):
                    self._checked.add(name)
                    self._read.discard(name)
                else:
                    self._sound_parts.setdefault(name[0], set()).update(name[1])
            return None
        except FAILURES as error:
            return str(error)
        finally:
            database.text_factory = text_factory
            if opened and database.in_transaction:
                database.execute("ROLLBACK")
            self._busy = False


def damage_of(database: sqlite3.Connection, name: str, *, pages: bool = True) -> Iterator[str]:
    """Every damage of one table: pages and indices (unless known to be sound), sums, and what it agrees with."""
    if name == BOXES:
        yield from bad_boxes(database)
        return
    if pages:
        for (text,) in database.execute(f"PRAGMA integrity_check('{name}')"):
            yield from (f"SQLite: {text}",) if text != "ok" else ()
    if name == WORDS:
        yield from bad_words(database)
        return
    if name in OWN_CRC:
        yield from map(str, own_crc_wrong(database, name, summed_tables()[name].key))
    yield from map(str, bad_rows_of(database, summed_tables()[name]))
    yield from map(str, bad_values(database, name))
    yield from bad_references(database, name)


def damage_of_parts(database: sqlite3.Connection, name: str, parts: range) -> Iterator[str]:
    """Every damage of some parts of a table side by side: their sums and their blobs."""
    table = summed_tables()[name]
    where = table.where(parts)
    yield from map(str, bad_rows_of(database, table, parts))
    if name in OWN_CRC:
        yield from map(str, own_crc_wrong(database, name, table.key, where))
    yield from map(str, bad_values(database, name, *where))


def _large(database: sqlite3.Connection) -> set[str]:
    """Tables that are checked part by part in a large file."""
    query = "SELECT coalesce(sum(length(crcs) / 4 - 1), 0) FROM sums WHERE name = ?"
    rows = {n: database.execute(query, (n,)).fetchone()[0] for n in {*_OF_INSTANCES.values()}}
    return {*OWN_CRC, *(name for name, of in _OF_INSTANCES.items() if rows[of] > MOST_ROWS)}


def bad_boxes(database: sqlite3.Connection) -> Iterator[str]:
    """Where the R*Tree is broken or not what the instances say."""
    for (text,) in database.execute(f"SELECT rtreecheck('{BOXES}')"):
        yield from (f"{BOXES}: {text}",) if text != "ok" else ()
    boxes = {row[0]: row[1:] for row in database.execute(f"SELECT * FROM {BOXES}")}
    for instance, geometry in database.execute("SELECT id, geometry FROM instances ORDER BY id"):
        box = boxes.pop(instance, None)
        if box is None or not _holds(geometry, (*box[0::2], *box[1::2])):
            yield f"{BOXES} {instance}: the box is not that of the instance"
    yield from (f"{BOXES}: id {instance} is not in instances" for instance in boxes)


def bad_words(database: sqlite3.Connection) -> Iterator[str]:
    """Where the table of words is not what the instances are called; that of another program is left aside."""
    if up_to_date(database):
        held = set(database.execute("SELECT word, instance, weight FROM words WHERE word != ''"))
        for instance in sorted({row[1] for row in held ^ set(expected_words(database))}, key=str):
            yield f"words: those of instance {instance} are not those of its label and description"


def unbelieved(database: sqlite3.Connection, table: str, rows: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Ids of those of some whole rows of a table, the id first, that its checksums do not know."""
    parts = sorted({int(row[0]) >> PART_BITS for row in rows})
    known: dict[int, bytes] = {}
    for start in range(0, len(parts), _PARTS):
        some = parts[start : start + _PARTS]
        query = f"SELECT part, crcs FROM sums WHERE name = ? AND part IN ({','.join('?' * len(some))})"
        for part, crcs in database.execute(query, (table, *some)):
            known[part] = crcs[: -4 - len(crcs) % 4] if isinstance(crcs, bytes) else b""
    return [row[0] for row in rows if not _among(row_crc(row), known.get(int(row[0]) >> PART_BITS, b""))]


def _among(crc: bytes, crcs: bytes) -> bool:
    """Whether a sum is one of those of a part."""
    at = crcs.find(crc)
    while at % 4 and at > 0:
        at = crcs.find(crc, at + 1)
    return at >= 0


def any_text(text: bytes) -> str:
    """Text of a file that may be damaged."""
    return text.decode("utf-8", "surrogateescape")


def _holds(geometry: object, box: tuple[float, ...]) -> bool:
    """Whether a box of the R*Tree (lower, upper corner) is that of an instance, rounded outwards to 32 bits."""
    if not isinstance(geometry, bytes) or len(geometry) != GEOMETRY_BYTES:
        return False
    lower, upper = np.frombuffer(geometry, "<f8")[3:9].reshape(2, 3)
    low, high = np.array(box[:3]), np.array(box[3:])
    if not np.isfinite([lower, upper, low, high]).all():
        return True
    slack = 2.4e-7 * np.maximum(np.abs([lower, upper]), 1e-30)
    return bool(((low <= lower) & (lower - low <= slack[0]) & (high >= upper) & (high - upper <= slack[1])).all())
