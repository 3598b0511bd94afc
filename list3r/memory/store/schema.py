"""The schema of a memory file: numbered migrations, append-only, applied on open inside one transaction."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

APPLICATION_ID = 0x4C335231
"""ASCII "L3R1", written to the header of the SQLite file."""

MIGRATIONS: tuple[str, ...] = (
    # 1: the first released schema
    """
    CREATE TABLE memory (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
    CREATE TABLE sessions (
        session_id INTEGER PRIMARY KEY, source TEXT NOT NULL, fingerprint TEXT NOT NULL, settings TEXT NOT NULL,
        frame_count INTEGER NOT NULL, state TEXT NOT NULL);
    CREATE TABLE chunks (
        chunk_id INTEGER PRIMARY KEY, session_id INTEGER NOT NULL REFERENCES sessions, chunk_index INTEGER NOT NULL,
        first_frame INTEGER NOT NULL, last_frame INTEGER NOT NULL, component INTEGER NOT NULL,
        S_world_chunk BLOB NOT NULL, fx REAL NOT NULL, fy REAL NOT NULL, cx REAL NOT NULL, cy REAL NOT NULL,
        height INTEGER NOT NULL, width INTEGER NOT NULL, scale_kind TEXT NOT NULL, feature_space TEXT NOT NULL,
        cannot_link BLOB NOT NULL, overlap BLOB NOT NULL, seconds TEXT NOT NULL, crc INTEGER NOT NULL,
        UNIQUE (session_id, chunk_index));
    CREATE TABLE edges (
        u INTEGER NOT NULL REFERENCES chunks, v INTEGER NOT NULL REFERENCES chunks, kind TEXT NOT NULL,
        frame_u INTEGER NOT NULL, frame_v INTEGER NOT NULL, S_v_u BLOB NOT NULL, confidence REAL NOT NULL,
        weight REAL NOT NULL, inliers INTEGER NOT NULL, residual_m REAL NOT NULL, accepted INTEGER NOT NULL,
        reason TEXT NOT NULL, scores TEXT NOT NULL, PRIMARY KEY (u, v, kind, frame_u, frame_v)) WITHOUT ROWID;
    CREATE TABLE frames (
        session_id INTEGER NOT NULL REFERENCES sessions, frame_index INTEGER NOT NULL, time_s REAL NOT NULL,
        chunk_id INTEGER NOT NULL REFERENCES chunks, state TEXT NOT NULL, T_chunk_cam BLOB NOT NULL,
        note TEXT NOT NULL DEFAULT '', PRIMARY KEY (session_id, frame_index)) WITHOUT ROWID;
    CREATE TABLE keyframes (
        chunk_id INTEGER NOT NULL REFERENCES chunks, frame_index INTEGER NOT NULL, descriptor BLOB NOT NULL,
        features BLOB NOT NULL, jpeg BLOB NOT NULL, crc INTEGER NOT NULL,
        PRIMARY KEY (chunk_id, frame_index)) WITHOUT ROWID;
    CREATE TABLE local_instances (
        chunk_id INTEGER NOT NULL REFERENCES chunks, local_id INTEGER NOT NULL, stability REAL NOT NULL,
        structure INTEGER NOT NULL, plane BLOB, feature BLOB NOT NULL, track BLOB NOT NULL, crc INTEGER NOT NULL,
        PRIMARY KEY (chunk_id, local_id)) WITHOUT ROWID;
    CREATE TABLE supports (
        chunk_id INTEGER NOT NULL, local_id INTEGER NOT NULL, count INTEGER NOT NULL, grid BLOB NOT NULL,
        points BLOB NOT NULL, confidence BLOB NOT NULL, rgb BLOB NOT NULL, crc INTEGER NOT NULL,
        PRIMARY KEY (chunk_id, local_id)) WITHOUT ROWID;
    CREATE TABLE instances (
        id INTEGER PRIMARY KEY, label TEXT, description TEXT NOT NULL, geometry BLOB NOT NULL,
        confidence REAL NOT NULL, observations INTEGER NOT NULL, first_seen_s REAL NOT NULL,
        last_seen_s REAL NOT NULL, state TEXT NOT NULL, structure TEXT, color_rgb INTEGER NOT NULL,
        color_name TEXT NOT NULL, component INTEGER NOT NULL, view_session INTEGER, view_frame INTEGER,
        view_box BLOB);
    CREATE TABLE observations (
        chunk_id INTEGER NOT NULL, local_id INTEGER NOT NULL, instance INTEGER NOT NULL REFERENCES instances,
        PRIMARY KEY (chunk_id, local_id)) WITHOUT ROWID;
    CREATE INDEX observations_by_instance ON observations (instance);
    CREATE TABLE embeddings (
        instance INTEGER NOT NULL REFERENCES instances, space TEXT NOT NULL, vector BLOB NOT NULL,
        PRIMARY KEY (instance, space)) WITHOUT ROWID;
    CREATE TABLE relations (
        subject INTEGER NOT NULL, predicate TEXT NOT NULL, object INTEGER NOT NULL, confidence REAL NOT NULL,
        margin REAL NOT NULL, PRIMARY KEY (subject, predicate, object)) WITHOUT ROWID;
    CREATE INDEX relations_by_object ON relations (object, predicate);
    CREATE TABLE merges (
        entry INTEGER PRIMARY KEY, chunk_id INTEGER NOT NULL, kind TEXT NOT NULL, a TEXT NOT NULL, b TEXT NOT NULL,
        scores TEXT NOT NULL, reason TEXT NOT NULL);
    CREATE TABLE aliases (id INTEGER PRIMARY KEY, instance INTEGER NOT NULL);
    CREATE VIRTUAL TABLE instance_boxes USING rtree (id, min_x, max_x, min_y, max_y, min_z, max_z);
    """,
    # 2: uncertainty of edges, chunks and instances; things that move
    """
    ALTER TABLE chunks ADD COLUMN covariance BLOB;
    ALTER TABLE edges ADD COLUMN covariance BLOB;
    ALTER TABLE instances ADD COLUMN dynamic INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE instances ADD COLUMN position_sigma_m REAL;
    ALTER TABLE local_instances ADD COLUMN dynamic INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE local_instances ADD COLUMN motion BLOB;
    """,
    # 3: checksums of all rows; what operators edited; what changed between sessions
    """
    CREATE TABLE sums (
        name TEXT NOT NULL, part INTEGER NOT NULL, crcs BLOB NOT NULL, PRIMARY KEY (name, part)) WITHOUT ROWID;
    CREATE TABLE edits (
        entry INTEGER PRIMARY KEY, created_at TEXT NOT NULL, author TEXT NOT NULL, kind TEXT NOT NULL,
        arguments TEXT NOT NULL);
    CREATE TABLE events (
        session_id INTEGER NOT NULL REFERENCES sessions, instance INTEGER NOT NULL REFERENCES instances,
        kind TEXT NOT NULL, from_box BLOB, to_box BLOB, frames TEXT NOT NULL, confidence REAL NOT NULL,
        reason TEXT NOT NULL, PRIMARY KEY (session_id, instance)) WITHOUT ROWID;
    """,
    # 4: where chunks lie in small rows of their own; what consolidation goes on with when the next chunk comes
    """
    CREATE TABLE placements (
        chunk_id INTEGER PRIMARY KEY REFERENCES chunks, component INTEGER NOT NULL, S_world_chunk BLOB NOT NULL,
        covariance BLOB);
    INSERT INTO placements SELECT chunk_id, component, S_world_chunk, covariance FROM chunks;
    ALTER TABLE chunks DROP COLUMN component;
    ALTER TABLE chunks DROP COLUMN S_world_chunk;
    ALTER TABLE chunks DROP COLUMN covariance;
    CREATE TABLE settled (
        chunk_id INTEGER PRIMARY KEY REFERENCES chunks, component INTEGER NOT NULL, S_graph_chunk BLOB NOT NULL,
        extent BLOB NOT NULL, dropped BLOB NOT NULL);
    CREATE TABLE overlaps (
        u INTEGER NOT NULL REFERENCES chunks, v INTEGER NOT NULL REFERENCES chunks, scores BLOB NOT NULL,
        PRIMARY KEY (u, v)) WITHOUT ROWID;
    CREATE INDEX overlaps_by_second ON overlaps (v);
    CREATE TABLE members (
        chunk_id INTEGER NOT NULL, local_id INTEGER NOT NULL, first_chunk INTEGER NOT NULL,
        first_local INTEGER NOT NULL, shown INTEGER NOT NULL, PRIMARY KEY (chunk_id, local_id)) WITHOUT ROWID;
    CREATE INDEX members_by_group ON members (first_chunk, first_local);
    CREATE TABLE anchors (
        instance INTEGER PRIMARY KEY REFERENCES instances, chunk_id INTEGER NOT NULL, S_exact_settled BLOB NOT NULL);
    CREATE INDEX merges_by_names ON merges (a, b);
    CREATE INDEX local_instances_moving ON local_instances (chunk_id, local_id) WHERE dynamic;
    DELETE FROM memory WHERE key = 'settled_poses';
    """,
    # 5: how chunks bend beside the one similarity that places them
    """
    CREATE TABLE bends (chunk_id INTEGER PRIMARY KEY REFERENCES chunks, frames BLOB NOT NULL, twists BLOB NOT NULL);
    """,
    # 6: which instances have a word, and how well it names them, in hundredths; the vectors of one space without others
    """
    CREATE TABLE words (
        word TEXT NOT NULL, instance INTEGER NOT NULL REFERENCES instances, weight INTEGER NOT NULL,
        PRIMARY KEY (word, instance)) WITHOUT ROWID;
    CREATE INDEX embeddings_by_space ON embeddings (space);
    """,
    # 7: votes for labels by who gave them
    """
    UPDATE memory SET value = json_object(json_extract(value, '$.detector'), json_extract(value, '$.locals'))
    WHERE key LIKE 'label votes _%' AND json_valid(value);
    UPDATE memory SET key = 'label classes', value = '{}' WHERE key = 'label votes';
    """,
    # 8: facts of sessions, votes of detectors and the labels from them leave the key-value table
    """
    ALTER TABLE sessions ADD COLUMN camera TEXT;
    ALTER TABLE sessions ADD COLUMN cuts TEXT;
    ALTER TABLE sessions ADD COLUMN depth_step INTEGER;
    ALTER TABLE sessions ADD COLUMN lost_reasons TEXT NOT NULL DEFAULT '[]';
    UPDATE sessions SET
        camera = (SELECT value FROM memory WHERE key = 'camera ' || session_id),
        cuts = (SELECT value FROM memory WHERE key = 'cuts ' || session_id),
        depth_step = (SELECT CAST(value AS INTEGER) FROM memory WHERE key = 'depth step ' || session_id),
        lost_reasons = coalesce((SELECT value FROM memory WHERE key = 'lost ' || session_id), '[]');
    UPDATE sessions SET
        cuts = (SELECT value FROM memory WHERE key = 'cuts'),
        depth_step = (SELECT CAST(value AS INTEGER) FROM memory WHERE key = 'depth step'),
        lost_reasons = coalesce((SELECT value FROM memory WHERE key = 'lost'), '[]')
    WHERE session_id = (SELECT min(session_id) FROM sessions);
    CREATE TABLE votes (
        chunk_id INTEGER NOT NULL REFERENCES chunks, local_id INTEGER NOT NULL, source TEXT NOT NULL,
        missed REAL NOT NULL, classes TEXT NOT NULL, looks REAL NOT NULL,
        PRIMARY KEY (chunk_id, local_id, source)) WITHOUT ROWID;
    INSERT OR IGNORE INTO votes
        SELECT CAST(substr(m.key, 13) AS INTEGER), CAST(l.key AS INTEGER), s.key, json_extract(l.value, '$[0]'),
            json_extract(l.value, '$[1]'), coalesce(json_extract(l.value, '$[2]'), 0.0)
        FROM memory m, json_each(CASE WHEN json_valid(m.value) THEN m.value ELSE '{}' END) s,
            json_each(CASE s.type WHEN 'object' THEN s.value ELSE '{}' END) l
        WHERE m.key LIKE 'label votes _%' AND l.type = 'array';
    CREATE TABLE detected_labels (
        instance INTEGER PRIMARY KEY REFERENCES instances, label TEXT NOT NULL, confidence REAL NOT NULL,
        found REAL NOT NULL, detector TEXT NOT NULL);
    INSERT OR IGNORE INTO detected_labels
        SELECT CAST(l.key AS INTEGER), json_extract(l.value, '$[0]'), json_extract(l.value, '$[1]'),
            json_extract(l.value, '$[2]'), json_extract(l.value, '$[3]')
        FROM memory m, json_each(CASE WHEN json_valid(m.value) THEN m.value ELSE '{}' END) l
        WHERE m.key = 'detected labels' AND l.type = 'array';
    UPDATE memory SET value = json_set(value, '$.light', json_object('white_l', json_extract(value, '$.light[0]'),
        'cast_ab', json_array(json_extract(value, '$.light[1]'), json_extract(value, '$.light[2]'))))
    WHERE key = 'library' AND json_valid(value);
    UPDATE memory SET key = 'change_ledger',
        value = json_set(json_remove(value, '$.told'), '$.with_events', json(json_extract(value, '$.told')))
    WHERE key = 'tale' AND json_valid(value);
    DELETE FROM memory WHERE key IN ('lost', 'cuts', 'depth step', 'detected labels', 'feature_space')
        OR key LIKE 'camera _%' OR key LIKE 'lost _%' OR key LIKE 'cuts _%' OR key LIKE 'depth step _%'
        OR key LIKE 'label votes _%';
    """,
    # 9: chunks that saw nothing that others of their session had not seen, and which of those showed it; what the words
    # for an instance are made of
    """
    CREATE TABLE redundant (
        chunk_id INTEGER NOT NULL, local_id INTEGER NOT NULL, like_chunk INTEGER NOT NULL,
        like_local INTEGER NOT NULL, frames BLOB NOT NULL, PRIMARY KEY (chunk_id, local_id)) WITHOUT ROWID;
    CREATE INDEX redundant_by_like ON redundant (like_chunk, like_local);
    CREATE TABLE looks (
        instance INTEGER PRIMARY KEY REFERENCES instances, shape TEXT NOT NULL, resting INTEGER NOT NULL,
        swatches BLOB NOT NULL);
    """,
    # 10: what is too unlikely to be one thing to be listed
    """
    ALTER TABLE local_instances ADD COLUMN scrap INTEGER NOT NULL DEFAULT 0;
    """,
    # 11: how far chunks were carried since the library was derived; the floor is found where it is seen
    """
    ALTER TABLE settled ADD COLUMN carried BLOB NOT NULL
        DEFAULT X'0000000000000000000000000000000000000000000000000000000000000000';
    UPDATE memory SET value = json_set(json_remove(value, '$.floor', '$.stamp'), '$.rules', 0,
        '$.floor_seen', json(iif(json_extract(value, '$.floor') IS NULL, 'false', 'true')),
        '$.T_world_graph', json('[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]'))
    WHERE key = 'library' AND json_valid(value);
    """,
    # 12: which log is that of the file
    """
    CREATE TABLE log_mark (id INTEGER PRIMARY KEY, mark BLOB NOT NULL);
    """,
    # 13: the library is derived whole; of what it goes on with only the overlaps of pairs of chunks are kept
    """
    DROP TABLE settled; DROP TABLE overlaps; DROP TABLE members; DROP TABLE anchors; DROP TABLE redundant;
    DROP TABLE looks;
    CREATE TABLE pair_scores (
        u INTEGER NOT NULL REFERENCES chunks, v INTEGER NOT NULL REFERENCES chunks, stamp BLOB NOT NULL,
        scores BLOB NOT NULL, PRIMARY KEY (u, v)) WITHOUT ROWID;
    DELETE FROM memory WHERE key IN ('library', 'change_ledger');
    """,
)

SCHEMA_VERSION = len(MIGRATIONS)


@contextmanager
def scratch_database(version: int) -> Iterator[sqlite3.Connection]:
    """An empty database of a schema version, in memory."""
    database = sqlite3.connect(":memory:", isolation_level=None)
    try:
        for migration in MIGRATIONS[:version]:
            database.executescript(migration)
        yield database
    finally:
        database.close()


@cache
def expected_schema(version: int) -> dict[tuple[str, str], str]:
    """What a file of a schema version consists of: (type, name) and the statement that made it."""
    with scratch_database(version) as database:
        return read_schema(database)


def read_schema(database: sqlite3.Connection) -> dict[tuple[str, str], str]:
    """What a database consists of: (type, name) and the statement that made it, its spaces made one."""
    rows = database.execute("SELECT type, name, tbl_name, sql FROM sqlite_master").fetchall()
    return {
        (str(kind), str(name)): " ".join(str(sql or table).split())
        for kind, name, table, sql in rows
        if not (kind == "table" and str(name).startswith("sqlite_stat"))
    }
