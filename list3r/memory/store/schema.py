"""The schema of a memory file: numbered migrations, append-only, applied on open inside one transaction.

What SQLite can say of a value stands here and nowhere else: types (STRICT), ranges (CHECK), references. `verify` checks
it of every row. Three views show the library to whoever opens the file with any other program.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import apsw

from list3r.memory.store.pages import TABLE as _PAGES

APPLICATION_ID = 0x4C335231
"""ASCII "L3R1", written to the header of the SQLite file."""

MIGRATIONS: tuple[str, ...] = (
    # 1: of version 0.1.0
    _PAGES
    + """;
    CREATE TABLE memory (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT, WITHOUT ROWID;
    CREATE TABLE sessions (
        session_id INTEGER PRIMARY KEY CHECK (session_id > 0), source TEXT NOT NULL, fingerprint TEXT NOT NULL,
        settings TEXT NOT NULL, frame_count INTEGER NOT NULL CHECK (frame_count >= 0),
        state TEXT NOT NULL CHECK (state IN ('building', 'complete')), camera TEXT, cuts TEXT,
        depth_step INTEGER CHECK (depth_step > 0), lost_reasons TEXT NOT NULL DEFAULT '[]') STRICT;
    CREATE TABLE chunks (
        chunk_id INTEGER PRIMARY KEY REFERENCES placements,
        session_id INTEGER NOT NULL REFERENCES sessions, chunk_index INTEGER NOT NULL CHECK (chunk_index >= 0),
        first_frame INTEGER NOT NULL CHECK (first_frame >= 0),
        last_frame INTEGER NOT NULL CHECK (last_frame >= first_frame),
        fx REAL NOT NULL CHECK (fx > 0), fy REAL NOT NULL CHECK (fy > 0), cx REAL NOT NULL, cy REAL NOT NULL,
        height INTEGER NOT NULL CHECK (height BETWEEN 1 AND 131072),
        width INTEGER NOT NULL CHECK (width BETWEEN 1 AND 131072),
        scale_kind TEXT NOT NULL, feature_space TEXT NOT NULL,
        cannot_link BLOB NOT NULL CHECK (length(cannot_link) % 8 = 0), overlap BLOB NOT NULL, seconds TEXT NOT NULL,
        crc INTEGER NOT NULL, UNIQUE (session_id, chunk_index)) STRICT;
    CREATE TABLE placements (
        chunk_id INTEGER PRIMARY KEY REFERENCES chunks, component INTEGER NOT NULL CHECK (component >= 0),
        S_world_chunk BLOB NOT NULL CHECK (length(S_world_chunk) = 104),
        covariance BLOB CHECK (length(covariance) = 392)) STRICT;
    CREATE TABLE bends (
        chunk_id INTEGER PRIMARY KEY REFERENCES chunks, frames BLOB NOT NULL CHECK (length(frames) % 8 = 0),
        twists BLOB NOT NULL CHECK (length(twists) = 7 * length(frames))) STRICT;
    CREATE TABLE edges (
        u INTEGER NOT NULL REFERENCES chunks, v INTEGER NOT NULL REFERENCES chunks, kind TEXT NOT NULL,
        frame_u INTEGER NOT NULL, frame_v INTEGER NOT NULL, S_v_u BLOB NOT NULL CHECK (length(S_v_u) = 104),
        confidence REAL NOT NULL CHECK (confidence BETWEEN 0 AND 1), weight REAL NOT NULL CHECK (weight >= 0),
        inliers INTEGER NOT NULL CHECK (inliers >= 0), residual_m REAL NOT NULL CHECK (residual_m >= 0),
        accepted INTEGER NOT NULL CHECK (accepted IN (0, 1)), reason TEXT NOT NULL, scores TEXT NOT NULL,
        covariance BLOB CHECK (length(covariance) = 392),
        PRIMARY KEY (u, v, kind, frame_u, frame_v)) STRICT, WITHOUT ROWID;
    CREATE TABLE frames (
        session_id INTEGER NOT NULL REFERENCES sessions, frame_index INTEGER NOT NULL CHECK (frame_index >= 0),
        time_s REAL NOT NULL, chunk_id INTEGER NOT NULL REFERENCES chunks,
        state TEXT NOT NULL CHECK (state IN ('posed', 'lost', 'bad')),
        T_chunk_cam BLOB NOT NULL CHECK (length(T_chunk_cam) = 128), note TEXT NOT NULL DEFAULT '',
        PRIMARY KEY (session_id, frame_index)) STRICT, WITHOUT ROWID;
    CREATE TABLE keyframes (
        chunk_id INTEGER NOT NULL REFERENCES chunks, frame_index INTEGER NOT NULL CHECK (frame_index >= 0),
        descriptor BLOB NOT NULL CHECK (length(descriptor) % 4 = 0), features BLOB NOT NULL, jpeg BLOB NOT NULL,
        PRIMARY KEY (chunk_id, frame_index)) STRICT, WITHOUT ROWID;
    CREATE TABLE local_instances (
        chunk_id INTEGER NOT NULL REFERENCES chunks, local_id INTEGER NOT NULL, stability REAL NOT NULL,
        structure INTEGER NOT NULL CHECK (structure IN (0, 1)), plane BLOB CHECK (length(plane) = 32),
        feature BLOB NOT NULL CHECK (length(feature) % 4 = 0), track BLOB NOT NULL,
        dynamic INTEGER NOT NULL DEFAULT 0 CHECK (dynamic IN (0, 1)), motion BLOB,
        scrap INTEGER NOT NULL DEFAULT 0 CHECK (scrap IN (0, 1)),
        PRIMARY KEY (chunk_id, local_id), FOREIGN KEY (chunk_id, local_id) REFERENCES supports) STRICT, WITHOUT ROWID;
    CREATE INDEX local_instances_moving ON local_instances (chunk_id, local_id) WHERE dynamic;
    CREATE TABLE supports (
        chunk_id INTEGER NOT NULL, local_id INTEGER NOT NULL, count INTEGER NOT NULL CHECK (count >= 0),
        grid BLOB NOT NULL CHECK (length(grid) = 32), points BLOB NOT NULL CHECK (length(points) = 6 * count),
        confidence BLOB NOT NULL CHECK (length(confidence) = count), rgb BLOB NOT NULL CHECK (length(rgb) = 3 * count),
        PRIMARY KEY (chunk_id, local_id),
        FOREIGN KEY (chunk_id, local_id) REFERENCES local_instances) STRICT, WITHOUT ROWID;
    CREATE TABLE votes (
        chunk_id INTEGER NOT NULL REFERENCES chunks, local_id INTEGER NOT NULL, source TEXT NOT NULL,
        missed REAL NOT NULL, classes TEXT NOT NULL, looks REAL NOT NULL CHECK (looks >= 0),
        PRIMARY KEY (chunk_id, local_id, source)) STRICT, WITHOUT ROWID;

    CREATE TABLE instances (
        id INTEGER PRIMARY KEY CHECK (id BETWEEN 1 AND 2147483647), label TEXT, description TEXT NOT NULL,
        center_x REAL NOT NULL, center_y REAL NOT NULL, center_z REAL NOT NULL,
        size_x REAL NOT NULL CHECK (size_x >= 0), size_y REAL NOT NULL CHECK (size_y >= 0),
        size_z REAL NOT NULL CHECK (size_z >= 0), geometry BLOB NOT NULL CHECK (length(geometry) = 144),
        confidence REAL NOT NULL CHECK (confidence BETWEEN 0 AND 1),
        observations INTEGER NOT NULL CHECK (observations >= 0),
        first_seen_s REAL NOT NULL, last_seen_s REAL NOT NULL, state TEXT NOT NULL, structure TEXT,
        color_rgb INTEGER NOT NULL CHECK (color_rgb BETWEEN 0 AND 16777215), color_name TEXT NOT NULL,
        component INTEGER NOT NULL CHECK (component >= 0), view_session INTEGER, view_frame INTEGER,
        view_box BLOB CHECK (length(view_box) = 32),
        dynamic INTEGER NOT NULL DEFAULT 0 CHECK (dynamic IN (0, 1)),
        position_sigma_m REAL CHECK (position_sigma_m >= 0),
        CHECK (abs(center_x) + abs(center_y) + abs(center_z) + size_x + size_y + size_z < 1e300)) STRICT;
    CREATE VIRTUAL TABLE instance_boxes USING rtree (id, min_x, max_x, min_y, max_y, min_z, max_z);
    CREATE VIRTUAL TABLE words USING fts5 (
        w100, w98, w90, w80, content='', contentless_delete=1, detail=column,
        tokenize="unicode61 remove_diacritics 0 tokenchars '_'");
    CREATE TABLE observations (
        chunk_id INTEGER NOT NULL REFERENCES chunks, local_id INTEGER NOT NULL,
        instance INTEGER NOT NULL REFERENCES instances, PRIMARY KEY (chunk_id, local_id),
        FOREIGN KEY (chunk_id, local_id) REFERENCES local_instances) STRICT, WITHOUT ROWID;
    CREATE INDEX observations_by_instance ON observations (instance);
    CREATE TABLE embeddings (
        instance INTEGER NOT NULL REFERENCES instances, space TEXT NOT NULL, change INTEGER NOT NULL,
        vector BLOB NOT NULL CHECK (length(vector) > 0 AND length(vector) % 4 = 0),
        PRIMARY KEY (instance, space)) STRICT, WITHOUT ROWID;
    CREATE INDEX embeddings_by_space ON embeddings (space, change);
    CREATE TABLE relations (
        subject INTEGER NOT NULL REFERENCES instances, predicate TEXT NOT NULL,
        object INTEGER NOT NULL REFERENCES instances, confidence REAL NOT NULL CHECK (confidence BETWEEN 0 AND 1),
        margin REAL NOT NULL, PRIMARY KEY (subject, predicate, object)) STRICT, WITHOUT ROWID;
    CREATE INDEX relations_by_object ON relations (object, predicate);
    CREATE TABLE events (
        session_id INTEGER NOT NULL REFERENCES sessions, instance INTEGER NOT NULL REFERENCES instances,
        kind TEXT NOT NULL, from_x REAL, from_y REAL, from_z REAL, from_box BLOB CHECK (length(from_box) = 96),
        to_x REAL, to_y REAL, to_z REAL, to_box BLOB CHECK (length(to_box) = 96), frames TEXT NOT NULL,
        confidence REAL NOT NULL CHECK (confidence BETWEEN 0 AND 1), reason TEXT NOT NULL,
        PRIMARY KEY (session_id, instance)) STRICT, WITHOUT ROWID;
    CREATE TABLE rooms (
        id INTEGER PRIMARY KEY CHECK (id > 0), floor INTEGER NOT NULL CHECK (floor >= 0), floor_z REAL NOT NULL,
        outline BLOB NOT NULL CHECK (length(outline) >= 48 AND length(outline) % 16 = 0),
        area REAL NOT NULL CHECK (area > 0), partial TEXT NOT NULL) STRICT;
    CREATE TABLE room_instances (
        instance INTEGER PRIMARY KEY REFERENCES instances, room INTEGER NOT NULL REFERENCES rooms) STRICT;
    CREATE INDEX room_instances_by_room ON room_instances (room);
    CREATE TABLE doorways (
        a INTEGER NOT NULL REFERENCES rooms, b INTEGER NOT NULL REFERENCES rooms CHECK (a < b),
        position BLOB NOT NULL CHECK (length(position) = 24), width REAL NOT NULL CHECK (width > 0),
        PRIMARY KEY (a, b, position)) STRICT, WITHOUT ROWID;
    CREATE TABLE detected_labels (
        instance INTEGER PRIMARY KEY REFERENCES instances, label TEXT NOT NULL,
        confidence REAL NOT NULL CHECK (confidence BETWEEN 0 AND 1), found REAL NOT NULL CHECK (found >= 0),
        detector TEXT NOT NULL) STRICT;
    CREATE TABLE merges (
        entry INTEGER PRIMARY KEY, chunk_id INTEGER NOT NULL, kind TEXT NOT NULL, a TEXT NOT NULL, b TEXT NOT NULL,
        scores TEXT NOT NULL, reason TEXT NOT NULL) STRICT;
    CREATE INDEX merges_by_names ON merges (a, b);
    CREATE TABLE aliases (id INTEGER PRIMARY KEY, instance INTEGER NOT NULL) STRICT;
    CREATE TABLE edits (
        entry INTEGER PRIMARY KEY, created_at TEXT NOT NULL, author TEXT NOT NULL, kind TEXT NOT NULL,
        arguments TEXT NOT NULL) STRICT;

    CREATE TABLE pair_scores (
        u INTEGER NOT NULL REFERENCES chunks, v INTEGER NOT NULL REFERENCES chunks, stamp BLOB NOT NULL,
        scores BLOB NOT NULL, PRIMARY KEY (u, v)) STRICT, WITHOUT ROWID;
    CREATE TABLE log_mark (id INTEGER PRIMARY KEY, mark BLOB NOT NULL) STRICT;

    CREATE VIEW things AS
        SELECT id, coalesce(label, description) AS name, label, description, color_name AS color,
            center_x, center_y, center_z, size_x, size_y, size_z, confidence, observations,
            first_seen_s, last_seen_s, state, component
        FROM instances WHERE structure IS NULL;
    CREATE VIEW relations_named AS
        SELECT r.subject, coalesce(s.label, s.description) AS subject_name, r.predicate,
            r.object, coalesce(o.label, o.description) AS object_name, r.confidence
        FROM relations r JOIN instances s ON s.id = r.subject JOIN instances o ON o.id = r.object;
    CREATE VIEW events_named AS
        SELECT e.session_id, s.source, e.kind, e.instance, coalesce(i.label, i.description) AS name,
            e.from_x, e.from_y, e.from_z, e.to_x, e.to_y, e.to_z, i.size_x, i.size_y, i.size_z,
            (SELECT min(time_s) FROM frames f WHERE f.session_id = e.session_id) AS session_begin_s,
            (SELECT max(time_s) FROM frames f WHERE f.session_id = e.session_id) AS session_end_s,
            e.confidence, e.reason
        FROM events e JOIN instances i ON i.id = e.instance JOIN sessions s USING (session_id);
    """,
    # 2: labels that name only a kind of things
    """
    ALTER TABLE detected_labels ADD COLUMN level TEXT NOT NULL DEFAULT 'leaf' CHECK (level IN ('leaf', 'branch'));
    """,
)

SCHEMA_VERSION = len(MIGRATIONS)
_OF_SQLITE = ("sqlite_stat", "instance_boxes_", "words_")
"""How tables begin that SQLite makes of its own, each version in its own way."""


@contextmanager
def scratch_database(version: int) -> Iterator[apsw.Connection]:
    """An empty database of a schema version, in memory."""
    database = apsw.Connection(":memory:")
    try:
        for migration in MIGRATIONS[:version]:
            database.execute(migration)
        yield database
    finally:
        database.close()


@cache
def expected_schema(version: int) -> dict[tuple[str, str], str]:
    """What a file of a schema version consists of: (type, name) and the statement that made it."""
    with scratch_database(version) as database:
        return read_schema(database)


def read_schema(database: apsw.Connection) -> dict[tuple[str, str], str]:
    """What a database consists of: (type, name) and the statement that made it, its spaces made one; of tables that
    SQLite makes of its own no statement.
    """
    rows = database.execute("SELECT type, name, tbl_name, sql FROM sqlite_master").fetchall()
    return {
        (str(kind), str(name)): "" if str(name).startswith(_OF_SQLITE) else " ".join(str(sql or table).split())
        for kind, name, table, sql in rows
        if not (kind == "table" and str(name).startswith("sqlite_stat"))
    }


@cache
def tables(version: int = SCHEMA_VERSION) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Return the tables of rows of ours by name: their columns, and those of their key."""
    with scratch_database(version) as database:
        found: list[tuple[Any, ...]] = database.execute(
            "SELECT name FROM pragma_table_list WHERE schema = 'main' AND type = 'table' AND name NOT LIKE 'sqlite_%'"
            " AND name != 'pages' ORDER BY name"
        ).fetchall()
        info: dict[str, list[tuple[Any, ...]]] = {
            str(name): database.execute(f"PRAGMA table_info({name})").fetchall() for (name,) in found
        }
    return {
        name: (
            tuple(str(row[1]) for row in rows),
            tuple(str(row[1]) for row in sorted((r for r in rows if r[5]), key=lambda r: r[5])),
        )
        for name, rows in info.items()
    }
