"""Every damage of a file, as `list3r verify` names it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from list3r.memory.store.database import FAILURES, Database

_MOST = 100
"""Rows that point nowhere that are told."""


def damage_of(database: Database) -> Iterator[str]:
    """Pages that are not as they were written, what SQLite and the rules of the schema find amiss, and references that
    point nowhere; inside a snapshot.
    """
    with database.noting() as pages:
        said = [*_said(database, "PRAGMA integrity_check")]
        where = dict(_said(database, "SELECT pageno, name FROM dbstat")) if pages else {}
        lost = [*_said(database, "PRAGMA foreign_key_check")]
    for page in sorted(pages):
        yield (f"{where[page]}: " if page in where else "") + f"page {page} is not as it was written"
    yield from (f"SQLite: {row[0]}" for row in said if row[0] != "ok")
    yield from (f"{table}: a row points to one of {other} that is not there" for table, _, other, _ in lost[:_MOST])


def _said(database: Database, query: str) -> Iterator[tuple[Any, ...]]:
    """Rows of a query, until it fails."""
    try:
        yield from database.execute(query)
    except FAILURES as error:
        if "dbstat" not in query:
            yield (str(error), "", "", "")
