"""Frames of the trajectory, keyframes, and samples of what frames measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import MemoryFileError
from list3r.memory.geometry import Sim3
from list3r.memory.records import (
    ChunkResult,
    ChunkRow,
    FrameRow,
    FrameSamples,
    Keyframe,
)
from list3r.memory.store.codec import (
    unpack,
)
from list3r.memory.store.rows import (
    f8,
    read_frame_row,
    read_keyframe,
    read_samples,
)
from list3r.memory.store.tables.placements import PlacementVerbs


class FrameVerbs(PlacementVerbs):
    """Writing and reading frames. Writing verbs are called inside `transaction()`."""

    def _add_frames(self, session_id: int, chunk_id: int, result: ChunkResult) -> None:
        known = {
            r[0]: r[1]
            for r in self._rows(
                "SELECT frame_index, state FROM frames WHERE session_id = ? AND frame_index >= ?",
                (session_id, int(min(result.frame_indices[0], *[b[0] for b in result.bad_frames], 2**62))),
            )
        }
        shared = [int(i) for i in result.frame_indices if int(i) in known]
        switch = shared[len(shared) // 2] if shared else -1
        rows = []
        for k, index in enumerate(int(i) for i in result.frame_indices):
            posed = bool(result.posed[k])
            if index in known and not (posed and (index >= switch or known[index] != "posed")):
                continue
            pose = result.T_chunk_cam[k] if posed else np.full((4, 4), np.nan)
            state = "posed" if posed else "lost"
            rows.append((session_id, index, float(result.times_s[k]), chunk_id, state, f8(pose), ""))
        for index, reason in result.bad_frames:
            if index not in known:
                rows.append((session_id, index, float("nan"), chunk_id, "bad", f8(np.full((4, 4), np.nan)), reason))
        self._database.executemany(
            "INSERT OR REPLACE INTO frames VALUES (?, ?, ?, ?, ?, ?, ?)",
            [(*r[:2], 0.0 if np.isnan(r[2]) else r[2], *r[3:]) for r in rows],
        )

    def frames(self, session_id: int | None = None) -> list[FrameRow]:
        """The trajectory: every frame seen, in order, poses in their chunks."""
        where, arguments = ("", ()) if session_id is None else ("WHERE session_id = ?", (session_id,))
        query = (
            "SELECT session_id, frame_index, time_s, chunk_id, state, T_chunk_cam FROM frames"
            f" {where} ORDER BY session_id, frame_index"
        )
        return [read_frame_row(row) for row in self._rows(query, arguments)]

    def frames_of(self, chunk: ChunkRow) -> list[FrameRow]:
        """The frames that a chunk places, in order."""
        query = (
            "SELECT session_id, frame_index, time_s, chunk_id, state, T_chunk_cam FROM frames"
            " WHERE session_id = ? AND frame_index BETWEEN ? AND ? AND chunk_id = ? ORDER BY frame_index"
        )
        arguments = (chunk.session_id, chunk.first_frame, chunk.last_frame, chunk.chunk_id)
        return [read_frame_row(row) for row in self._rows(query, arguments)]

    def frame_times(self, chunk: ChunkRow) -> dict[tuple[int, int], float]:
        """Seconds by (session id, Frame.index) of the frames that lie in the span of a chunk, whoever places them."""
        query = "SELECT frame_index, time_s FROM frames WHERE session_id = ? AND frame_index BETWEEN ? AND ?"
        rows = self._rows(query, (chunk.session_id, chunk.first_frame, chunk.last_frame))
        return {(chunk.session_id, int(f)): float(t) for f, t in rows}

    def posed_count(self, most: int = -1) -> int:
        """How many frames have a pose; counted up to `most` where that is given."""
        query = "SELECT count(*) FROM (SELECT 1 FROM frames WHERE state = 'posed' LIMIT ?)"
        return int(self._rows(query, (most,))[0][0])

    def bad_frames(self) -> list[tuple[int, int, str]]:
        """(session id, Frame.index, reason) of the frames that could not be decoded."""
        query = "SELECT session_id, frame_index, note FROM frames WHERE state = 'bad' ORDER BY session_id, frame_index"
        return [(r[0], r[1], r[2]) for r in self._rows(query)]

    def camera_poses(self, session_id: int | None = None) -> list[tuple[FrameRow, Sim3]]:
        """Every posed frame with its `S_world_cam`, the bending of its chunk undone."""
        chunks = {c.chunk_id: c.S_world_chunk for c in self.chunks()}
        posed = [f for f in self.frames(session_id) if f.state == "posed"]
        of_chunk: dict[int, list[int]] = {}
        for f in posed:
            of_chunk.setdefault(f.chunk_id, []).append(f.frame_index)
        straight: dict[tuple[int, int], Sim3] = {}
        for k, bend in self.bends().items():
            frames = of_chunk.get(k, [])
            x = bend.at(np.array(frames, np.int64))
            straight |= {(k, f): Sim3(x.scale[n], x.rotation[n], x.translation[n]) for n, f in enumerate(frames)}
        none = Sim3.identity()
        return [
            (f, chunks[f.chunk_id] @ straight.get((f.chunk_id, f.frame_index), none) @ Sim3.from_matrix(f.T_chunk_cam))
            for f in posed
        ]

    def keyframes(self, chunk_id: int) -> list[Keyframe]:
        """The keyframes of a chunk in order."""
        self._sound("keyframes", [chunk_id])
        query = "SELECT frame_index, descriptor, features, jpeg FROM keyframes WHERE chunk_id = ? ORDER BY frame_index"
        return [read_keyframe(chunk_id, *row) for row in self._rows(query, (chunk_id,))]

    def keyframe(self, chunk_id: int, frame_index: int) -> Keyframe:
        """One keyframe. Raises `MemoryFileError` when the memory has none there."""
        self._sound("keyframes", [chunk_id])
        query = "SELECT frame_index, descriptor, features, jpeg FROM keyframes WHERE chunk_id = ? AND frame_index = ?"
        rows = self._rows(query, (chunk_id, frame_index))
        if not rows:
            raise MemoryFileError(f"{self.path} has no keyframe {frame_index} in chunk {chunk_id}")
        return read_keyframe(chunk_id, *rows[0])

    def keyframe_descriptors(
        self, chunk_ids: Sequence[int] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Keyframes of some chunks or of all: (chunk id, Frame.index) of shape (K, 2), descriptors of shape (K, D).

        A descriptor of another length than the first one's is left as zeros.
        """
        where = "" if chunk_ids is None else f"WHERE chunk_id IN ({','.join(str(int(k)) for k in chunk_ids)})"
        query = f"SELECT chunk_id, frame_index, descriptor FROM keyframes {where} ORDER BY chunk_id, frame_index"
        rows = self._rows(query)
        self._sound("keyframes", (row[0] for row in rows))
        keys = np.array([(r[0], r[1]) for r in rows], dtype=np.int64).reshape(-1, 2)
        out = np.zeros((len(rows), len(rows[0][2]) // 4 if rows else 0), np.float32)
        for k, row in enumerate(rows):
            if len(row[2]) == 4 * out.shape[1]:
                out[k] = np.frombuffer(row[2], "<f4")
        return keys, out

    def frame_samples(self, chunk_id: int) -> FrameSamples:
        """The sampled points of a chunk's frames, chunk coordinates."""
        blob = self._rows("SELECT overlap FROM chunks WHERE chunk_id = ?", (chunk_id,))[0][0]
        return read_samples(unpack(blob, f"the samples of chunk {chunk_id}"))
