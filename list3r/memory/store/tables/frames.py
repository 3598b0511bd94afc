"""Frames of the trajectory, and keyframes, by which places are found again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import UNSURE, ChunkResult, ChunkRow, FrameRow, Keyframe
from list3r.memory.store.connection import Connection
from list3r.memory.store.rows.codec import pack, unpack
from list3r.memory.store.rows.columns import Columns, joined, nested
from list3r.memory.store.rows.table import Table

_NOWHERE = np.full((4, 4), np.nan)
_FEATURES = {
    "T_chunk_cam": np.float64,
    "keypoints_xy": np.float32,
    "keypoint_descriptors": np.uint8,
    "points_cam": np.float32,
    "depth_small": np.float32,
    "camera_small": np.float64,
}
"""Fields of a keyframe that share one blob."""


def _pack_features(*values: object) -> tuple[bytes]:
    return (pack({n: np.asarray(v).astype(t) for (n, t), v in zip(_FEATURES.items(), values, strict=True)}),)


def _unpack_features(blob: bytes) -> list[object]:
    held: dict[str, object] = {**unpack(blob, "the features")}
    fx, fy, cx, cy = np.asarray(held["camera_small"]).tolist()
    return [held[n] for n in list(_FEATURES)[:-1]] + [(fx, fy, cx, cy)]


@dataclass(frozen=True)
class _KeyframeRow:
    chunk_id: int
    keyframe: Keyframe


_KEYFRAME = Columns(Keyframe, joined(("features",), tuple(_FEATURES), _pack_features, _unpack_features))


class Frames:
    """The table of frames. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._rows = Table(connection, "frames", Columns.of(FrameRow), "session_id, frame_index")

    def add(self, session_id: int, chunk_id: int, result: ChunkResult) -> None:
        """Store the frames of a chunk; of those that it shares with the chunk before it places the second half."""
        first = min([*result.frame_indices[:1].tolist(), *[index for index, _ in result.bad_frames]])
        query = "SELECT frame_index, state FROM frames WHERE session_id = ? AND frame_index >= ?"
        known = dict(self._connection.rows(query, (session_id, first)))
        shared = [int(i) for i in result.frame_indices if int(i) in known]
        switch = shared[len(shared) // 2] if shared else -1
        rows = []
        for k, index in enumerate(int(i) for i in result.frame_indices):
            posed = bool(result.posed[k])
            if index in known and not (posed and (index >= switch or known[index] != "posed")):
                continue
            time_s = 0.0 if np.isnan(result.times_s[k]) else float(result.times_s[k])
            pose = result.T_chunk_cam[k] if posed else _NOWHERE
            note = UNSURE if posed and index in result.unsure else ""
            rows.append(FrameRow(session_id, index, time_s, chunk_id, "posed" if posed else "lost", pose, note))
        for index, reason in result.bad_frames:
            if index not in known:
                rows.append(FrameRow(session_id, index, 0.0, chunk_id, "bad", _NOWHERE, reason))
        self._rows.put(rows)

    def all(self, session_id: int | None = None) -> list[FrameRow]:
        """Return every frame seen, of one session or of all, in order, poses in their chunks."""
        return self._rows.all() if session_id is None else self._rows.all("session_id = ?", (session_id,))

    def of(self, chunk: ChunkRow) -> list[FrameRow]:
        """Return the frames that a chunk places, in order."""
        condition = "session_id = ? AND frame_index BETWEEN ? AND ? AND chunk_id = ?"
        return self._rows.all(condition, (chunk.session_id, chunk.first_frame, chunk.last_frame, chunk.chunk_id))

    def times(self, chunk: ChunkRow) -> dict[tuple[int, int], float]:
        """Return seconds by (session id, Frame.index) of the frames in the span of a chunk, whoever places them."""
        query = "SELECT frame_index, time_s FROM frames WHERE session_id = ? AND frame_index BETWEEN ? AND ?"
        rows = self._connection.rows(query, (chunk.session_id, chunk.first_frame, chunk.last_frame))
        return {(chunk.session_id, int(f)): float(t) for f, t in rows}

    def posed_count(self, most: int = -1) -> int:
        """Return how many frames have a pose; counted up to `most` where that is given."""
        query = "SELECT count(*) FROM (SELECT 1 FROM frames WHERE state = 'posed' LIMIT ?)"
        return int(self._connection.rows(query, (most,))[0][0])

    def count(self, session_id: int) -> int:
        """Return how many frames of a session were seen."""
        query = "SELECT count(*) FROM frames WHERE session_id = ?"
        return int(self._connection.rows(query, (session_id,))[0][0])

    def bad(self) -> list[FrameRow]:
        """Return the frames that could not be decoded, each with the reason as its note."""
        return self._rows.all("state = 'bad'")


class Keyframes:
    """The table of keyframes. What writes is called inside `transaction()`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        columns = Columns.of(_KeyframeRow, nested("keyframe", _KEYFRAME))
        self._rows = Table(connection, "keyframes", columns, "chunk_id, frame_index")

    def add(self, chunk_id: int, keyframes: Iterable[Keyframe]) -> None:
        """Store keyframes of a chunk."""
        self._rows.add_all(_KeyframeRow(chunk_id, keyframe) for keyframe in keyframes)

    def of(self, chunk_id: int) -> list[Keyframe]:
        """Return the keyframes of a chunk in order."""
        return [row.keyframe for row in self._rows.all("chunk_id = ?", (chunk_id,))]

    def with_picture(self, chunk_id: int) -> list[int]:
        """Return Frame.index of the keyframes of a chunk that have a picture, in order."""
        query = "SELECT frame_index FROM keyframes WHERE chunk_id = ? AND length(jpeg) > 0 ORDER BY frame_index"
        rows = self._connection.rows(query, (chunk_id,))
        return [int(row[0]) for row in rows]

    def get(self, chunk_id: int, frame_index: int) -> Keyframe:
        """Return one keyframe. Raises `MemoryFileError` when the memory has none there."""
        found = self._rows.first("chunk_id = ? AND frame_index = ?", (chunk_id, frame_index))
        if found is None:
            raise MemoryFileError(f"{self._connection.path} has no keyframe {frame_index} in chunk {chunk_id}")
        return found.keyframe

    def descriptors(self, chunk_ids: Sequence[int] | None = None) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return (chunk id, Frame.index) (K, 2) and descriptors (K, D) of the keyframes of some chunks or of all.

        Frames kept for their picture alone are left out. A descriptor of another length than the first one's is left
        as zeros.
        """
        where = "" if chunk_ids is None else f"WHERE chunk_id IN ({','.join(str(int(k)) for k in chunk_ids)})"
        query = f"SELECT chunk_id, frame_index, descriptor FROM keyframes {where} ORDER BY chunk_id, frame_index"
        rows = self._connection.rows(query)
        rows = [row for row in rows if any(row[2])]
        keys = np.array([(r[0], r[1]) for r in rows], dtype=np.int64).reshape(-1, 2)
        out = np.zeros((len(rows), len(rows[0][2]) // 4 if rows else 0), np.float32)
        for k, row in enumerate(rows):
            if len(row[2]) == 4 * out.shape[1]:
                out[k] = np.frombuffer(row[2], "<f4")
        return keys, out
