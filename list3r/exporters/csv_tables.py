"""Write instances and relations as two CSV tables, for spreadsheets and data frames."""

from __future__ import annotations

import csv
from pathlib import Path

from list3r.exporters.output import part_path, write_together
from list3r.exporters.tables import COLUMNS, Table, rows_of
from list3r.memory.store.store import Store


def write_csv(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write the instances to `path` and the relations to `NAME.relations.csv` beside it. Returns both files.

    The first row names the columns, see `tables.COLUMNS`. Text is UTF-8; an unknown value is an empty cell. Rows of
    all components are in one table: compare positions only where the column `component` is the same.
    """

    def write(table: Table, to: Path) -> None:
        with to.open("w", encoding="utf-8", newline="") as file:
            out = csv.writer(file, lineterminator="\n")
            out.writerow(COLUMNS[table])
            rows = rows_of(store, table)
            out.writerows([str(v).lower() if isinstance(v, bool) else v for v in row] for row in rows)

    tables: dict[Path, Table] = {Path(path): "instances", part_path(Path(path), "relations"): "relations"}
    return write_together(tables.items(), write)
