"""Every damage of a file, as `list3r verify` names it."""

from __future__ import annotations

from collections.abc import Iterator

from list3r.memory.store.database import FAILURES, Database

_MOST = 100
"""Damages that are named."""


def damage_of(database: Database) -> Iterator[str]:
    """Pages that are not as they were written, what SQLite and the rules of the schema find amiss, and references that
    point nowhere.
    """
    try:
        database.begin()
    except FAILURES as error:
        yield str(error)
        return
    try:
        with database.noting() as pages:
            said = [*_said(database, "PRAGMA integrity_check")]
            where = dict(_said(database, "SELECT pageno, name FROM dbstat")) if pages else {}
            lost = [*_said(database, "PRAGMA foreign_key_check")]
        yield from (f"{where.get(page, 'a table')}: page {page} is not as it was written" for page in sorted(pages))
        yield from (f"SQLite: {row[0]}" for row in said if row[0] != "ok")
        yield from (f"{table}: a row points to one of {other} that is not there" for table, _, other, _ in lost[:_MOST])
    finally:
        database.roll_back()


def _said(database: Database, query: str) -> Iterator[tuple]:
    """Rows of a query, until it fails."""
    try:
        yield from database.execute(query)
    except FAILURES as error:
        if "dbstat" not in query:
            yield (str(error), "", "", "")
