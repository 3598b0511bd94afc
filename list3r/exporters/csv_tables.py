"""Write instances and relations as two CSV tables, for spreadsheets and data frames."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TextIO

from list3r.exporters.output import part_path, write_together
from list3r.exporters.tables import COLUMNS, Table, Value, rows_of
from list3r.memory.store.store import Store

_FORMULA = tuple("=+-@\t\r\n＝＋－＠")
"""First characters of a cell that a spreadsheet computes, the wide forms of the signs too (OWASP, CSV Injection)."""


def write_csv(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write the instances to `path` and the relations to `NAME.relations.csv` next to it. Returns both files.

    The first row names the columns, see `tables.COLUMNS`. Text is UTF-8; an unknown value is an empty cell. A text that
    a spreadsheet would take for a formula gets a single quote before it. Rows of all components are in one table:
    compare positions only where the column `component` is the same.
    """

    def write(table: Table, to: Path) -> None:
        with to.open("w", encoding="utf-8", newline="") as file:
            out = csv.writer(_Lines(file))
            out.writerow(COLUMNS[table])
            out.writerows(map(_cell, row) for row in rows_of(store, table))

    tables: dict[Path, Table] = {Path(path): "instances", part_path(Path(path), "relations"): "relations"}
    return write_together(tables.items(), write)


class _Lines:
    """Takes rows that end as RFC 4180 says, in which either half of a line's end within a text is quoted."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, row: str) -> int:
        """Write a row with a plain end of line."""
        return self._file.write(row.removesuffix("\r\n") + "\n")


def _cell(value: Value) -> Value:
    if isinstance(value, bool):
        return str(value).lower()
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
