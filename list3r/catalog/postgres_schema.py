"""The schema of a catalogue in PostgreSQL."""

from __future__ import annotations

PARTITIONS = 16
"""Of the tables of instances and relations, by memory."""

FEWEST_INDEXED = 20_000
"""Vectors of a space from which on they have an index; fewer are all compared in a few milliseconds."""
_A_LIST, _MOST_LISTS = 500, 2000
"""Vectors of a list of the index, as long as there are not more lists than that: learning takes the square of them, in
time and memory (0.8 GB). research/storage 0141."""


def _partitioned(table: str) -> str:
    return "".join(
        f"CREATE TABLE {table}_{n} PARTITION OF {table} FOR VALUES WITH (MODULUS {PARTITIONS}, REMAINDER {n});"
        for n in range(PARTITIONS)
    )


SCHEMA_VERSION = 1
SCHEMA = f"""
    CREATE TABLE memory (
        memory_id integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY, name text NOT NULL UNIQUE, path text NOT NULL,
        revision integer NOT NULL, sha256 text NOT NULL, bytes bigint NOT NULL, mtime_ns bigint NOT NULL,
        scale_kind text NOT NULL, gravity text NOT NULL, instances integer NOT NULL, sessions integer NOT NULL,
        added_at timestamptz NOT NULL DEFAULT now());
    CREATE TABLE instance (
        memory_id integer NOT NULL, id bigint NOT NULL, label text, description text NOT NULL, state text NOT NULL,
        structure text, confidence real NOT NULL, sigma real, component integer NOT NULL, box real[] NOT NULL,
        bounds cube NOT NULL, words text[] NOT NULL, weights smallint[] NOT NULL,
        PRIMARY KEY (memory_id, id)) PARTITION BY HASH (memory_id);
    {_partitioned("instance")}
    CREATE INDEX instance_bounds ON instance USING gist (memory_id, bounds);
    CREATE INDEX instance_words ON instance USING gin (words) WITH (fastupdate = off);
    CREATE TABLE relation (
        memory_id integer NOT NULL, subject bigint NOT NULL, predicate text NOT NULL, object bigint NOT NULL,
        confidence real NOT NULL, margin real NOT NULL,
        PRIMARY KEY (memory_id, subject, predicate, object)) PARTITION BY HASH (memory_id);
    {_partitioned("relation")}
    CREATE INDEX relation_by_object ON relation (memory_id, object);
    CREATE TABLE space (
        space_id integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY, name text NOT NULL UNIQUE,
        dimension integer NOT NULL);
"""


def vector_table(space_id: int, dimension: int) -> str:
    """Return the statement that makes the table of the vectors of one space."""
    return (
        f"CREATE TABLE vector_{int(space_id)} (memory_id integer NOT NULL, id bigint NOT NULL, "
        f"v halfvec({int(dimension)}) NOT NULL, PRIMARY KEY (memory_id, id))"
    )


def lists_of(vectors: int) -> int:
    """Return into how many lists the index divides this many vectors, 0 for none."""
    return min(vectors // _A_LIST, _MOST_LISTS) if vectors >= FEWEST_INDEXED else 0


def vector_index(space_id: int, lists: int) -> tuple[str, ...]:
    """Return the statements that make the index of the vectors of one space, in place of the one it has.

    Meanwhile others read and write, and the old index answers. Each is a transaction of its own.
    """
    table = f"vector_{int(space_id)}"
    return (
        f"DROP INDEX IF EXISTS {table}_next",  # of one who was ended
        f"CREATE INDEX CONCURRENTLY {table}_next ON {table} USING ivfflat (v halfvec_cosine_ops) "
        f"WITH (lists = {int(lists)})",
        f"DROP INDEX IF EXISTS {table}_alike; ALTER INDEX {table}_next RENAME TO {table}_alike",
    )
