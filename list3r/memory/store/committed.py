"""What a memory held before the transaction that runs: a second connection of its writer, which only reads."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from list3r.memory.store.file import connected
from list3r.memory.store.read_checks import any_text


class Committed:
    """The file as the last transaction left it, for checks of what an edit rests on and of what it writes over."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._database: sqlite3.Connection | None = None

    def __call__(self) -> sqlite3.Connection:
        """The connection, opened when it is first asked for."""
        if self._database is None:
            self._database = connected(self._path, "ro")
            self._database.text_factory = any_text
        return self._database

    def close(self) -> None:
        """Let the file go; a later question opens it again."""
        if self._database is not None:
            self._database.close()
        self._database = None
