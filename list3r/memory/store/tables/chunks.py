"""Sessions and chunks: what is measured, chunk by chunk."""

from __future__ import annotations

import json
from collections.abc import Mapping

from list3r.memory.geometry import Sim3
from list3r.memory.records import (
    ChunkResult,
    Session,
)
from list3r.memory.store.codec import (
    checksum,
    pack,
    pack_sim3,
    to_json,
)
from list3r.memory.store.rows import (
    keyframe_row,
    sample_arrays,
)
from list3r.memory.store.tables.local_instances import LocalNode, LocalVerbs

__all__ = ["ChunkVerbs", "LocalNode"]

_OF_CHUNKS = (
    ("edges", ("u", "v")),
    ("overlaps", ("u", "v")),
    *((table, ("chunk_id",)) for table in ("placements", "settled", "bends", "keyframes", "supports", "members")),
    ("local_instances", ("chunk_id",)),
)
"""Tables of what chunks hold, and the columns that name the chunks."""


class ChunkVerbs(LocalVerbs):
    """Writing what sessions and their chunks measured; call inside `transaction()`."""

    def add_session(self, source: str, fingerprint: str, settings: Mapping[str, object], frame_count: int) -> int:
        """A new session in the state `building`; its id."""
        cursor = self._database.execute(
            "INSERT INTO sessions (source, fingerprint, settings, frame_count, state) VALUES (?, ?, ?, ?, 'building')",
            (source, fingerprint, to_json(settings), frame_count),
        )
        return int(cursor.lastrowid or 0)

    def complete_session(self, session_id: int) -> None:
        """Mark a session as wholly built."""
        self._database.execute("UPDATE sessions SET state = 'complete' WHERE session_id = ?", (session_id,))

    def drop_session(self, session_id: int) -> None:
        """Take a session back, with all that its chunks hold. Its things must not be in the library yet."""
        for table, columns in _OF_CHUNKS:
            where = " OR ".join(f"{c} IN (SELECT chunk_id FROM chunks WHERE session_id = :session)" for c in columns)
            self._database.execute(f"DELETE FROM {table} WHERE {where}", {"session": session_id})
        votes = "SELECT 'label votes ' || chunk_id FROM chunks WHERE session_id = ?"
        self._database.execute(f"DELETE FROM memory WHERE key IN ({votes})", (session_id,))
        for table in ("frames", "chunks", "sessions"):
            self._database.execute(f"DELETE FROM {table} WHERE session_id = ?", (session_id,))
        self.forget_rows()

    def sessions(self) -> list[Session]:
        """All sessions in order."""
        query = "SELECT session_id, source, fingerprint, settings, frame_count, state FROM sessions ORDER BY session_id"
        return [Session(r[0], r[1], r[2], json.loads(r[3]), r[4], r[5]) for r in self._rows(query)]

    def add_chunk(self, session_id: int, result: ChunkResult) -> int:
        """Store one chunk as its own component with the identity as `S_world_chunk`; its id.

        Of the frames that it shares with the chunk before, the second half comes to be placed by the new chunk.
        """
        overlap = pack(sample_arrays(result.samples))
        links = result.library.cannot_link.astype("<i4").tobytes()
        cursor = self._database.execute(
            "INSERT INTO chunks (session_id, chunk_index, first_frame, last_frame, fx, fy, cx, cy, height, width,"
            " scale_kind, feature_space, cannot_link, overlap, seconds, crc)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                session_id,
                result.index,
                int(result.frame_indices[0]),
                int(result.frame_indices[-1]),
                *result.intrinsics,
                *result.image_size,
                result.scale_kind,
                result.library.feature_space,
                links,
                overlap,
                to_json(result.seconds),
                checksum(links, overlap),
            ),
        )
        chunk_id = int(cursor.lastrowid or 0)
        self._database.execute(
            "INSERT INTO placements VALUES (?, ?, ?, NULL)", (chunk_id, chunk_id, pack_sim3(Sim3.identity()))
        )
        self._chunk_rows = None if self._chunk_rows is None else {**self._chunk_rows, **self._read_chunks([chunk_id])}
        self._touch([chunk_id])
        self._add_frames(session_id, chunk_id, result)
        self._database.executemany(
            "INSERT INTO keyframes VALUES (?, ?, ?, ?, ?, ?)",
            [keyframe_row(chunk_id, keyframe) for keyframe in result.keyframes],
        )
        for instance in result.library.instances:
            self.add_local_instance(chunk_id, instance)
        return chunk_id
