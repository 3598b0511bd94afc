"""The schema of a catalogue in PostgreSQL: numbered migrations, append-only, each in a transaction."""

from __future__ import annotations

PARTITIONS = 16
"""Of the tables of instances and relations, by memory."""

_LINKS, _LOOKED_AT = 8, 32
"""Of the index of vectors: links of each and candidates looked at for them. Half of what pgvector takes: a third of the
time to add a vector; a search makes up for it by more candidates."""


def _partitioned(table: str) -> str:
    return "".join(
        f"CREATE TABLE {table}_{n} PARTITION OF {table} FOR VALUES WITH (MODULUS {PARTITIONS}, REMAINDER {n});"
        for n in range(PARTITIONS)
    )


MIGRATIONS: tuple[str, ...] = (
    f"""
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
    """,
)


def vector_table(space_id: int, dimension: int) -> str:
    """Return the statement that makes the table of the vectors of one space."""
    return (
        f"CREATE TABLE vector_{int(space_id)} (memory_id integer NOT NULL, id bigint NOT NULL, "
        f"v halfvec({int(dimension)}) NOT NULL, PRIMARY KEY (memory_id, id))"
    )


def vector_index(space_id: int) -> str:
    """Return the statement that makes the index of the vectors of one space where there is none."""
    table = f"vector_{int(space_id)}"
    return (
        f"CREATE INDEX IF NOT EXISTS {table}_alike ON {table} USING hnsw (v halfvec_cosine_ops) "
        f"WITH (m = {_LINKS}, ef_construction = {_LOOKED_AT})"
    )
