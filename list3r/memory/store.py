"""The store: one SQLite file that is the only truth; nothing outside `memory` knows that it is SQLite."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from list3r.memory.connection import FAILURES
from list3r.memory.edit_verbs import EditVerbs
from list3r.memory.event_verbs import EventVerbs
from list3r.memory.sums import OWN_CRC, bad_rows_of, own_crc_wrong, summed_tables
from list3r.memory.word_index import expected_words, up_to_date

_REFERENCES = (
    ("observations", "instance", "instances", "id"),
    ("observations", "chunk_id", "chunks", "chunk_id"),
    ("relations", "subject", "instances", "id"),
    ("relations", "object", "instances", "id"),
    ("embeddings", "instance", "instances", "id"),
    ("frames", "chunk_id", "chunks", "chunk_id"),
    ("instances", "id", "instance_boxes", "id"),
    ("instance_boxes", "id", "instances", "id"),
)
GEOMETRY_BYTES = 24 * 8


class Store(EditVerbs, EventVerbs):
    """Verbs of the memory file. `Store.open(path)` to read, `writable=True` to write, `Store.create(path)` anew."""

    def verify(self) -> list[str]:
        """Every damage found: pages, checksums of rows and blobs, rows that point nowhere, boxes that lie.

        Empty when the file is sound. One pass over the file; about 0.1 s for 25 MB.
        """
        with self._guard:
            before = self._database.text_factory
            self._database.text_factory = _any_text
            try:
                with self.snapshot():
                    return list(self._verify())
            finally:
                self._database.text_factory = before

    def index_boxes(self) -> None:
        """Fill the R*Tree anew from the instances; call inside `transaction()`."""
        rows = self._rows("SELECT id, geometry FROM instances ORDER BY id")
        boxes = [(i, *np.frombuffer(g, "<f8")[3:9].reshape(2, 3).T.ravel().tolist()) for i, g in rows]
        self._database.execute("DELETE FROM instance_boxes")
        self._database.executemany("INSERT INTO instance_boxes VALUES (?, ?, ?, ?, ?, ?, ?)", boxes)

    def _damage(self) -> list[str]:
        return self.verify()

    def _verify(self) -> Iterator[str]:
        for text in self._asked("PRAGMA integrity_check"):
            yield from (f"SQLite: {t}" for t in text if t != "ok")
        for text in self._asked("SELECT rtreecheck('instance_boxes')"):
            yield from (f"instance_boxes: {t}" for t in text if t != "ok")
        for name, table in summed_tables().items():
            try:
                if name in OWN_CRC:
                    yield from map(str, own_crc_wrong(self._database, name, table.key))
                yield from map(str, bad_rows_of(self._database, table))
            except FAILURES as error:
                yield f"{name}: {error}"
        for source, column, other, target in _REFERENCES:
            query = f"SELECT DISTINCT {column} FROM {source} WHERE {column} NOT IN (SELECT {target} FROM {other})"
            yield from (f"{source}: {column} {row[0]} is not in {other}" for row in self._asked(query))
        query = (
            "SELECT i.id, i.geometry, b.min_x, b.min_y, b.min_z, b.max_x, b.max_y, b.max_z FROM instances i"
            " JOIN instance_boxes b USING (id)"
        )
        for row in self._asked(query):
            if len(row) == 1 or not _holds(row[1], row[2:]):
                yield f"instance_boxes {row[0]}: the box is not that of the instance"

        yield from self._bad_words()

    def _bad_words(self) -> Iterator[str]:
        """Where the table of words is not what the instances are called."""
        try:
            if up_to_date(self._database):
                held = set(self._database.execute("SELECT word, instance, weight FROM words WHERE word != ''"))
                wrong = sorted({row[1] for row in held ^ set(expected_words(self._database))}, key=str)
                yield from (f"words: those of instance {instance} are not what it is called" for instance in wrong)
        except FAILURES as error:
            yield f"words: {error}"

    def _asked(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Rows of a query; what SQLite says where it fails, as one row."""
        try:
            yield from self._database.execute(query)
        except FAILURES as error:
            yield (str(error),)


def _any_text(text: bytes) -> str:
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
