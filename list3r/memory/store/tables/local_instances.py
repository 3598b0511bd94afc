"""Local instances: what one chunk measured of one thing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.errors import MemoryFileError
from list3r.memory.records import (
    LocalInstance,
    MaskTrack,
    MotionTrack,
    Support,
)
from list3r.memory.store.codec import (
    checksum,
    dequantise,
    pack,
    quantise,
    raw_array,
    unpack,
)
from list3r.memory.store.rows import (
    f8,
    read_motion,
    read_track,
    track_arrays,
)
from list3r.memory.store.tables.frames import FrameVerbs


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


class LocalVerbs(FrameVerbs):
    """Writing and reading local instances. Writing verbs are called inside `transaction()`."""

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

    def local_nodes(self, chunk_ids: Sequence[int] | None = None) -> list[LocalNode]:
        """Local instances without masks, of some chunks or of all, in the order of (chunk, local id)."""
        where = "" if chunk_ids is None else f"WHERE l.chunk_id IN ({','.join('?' * len(chunk_ids))})"
        query = (
            "SELECT l.chunk_id, l.local_id, c.session_id, l.stability, l.structure, l.dynamic, l.plane, l.feature,"
            " l.track, s.count, s.grid, s.points, s.confidence, s.rgb FROM local_instances l"
            " JOIN chunks c USING (chunk_id) JOIN supports s USING (chunk_id, local_id)"
            f" {where} ORDER BY l.chunk_id, l.local_id"
        )
        rows = self._rows(query, tuple(chunk_ids or ()))
        for table in ("local_instances", "supports"):
            self._sound(table, (row[0] for row in rows))
        return [_local_node(row) for row in rows]

    def mask_track(self, chunk_id: int, local_id: int) -> MaskTrack:
        """The masks of one local instance. Raises `MemoryFileError` when it is not there."""
        self._sound("local_instances", [chunk_id])
        rows = self._rows("SELECT track FROM local_instances WHERE chunk_id = ? AND local_id = ?", (chunk_id, local_id))
        if not rows:
            raise MemoryFileError(f"{self.path} has no local instance {local_id} in chunk {chunk_id}")
        return read_track(unpack(rows[0][0], f"the masks of local instance {chunk_id}:{local_id}"))

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
        self._sound("local_instances", [chunk_id])
        query = "SELECT local_id FROM local_instances WHERE chunk_id = ? AND dynamic ORDER BY local_id"
        return [int(n) for (n,) in self._rows(query, (chunk_id,))]

    def motion_track(self, chunk_id: int, local_id: int) -> MotionTrack | None:
        """Where a moving local instance was, chunk coordinates; None for one that does not move."""
        self._sound("local_instances", [chunk_id])
        query = "SELECT motion FROM local_instances WHERE chunk_id = ? AND local_id = ?"
        rows = self._rows(query, (chunk_id, local_id))
        return read_motion(rows[0][0], f"the motion of local instance {chunk_id}:{local_id}") if rows else None

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
