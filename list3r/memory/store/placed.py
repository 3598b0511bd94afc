"""What follows from several tables: cameras, surfaces and tracks, put where their chunks lie."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameRow, Instance, Observation, Support
from list3r.memory.store.tables.chunks import Chunks
from list3r.memory.store.tables.edges import Bends
from list3r.memory.store.tables.events import Events
from list3r.memory.store.tables.frames import Frames
from list3r.memory.store.tables.instances import Instances
from list3r.memory.store.tables.local_instances import LocalInstances, Supports
from list3r.memory.store.tables.observations import Observations


class PlacedTrajectory:
    """Where the cameras were."""

    def __init__(self, chunks: Chunks, frames: Frames, bends: Bends) -> None:
        self._chunks = chunks
        self._frames = frames
        self._bends = bends

    def poses(self, session_id: int | None = None) -> list[tuple[FrameRow, Sim3]]:
        """Return every posed frame with its `S_world_cam`, the bending of its chunk undone."""
        chunks = {c.chunk_id: c.S_world_chunk for c in self._chunks.all()}
        posed = [f for f in self._frames.all(session_id) if f.state == "posed"]
        of_chunk: dict[int, list[int]] = {}
        for f in posed:
            of_chunk.setdefault(f.chunk_id, []).append(f.frame_index)
        straight: dict[tuple[int, int], Sim3] = {}
        for k, bend in self._bends.all().items():
            frames = of_chunk.get(k, [])
            x = bend.at(np.array(frames, np.int64))
            straight |= {(k, f): Sim3(x.scale[n], x.rotation[n], x.translation[n]) for n, f in enumerate(frames)}
        none = Sim3.identity()
        return [
            (f, chunks[f.chunk_id] @ straight.get((f.chunk_id, f.frame_index), none) @ Sim3.from_matrix(f.T_chunk_cam))
            for f in posed
        ]


class Surfaces:
    """The surfaces of instances, in the world as they are placed now."""

    def __init__(self, chunks: Chunks, supports: Supports, instances: Instances, events: Events) -> None:
        self._chunks = chunks
        self._supports = supports
        self._instances = instances
        self._events = events

    def of(self, instance_id: int) -> Support:
        """Return all surface points of an instance; of one that moves those where it was last.

        Raises `UnknownIdError`.
        """
        return self.of_instance(self._instances.get(instance_id))

    def of_instance(self, instance: Instance) -> Support:
        """Return `of` for an instance that was read."""
        parts = self._supports.of(instance.id)
        found = Support(
            self._in_world([(p.chunk_id, p.support.points) for p in parts]),
            np.concatenate([p.support.confidence for p in parts]) if parts else np.zeros(0, np.float32),
            np.concatenate([p.support.rgb for p in parts]) if parts else np.zeros((0, 3), np.uint8),
        )
        if not instance.dynamic and not self._events.has_moved(instance.id):
            return found
        slack = 0.05 * float(np.linalg.norm(np.ptp(instance.aabb, axis=0)))
        here = np.all((found.points >= instance.aabb[0] - slack) & (found.points <= instance.aabb[1] + slack), axis=1)
        return Support(found.points[here], found.confidence[here], found.rgb[here])

    def points(self, instance_id: int) -> NDArray[np.float32]:
        """Return the surface points of one instance (no alias), wherever they were seen. Shape (N, 3)."""
        return self._in_world([(p.chunk_id, p.support.points) for p in self._supports.of(instance_id)])

    def points_of_each(self, ids: Sequence[int]) -> dict[int, NDArray[np.float32]]:
        """Return `points` of some instances, by id, where there are any."""
        found = self._supports.of_each(ids)
        return {n: self._in_world([(p.chunk_id, p.support.points) for p in parts]) for n, parts in found.items()}

    def _in_world(self, parts: list[tuple[int, NDArray[np.float32]]]) -> NDArray[np.float32]:
        if not parts:
            return np.zeros((0, 3), np.float32)
        return np.concatenate([self._chunks.get(k).S_world_chunk.apply(points) for k, points in parts]).astype(
            np.float32
        )


class PlacedTracks:
    """Where moving instances were over time."""

    def __init__(
        self,
        trajectory: tuple[Chunks, Frames],
        local_instances: tuple[LocalInstances, Supports],
        instances: tuple[Instances, Observations],
    ) -> None:
        self._chunks, self._frames = trajectory
        self._local_instances, self._supports = local_instances
        self._instances, self._observations = instances

    def of(self, instance_id: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where a moving instance was: seconds (V,) and places in the world (V, 3), in order of time.

        Frames that two chunks saw count once, at the mean of what they say. In frames in which it stood still for a
        whole chunk the middle of its surface is its place. Nothing for an instance that was never seen moving.
        """
        _, times_s, places = self.frames(instance_id)
        return times_s, places

    def frames(self, instance_id: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return `of` with the frames it comes from: (session id, Frame.index) (V, 2), seconds (V,), places (V, 3)."""
        instance = self._instances.get(instance_id)
        empty = np.zeros((0, 2), np.int64), np.zeros(0), np.zeros((0, 3))
        if not instance.dynamic:
            return empty
        seen = self._seen(instance.id)
        times = {(f.session_id, f.frame_index): f.time_s for f in self._frames.all()}
        keys = [k for k in sorted(seen) if k in times]
        if not keys:
            return empty
        places = np.array([np.mean(seen[k], axis=0) for k in keys])
        return np.array(keys, np.int64), np.array([times[k] for k in keys]), places

    def _seen(self, instance_id: int) -> dict[tuple[int, int], list[NDArray[np.float64]]]:
        """By (session id, Frame.index), where chunks saw it; those that saw it move before those that did not."""
        moving: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
        still: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
        for o in self._observations.of(instance_id):
            chunk, motion = self._chunks.get(o.chunk_id), self._local_instances.motion_track(o.chunk_id, o.local_id)
            if motion is not None and len(motion.frames):
                frames, places, found = motion.frames, chunk.S_world_chunk.apply(motion.positions), moving
            else:
                frames = self._local_instances.mask_track(o.chunk_id, o.local_id).frames
                places, found = np.tile(self._middle(o, chunk.S_world_chunk), (len(frames), 1)), still
            for frame, place in zip(frames.tolist(), places, strict=True):
                found.setdefault((chunk.session_id, frame), []).append(place)
        return {**still, **moving}

    def _middle(self, observation: Observation, S_world_chunk: Sim3) -> NDArray[np.float64]:
        """Middle of the surface of one local instance, world. Shape (3,)."""
        support = self._supports.get(observation.chunk_id, observation.local_id)
        if support is None or len(support.points) == 0:
            return np.full(3, np.nan)
        return np.asarray(np.quantile(S_world_chunk.apply(support.points), [0.02, 0.98], axis=0).mean(axis=0))
