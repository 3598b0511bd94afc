"""Write instances, relations and frames as Parquet tables, for data frames and databases."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from list3r.exporters.output import part_path, write_together
from list3r.exporters.tables import COLUMNS, Table, rows_of
from list3r.memory.store.store import Store

_INTEGERS = frozenset(
    "id observations color_r color_g color_b component best_view_session best_view_frame subject object session"
    " frame".split()
)
_TEXTS = frozenset("label description state structure color_name predicate".split())
_BATCH_ROWS = 20_000


def write_parquet(store: Store, path: str | Path) -> tuple[Path, ...]:
    """Write the instances to `path`, relations and frames to `NAME.relations.parquet` and `NAME.frames.parquet`.

    Columns are those of `tables.COLUMNS`, typed; an unknown value is null. Returns the files written.
    """
    others: tuple[Table, ...] = ("relations", "frames")
    tables: dict[Path, Table] = {Path(path): "instances", **{part_path(Path(path), name): name for name in others}}
    return write_together(tables.items(), functools.partial(_write_table, store))


def _write_table(store: Store, table: Table, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema([(name, _type(pa, name)) for name in COLUMNS[table]])
    with pq.ParquetWriter(path, schema, compression="zstd") as out:
        batch: list[Any] = []
        for row in rows_of(store, table):
            batch.append(row)
            if len(batch) == _BATCH_ROWS:
                out.write_table(_columns(pa, schema, batch))
                batch = []
        out.write_table(_columns(pa, schema, batch))


def _columns(pa: Any, schema: Any, rows: list[Any]) -> Any:
    columns = list(zip(*rows, strict=True)) if rows else [()] * len(schema)
    return pa.table([pa.array(c, type=f.type) for c, f in zip(columns, schema, strict=True)], schema=schema)


def _type(pa: Any, name: str) -> Any:
    if name in _INTEGERS:
        return pa.int64()
    if name in _TEXTS:
        return pa.string()
    return pa.bool_() if name == "dynamic" else pa.float64()
