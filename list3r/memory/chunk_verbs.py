"""Sessions, chunks, frames, edges, keyframes and local instances: what is measured."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.bend_verbs import BendVerbs
from list3r.memory.codec import (
    checksum,
    dequantise,
    pack,
    pack_sim3,
    quantise,
    raw_array,
    to_json,
    unpack,
)
from list3r.memory.errors import MemoryFileError
from list3r.memory.geometry import Sim3
from list3r.memory.records import (
    ChunkResult,
    ChunkRow,
    Edge,
    FrameRow,
    FrameSamples,
    Keyframe,
    LocalInstance,
    MaskTrack,
    MotionTrack,
    Session,
    Support,
)
from list3r.memory.rows import (
    f8,
    keyframe_row,
    read_chunk_row,
    read_edge,
    read_frame_row,
    read_keyframe,
    read_motion,
    read_samples,
    read_track,
    sample_arrays,
    track_arrays,
)
from list3r.memory.writer_lock import WriterLock


@dataclass(frozen=True)
class LocalNode:
    """A local instance without its masks: what merging looks at."""

    chunk_id: int
    local_id: int
    session_id: int
    stability: float
    structure: bool
    dynamic: bool
    plane: NDArray[np.float64] | None
    """Chunk coordinates. Shape (4,)."""
    feature: NDArray[np.float32]
    """Shape (D,)."""
    support: Support
    """Chunk coordinates."""
    frames: NDArray[np.int64]
    """Frame.index of the visible frames. Shape (V,)."""
    boxes_xyxy: NDArray[np.float32]
    """Shape (V, 4)."""
    areas_px: NDArray[np.int32]
    """Shape (V,)."""
    visible_fraction: NDArray[np.float32]
    """Shape (V,)."""


class ChunkVerbs(BendVerbs):
    """Writing and reading what the chunks measured. Writing verbs are called inside `transaction()`."""

    def __init__(self, path: Path, database: sqlite3.Connection, lock: WriterLock | None) -> None:
        super().__init__(path, database, lock)
        self._chunk_rows: dict[int, ChunkRow] | None = None
        self._chunk_version = self._edge_version = -1
        self._crcs: dict[int, int] | None = None
        self._edge_rows: dict[tuple[int, int, str, int, int], Edge] | None = None
        self.touched: set[int] | None = None
        """Chunks that were placed or measured anew since the library was derived; None where that is not known."""

    # ------------------------------------------------------------------ sessions

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

    def sessions(self) -> list[Session]:
        """All sessions in order."""
        query = "SELECT session_id, source, fingerprint, settings, frame_count, state FROM sessions ORDER BY session_id"
        return [Session(r[0], r[1], r[2], json.loads(r[3]), r[4], r[5]) for r in self._rows(query)]

    # ------------------------------------------------------------------ chunks

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

    def add_local_instance(self, chunk_id: int, instance: LocalInstance) -> None:
        """Store one more local instance of a chunk, under a local id that the chunk does not have yet."""
        self.unsettle(chunk_id)
        track = pack(track_arrays(instance.track))
        feature = instance.feature.astype("<f4").tobytes()
        plane = None if instance.plane is None else f8(instance.plane)
        motion = None if instance.motion is None else pack(asdict(instance.motion))
        self._database.execute(
            "INSERT INTO local_instances (chunk_id, local_id, stability, structure, plane, feature, track, crc,"
            " dynamic, motion) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                chunk_id,
                instance.local_id,
                float(instance.stability),
                int(instance.structure),
                plane,
                feature,
                track,
                checksum(feature, track),
                int(instance.dynamic),
                motion,
            ),
        )
        grid, points = quantise(instance.support.points)
        confidence = np.round(np.clip(instance.support.confidence, 0, 1) * 255).astype(np.uint8).tobytes()
        rgb = instance.support.rgb.astype(np.uint8).tobytes()
        self._database.execute(
            "INSERT INTO supports VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (
                chunk_id,
                instance.local_id,
                len(instance.support.points),
                grid,
                points,
                confidence,
                rgb,
                checksum(grid, points, confidence, rgb),
            ),
        )

    def chunks(self, session_id: int | None = None) -> list[ChunkRow]:
        """The chunks in order, of one session or of all."""
        rows = self._placed().values()
        return [c for c in rows if session_id is None or c.session_id == session_id]

    def chunk(self, chunk_id: int) -> ChunkRow:
        """One chunk. Raises `MemoryFileError` when the memory has none of that id."""
        found = self._placed().get(chunk_id)
        if found is None:
            raise MemoryFileError(f"{self.path} has no chunk {chunk_id}")
        return found

    def _placed(self) -> dict[int, ChunkRow]:
        """All chunks by id, read again only when another process or a rollback may have changed them."""
        version = int(self._rows("PRAGMA data_version")[0][0])
        if self._chunk_rows is None or self._chunk_version != version:
            self._chunk_rows, self._chunk_version, self._crcs = self._read_chunks(), version, None
        return self._chunk_rows

    def _read_chunks(self, chunk_ids: Sequence[int] = ()) -> dict[int, ChunkRow]:
        where = f"WHERE c.chunk_id IN ({','.join('?' * len(chunk_ids))})" if chunk_ids else ""
        query = (
            "SELECT c.chunk_id, c.session_id, c.chunk_index, c.first_frame, c.last_frame, p.component,"
            " p.S_world_chunk, c.fx, c.fy, c.cx, c.cy, c.height, c.width, c.scale_kind, p.covariance"
            f" FROM chunks c JOIN placements p USING (chunk_id) {where} ORDER BY c.chunk_id"
        )
        return {row[0]: read_chunk_row(row) for row in self._rows(query, tuple(chunk_ids))}

    def place_chunks(
        self,
        poses: Mapping[int, Sim3],
        components: Mapping[int, int],
        covariances: Mapping[int, NDArray[np.float64]] | None = None,
    ) -> None:
        """Rewrite `S_world_chunk`, component and uncertainty of chunks: all that a loop closure moves.

        Chunks that are not named stay as they are, and so do the rows of those that lie there already.
        """
        known = covariances or {}
        rows = dict(self._placed())
        fresh = []
        for k, S in poses.items():
            after = replace(rows[k], S_world_chunk=S, component=int(components[k]), covariance=known.get(k))
            if not _same_place(rows[k], after):
                fresh.append(k)
                rows[k] = after
        self._database.executemany(
            "UPDATE placements SET component = ?, S_world_chunk = ?, covariance = ? WHERE chunk_id = ?",
            [
                (
                    rows[k].component,
                    pack_sim3(rows[k].S_world_chunk),
                    None if rows[k].covariance is None else f8(known[k]),
                    k,
                )
                for k in fresh
            ],
        )
        self._chunk_rows = rows
        self._touch(fresh)

    def unsettle(self, chunk_id: int) -> None:
        """What was derived from a chunk does not hold any more: it was measured anew."""
        gone = self._database.execute("DELETE FROM settled WHERE chunk_id = ?", (int(chunk_id),)).rowcount
        self.unsettled += gone
        self._touch([chunk_id])

    def _touch(self, chunk_ids: Iterable[int]) -> None:
        if self.touched is not None:
            self.touched.update(chunk_ids)

    def forget_rows(self) -> None:
        """Read chunks and edges again when they are next asked for."""
        self._chunk_rows = self._edge_rows = self._crcs = None

    def _roll_back(self) -> None:
        super()._roll_back()
        self.forget_rows()
        self.touched = None

    def flag_dynamic(self, chunk_id: int, motions: Mapping[int, MotionTrack | None]) -> None:
        """Say of local instances, by local id, that they move, and where they were."""
        self._database.executemany(
            "UPDATE local_instances SET dynamic = 1, motion = coalesce(?, motion) WHERE chunk_id = ? AND local_id = ?",
            [(None if m is None else pack(asdict(m)), chunk_id, n) for n, m in motions.items()],
        )
        if motions:
            self.unsettle(chunk_id)

    def dynamic_locals(self, chunk_id: int) -> list[int]:
        """Local ids of a chunk's instances that move."""
        query = "SELECT local_id FROM local_instances WHERE chunk_id = ? AND dynamic ORDER BY local_id"
        return [int(n) for (n,) in self._rows(query, (chunk_id,))]

    def motion_track(self, chunk_id: int, local_id: int) -> MotionTrack | None:
        """Where a moving local instance was, chunk coordinates; None for one that does not move."""
        query = "SELECT motion FROM local_instances WHERE chunk_id = ? AND local_id = ?"
        rows = self._rows(query, (chunk_id, local_id))
        return read_motion(rows[0][0], f"the motion of local instance {chunk_id}:{local_id}") if rows else None

    def frame_samples(self, chunk_id: int) -> FrameSamples:
        """The sampled points of a chunk's frames, chunk coordinates."""
        blob = self._rows("SELECT overlap FROM chunks WHERE chunk_id = ?", (chunk_id,))[0][0]
        return read_samples(unpack(blob, f"the samples of chunk {chunk_id}"))

    def cannot_links(self, chunk_id: int) -> NDArray[np.int32]:
        """Pairs of local ids of a chunk that are two things. Shape (P, 2)."""
        blob = self._rows("SELECT cannot_link FROM chunks WHERE chunk_id = ?", (chunk_id,))[0][0]
        return np.frombuffer(blob, "<i4").reshape(-1, 2).astype(np.int32)

    def add_cannot_links(self, chunk_id: int, pairs: Sequence[tuple[int, int]]) -> None:
        """Say of pairs of a chunk's local instances that they are two things; call inside `transaction()`."""
        rows = self._rows("SELECT cannot_link, overlap FROM chunks WHERE chunk_id = ?", (chunk_id,))
        links = rows[0][0] + np.array(pairs, "<i4").reshape(-1, 2).tobytes()
        crc = checksum(links, rows[0][1])
        self._database.execute("UPDATE chunks SET cannot_link = ?, crc = ? WHERE chunk_id = ?", (links, crc, chunk_id))
        self._crcs = None

    def feature_space(self, chunk_id: int) -> str:
        """The embedding space of a chunk's local features."""
        return str(self._rows("SELECT feature_space FROM chunks WHERE chunk_id = ?", (chunk_id,))[0][0])

    def chunk_checksums(self) -> dict[int, int]:
        """A checksum of what each chunk measured, by chunk id: tells whether something derived from it still holds."""
        rows = self._placed()
        if self._crcs is None or self._crcs.keys() != rows.keys():
            known = self._crcs or {}
            query = "SELECT crc FROM chunks WHERE chunk_id = ?"
            self._crcs = {k: known[k] if k in known else int(self._rows(query, (k,))[0][0]) for k in rows}
        return dict(self._crcs)

    def stage_seconds(self) -> dict[str, float]:
        """CPU seconds spent so far by stage, over all chunks."""
        total: dict[str, float] = {}
        for (text,) in self._rows("SELECT seconds FROM chunks ORDER BY chunk_id"):
            for stage, seconds in json.loads(text).items():
                total[stage] = total.get(stage, 0.0) + seconds
        return total

    # ------------------------------------------------------------------ edges

    def add_edges(self, edges: Iterable[Edge]) -> None:
        """Store measured relations of chunks; one measured again replaces the old one."""
        known = self._known_edges()
        fresh = list(edges)
        self._database.executemany(
            "INSERT OR REPLACE INTO edges (u, v, kind, frame_u, frame_v, S_v_u, confidence, weight, inliers,"
            " residual_m, accepted, reason, scores, covariance) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                (
                    e.u,
                    e.v,
                    e.kind,
                    *(e.frames or (-1, -1)),
                    pack_sim3(e.S_v_u),
                    e.confidence,
                    e.weight,
                    e.inliers,
                    e.residual_m,
                    int(e.accepted),
                    e.reason,
                    to_json(e.scores),
                    None if e.covariance is None else f8(e.covariance),
                )
                for e in fresh
            ],
        )
        for e in fresh:
            key = (e.u, e.v, e.kind, *(e.frames or (-1, -1)))
            known |= self._read_edges("WHERE u = ? AND v = ? AND kind = ? AND frame_u = ? AND frame_v = ?", key)
        self._edge_rows = dict(sorted(known.items()))

    def edges(self) -> list[Edge]:
        """All measured relations of chunks, accepted or not."""
        return list(self._known_edges().values())

    def _known_edges(self) -> dict[tuple[int, int, str, int, int], Edge]:
        """All edges by key and in order, read again only when another process or a rollback may have changed them."""
        version = int(self._rows("PRAGMA data_version")[0][0])
        if self._edge_rows is None or self._edge_version != version:
            self._edge_rows, self._edge_version = self._read_edges(), version
        return self._edge_rows

    def _read_edges(self, where: str = "", key: tuple[Any, ...] = ()) -> dict[tuple[int, int, str, int, int], Edge]:
        query = (
            "SELECT u, v, kind, S_v_u, confidence, weight, inliers, residual_m, accepted, reason, scores, frame_u,"
            f" frame_v, covariance FROM edges {where} ORDER BY u, v, kind, frame_u, frame_v"
        )
        return {(r[0], r[1], r[2], r[11], r[12]): read_edge(r) for r in self._rows(query, key)}

    # ------------------------------------------------------------------ frames and keyframes

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
        query = "SELECT frame_index, descriptor, features, jpeg FROM keyframes WHERE chunk_id = ? ORDER BY frame_index"
        return [read_keyframe(chunk_id, *row) for row in self._rows(query, (chunk_id,))]

    def keyframe(self, chunk_id: int, frame_index: int) -> Keyframe:
        """One keyframe. Raises `MemoryFileError` when the memory has none there."""
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
        keys = np.array([(r[0], r[1]) for r in rows], dtype=np.int64).reshape(-1, 2)
        out = np.zeros((len(rows), len(rows[0][2]) // 4 if rows else 0), np.float32)
        for k, row in enumerate(rows):
            if len(row[2]) == 4 * out.shape[1]:
                out[k] = np.frombuffer(row[2], "<f4")
        return keys, out

    # ------------------------------------------------------------------ local instances

    def local_nodes(self, chunk_ids: Sequence[int] | None = None) -> list[LocalNode]:
        """Local instances without masks, of some chunks or of all, in the order of (chunk, local id)."""
        where = "" if chunk_ids is None else f"WHERE l.chunk_id IN ({','.join('?' * len(chunk_ids))})"
        query = (
            "SELECT l.chunk_id, l.local_id, c.session_id, l.stability, l.structure, l.dynamic, l.plane, l.feature,"
            " l.track, s.count, s.grid, s.points, s.confidence, s.rgb FROM local_instances l"
            " JOIN chunks c USING (chunk_id) JOIN supports s USING (chunk_id, local_id)"
            f" {where} ORDER BY l.chunk_id, l.local_id"
        )
        return [_local_node(row) for row in self._rows(query, tuple(chunk_ids or ()))]

    def mask_track(self, chunk_id: int, local_id: int) -> MaskTrack:
        """The masks of one local instance. Raises `MemoryFileError` when it is not there."""
        rows = self._rows("SELECT track FROM local_instances WHERE chunk_id = ? AND local_id = ?", (chunk_id, local_id))
        if not rows:
            raise MemoryFileError(f"{self.path} has no local instance {local_id} in chunk {chunk_id}")
        return read_track(unpack(rows[0][0], f"the masks of local instance {chunk_id}:{local_id}"))


def _same_place(a: ChunkRow, b: ChunkRow) -> bool:
    """Whether two rows of one chunk say the same of where it lies."""
    if a.component != b.component or (a.covariance is None) != (b.covariance is None):
        return False
    S, T = a.S_world_chunk, b.S_world_chunk
    same = np.array_equal(S.scale, T.scale) and np.array_equal(S.translation, T.translation)
    same = same and np.array_equal(S.rotation, T.rotation)
    return bool(same and (a.covariance is None or np.array_equal(a.covariance, np.asarray(b.covariance))))


def _local_node(row: tuple[Any, ...]) -> LocalNode:
    chunk_id, local_id, session_id, stability, structure, dynamic, plane, feature, track, *support_row = row
    count, grid, points, weight, rgb = support_row
    where = f"local instance {chunk_id}:{local_id}"
    arrays = unpack(track, where)
    support = Support(
        dequantise(grid, points, count, where),
        raw_array(weight, "u1", (count,), where).astype(np.float32) / 255.0,
        raw_array(rgb, "u1", (count, 3), where).copy(),
    )
    return LocalNode(
        chunk_id=chunk_id,
        local_id=local_id,
        session_id=session_id,
        stability=stability,
        structure=bool(structure),
        dynamic=bool(dynamic),
        plane=None if plane is None else raw_array(plane, "<f8", (4,), where).copy(),
        feature=np.frombuffer(feature, "<f4").astype(np.float32),
        support=support,
        frames=arrays["frames"],
        boxes_xyxy=arrays["boxes_xyxy"],
        areas_px=arrays["areas_px"],
        visible_fraction=arrays["visible_fraction"],
    )
