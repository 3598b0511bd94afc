"""What instances are made of: their local instances, surfaces and tracks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import Sim3
from list3r.memory.records import Observation, Support
from list3r.memory.store.codec import dequantise, raw_array
from list3r.memory.store.tables.instances import InstanceVerbs

_BATCH = 500
"""Rows asked for by id in one statement."""


class ObservationVerbs(InstanceVerbs):
    """Writing and reading what instances are made of. Writing verbs are called inside `transaction()`."""

    def set_observations(self, observations: Iterable[Observation]) -> None:
        """Say which instance each local instance belongs to."""
        self._database.executemany(
            "INSERT OR REPLACE INTO observations VALUES (?, ?, ?)",
            [(o.chunk_id, o.local_id, o.instance_id) for o in observations],
        )

    def clear_observations(self) -> None:
        """Forget which instance each local instance belongs to, before all of it is said anew."""
        self._database.execute("DELETE FROM observations")

    def forget_observations(self, keys: Iterable[tuple[int, int]]) -> None:
        """Forget which instances these local instances belong to."""
        self._database.executemany("DELETE FROM observations WHERE chunk_id = ? AND local_id = ?", list(keys))

    def observations(self, instance_id: int | None = None) -> list[Observation]:
        """Which local instances make up an instance, or all of them."""
        where, arguments = ("", ()) if instance_id is None else ("WHERE instance = ?", (self.resolve(instance_id),))
        query = f"SELECT instance, chunk_id, local_id FROM observations {where} ORDER BY chunk_id, local_id"
        rows = self._rows(query, arguments)
        self._sound("observations", (row[1] for row in rows))
        return [Observation(*row) for row in rows]

    def observed_as(self, keys: Sequence[tuple[int, int]]) -> dict[tuple[int, int], int]:
        """The instances of these local instances (chunk id, local id) that belong to one."""
        wanted, chunks = set(keys), sorted({int(k) for k, _ in keys})
        out: dict[tuple[int, int], int] = {}
        for start in range(0, len(chunks), _BATCH):
            part = tuple(chunks[start : start + _BATCH])
            marks = ",".join("?" * len(part))
            query = f"SELECT chunk_id, local_id, instance FROM observations WHERE chunk_id IN ({marks})"
            out |= {(k, n): i for k, n, i in self._rows(query, part) if (k, n) in wanted}
        return out

    def has_moving(self) -> bool:
        """Whether any local instance was seen moving."""
        return bool(self._rows("SELECT 1 FROM local_instances WHERE dynamic LIMIT 1"))

    def node_checksum(self, chunk_id: int) -> int:
        """The same of one chunk; another one after a rollback, when its id may stand for another chunk."""
        moving = self._rows(
            "SELECT local_id, length(motion) FROM local_instances WHERE dynamic AND chunk_id = ? ORDER BY local_id",
            (int(chunk_id),),
        )
        count = self._rows("SELECT count(*) FROM local_instances WHERE chunk_id = ?", (int(chunk_id),))
        return hash((self.rollbacks, self.chunk_checksums().get(int(chunk_id), 0), count[0][0], *moving))

    def support(self, instance_id: int) -> Support:
        """All surface points of an instance, in the world as it is placed now; of what moves, where it was last."""
        instance = self.instance(instance_id)
        parts = self._support_parts(instance.id)
        chunks = self._poses({k for k, _ in parts})
        found = Support(
            np.concatenate([chunks[k].apply(s.points) for k, s in parts]).astype(np.float32)
            if parts
            else np.zeros((0, 3), np.float32),
            np.concatenate([s.confidence for _, s in parts]) if parts else np.zeros(0, np.float32),
            np.concatenate([s.rgb for _, s in parts]) if parts else np.zeros((0, 3), np.uint8),
        )
        moves = "SELECT 1 FROM events WHERE instance = ? AND kind = 'moved' LIMIT 1"
        if not instance.dynamic and not self._rows(moves, (instance.id,)):
            return found
        slack = 0.05 * float(np.linalg.norm(np.ptp(instance.aabb, axis=0)))
        here = np.all((found.points >= instance.aabb[0] - slack) & (found.points <= instance.aabb[1] + slack), axis=1)
        return Support(found.points[here], found.confidence[here], found.rgb[here])

    def surface_points(self, instance_id: int) -> NDArray[np.float32]:
        """Support points of one instance (no alias) in the world, without their colours. Shape (N, 3)."""
        query = (
            "SELECT s.chunk_id, s.local_id, s.count, s.grid, s.points, s.confidence, s.rgb FROM observations o"
            " JOIN supports s USING (chunk_id, local_id) WHERE o.instance = ? ORDER BY s.chunk_id, s.local_id"
        )
        rows = self._rows(query, (int(instance_id),))
        for table in ("observations", "supports"):
            self._sound(table, (row[0] for row in rows))
        if not rows:
            return np.zeros((0, 3), np.float32)
        placed = self._poses({row[0] for row in rows})
        parts = [
            placed[k].apply(dequantise(grid, points, count, f"the support of local instance {k}:{n}"))
            for k, n, count, grid, points, *_ in rows
        ]
        return np.concatenate(parts).astype(np.float32)

    def _support_parts(self, instance_id: int) -> list[tuple[int, Support]]:
        query = (
            "SELECT s.chunk_id, s.local_id, s.count, s.grid, s.points, s.confidence, s.rgb FROM observations o"
            " JOIN supports s USING (chunk_id, local_id) WHERE o.instance = ? ORDER BY s.chunk_id, s.local_id"
        )
        rows = self._rows(query, (instance_id,))
        for table in ("observations", "supports"):
            self._sound(table, (row[0] for row in rows))
        return [_support_part(row) for row in rows]

    def track(self, instance_id: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where a moving instance was: seconds of shape (V,) and places in the world of shape (V, 3), in order of time.

        Frames that two chunks saw count once, at the mean of what they say. In frames in which it stood still for a
        whole chunk the middle of its surface is its place. Nothing for an instance that was never seen moving.
        """
        _, times_s, places = self.track_frames(instance_id)
        return times_s, places

    def track_frames(self, instance_id: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """`track` with the frames it comes from: (session id, Frame.index) (V, 2), seconds (V,), places (V, 3)."""
        resolved = self.resolve(instance_id)
        empty = np.zeros((0, 2), np.int64), np.zeros(0), np.zeros((0, 3))
        if not self.instance(resolved).dynamic:
            return empty
        chunks = {c.chunk_id: c for c in self.chunks()}
        moving: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
        still: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
        for o in self.observations(resolved):
            chunk, motion = chunks[o.chunk_id], self.motion_track(o.chunk_id, o.local_id)
            if motion is not None and len(motion.frames):
                frames, places, found = motion.frames, chunk.S_world_chunk.apply(motion.positions), moving
            else:
                frames = self.mask_track(o.chunk_id, o.local_id).frames
                places, found = np.tile(self._middle(o, chunk.S_world_chunk), (len(frames), 1)), still
            for frame, place in zip(frames.tolist(), places, strict=True):
                found.setdefault((chunk.session_id, frame), []).append(place)
        seen = {**still, **moving}
        times = {(f.session_id, f.frame_index): f.time_s for f in self.frames()}
        keys = [k for k in sorted(seen) if k in times]
        if not keys:
            return empty
        places = np.array([np.mean(seen[k], axis=0) for k in keys])
        return np.array(keys, np.int64), np.array([times[k] for k in keys]), places

    def _middle(self, observation: Observation, S_world_chunk: Sim3) -> NDArray[np.float64]:
        """Middle of the surface of one local instance, world. Shape (3,)."""
        query = (
            "SELECT chunk_id, local_id, count, grid, points, confidence, rgb FROM supports"
            " WHERE chunk_id = ? AND local_id = ?"
        )
        rows = self._rows(query, (observation.chunk_id, observation.local_id))
        self._sound("supports", [observation.chunk_id])
        points = _support_part(rows[0])[1].points if rows else np.zeros((0, 3), np.float32)
        if len(points) == 0:
            return np.full(3, np.nan)
        return np.asarray(np.quantile(S_world_chunk.apply(points), [0.02, 0.98], axis=0).mean(axis=0))

    def _poses(self, chunk_ids: Iterable[int]) -> dict[int, Sim3]:
        """S_world_chunk of some chunks."""
        return {k: self.chunk(k).S_world_chunk for k in sorted(chunk_ids)}


def _support_part(row: tuple[Any, ...]) -> tuple[int, Support]:
    """(chunk id, support in chunk coordinates) of a row of `supports`."""
    chunk_id, local_id, count, grid, points, weight, rgb = row
    where = f"the support of local instance {chunk_id}:{local_id}"
    support = Support(
        dequantise(grid, points, count, where),
        raw_array(weight, "u1", (count,), where).astype(np.float32) / 255.0,
        raw_array(rgb, "u1", (count, 3), where).copy(),
    )
    return chunk_id, support
