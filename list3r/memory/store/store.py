"""The store: one SQLite file that is the only truth; nothing outside `memory` knows that it is SQLite."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from list3r.memory.store.checksums import summed_tables
from list3r.memory.store.read_checks import BOXES, FAILURES, WORDS, any_text, damage_of
from list3r.memory.store.tables.edits import EditVerbs
from list3r.memory.store.tables.events import EventVerbs
from list3r.memory.store.tables.library import LibraryVerbs


class Store(EditVerbs, EventVerbs, LibraryVerbs):
    """Verbs of the memory file. `Store.open(path)` to read, `writable=True` to write, `Store.create(path)` anew."""

    def verify(self) -> list[str]:
        """Every damage found: pages, checksums of rows and blobs, rows that point nowhere, boxes that lie.

        Empty when the file is sound. One pass over the file; about 0.1 s for 25 MB.
        """
        with self._guard:
            before = self._database.text_factory
            self._database.text_factory = any_text
            try:
                with self._state(), self._checks.resting():
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
        for name in (*summed_tables(), BOXES, WORDS):
            try:
                yield from damage_of(self._database, name, pages=False)
            except FAILURES as error:
                yield f"{name}: {error}"

    def _asked(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Rows of a query; what SQLite says where it fails, as one row."""
        try:
            yield from self._database.execute(query)
        except FAILURES as error:
            yield (str(error),)
