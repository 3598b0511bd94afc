"""Cameras that questions look from: of a frame, of a moment, or at a pose."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Sim3, rotation_from_quat_wxyz
from list3r.memory.core.records import ChunkRow, FrameRow
from list3r.memory.store.store import Store
from list3r.queries.match import checked_point


@dataclass(frozen=True)
class PosedCamera:
    """A camera with its pose: one that took a frame, or one that could."""

    T_world_cam: NDArray[np.float64]
    """Rigid, OpenCV axes: x right, y down, z forward; lengths in world units. Shape (4, 4)."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy, px."""
    image_size: tuple[int, int]
    """(height, width), px."""
    component: int
    """The part of the memory that it sees."""
    session_id: int
    frame: FrameRow | None = None
    """The frame that it took; None for a camera that never stood there."""

    @property
    def place(self) -> NDArray[np.float64]:
        """Its centre, world. Shape (3,)."""
        return self.T_world_cam[:3, 3]

    @property
    def up(self) -> NDArray[np.float64]:
        """What is up in its picture, world. Shape (3,)."""
        return -self.T_world_cam[:3, 1]


def camera_of_frame(store: Store, frame: int, session: int | None = None) -> PosedCamera:
    """Return the camera of a posed frame, of the first session that has it unless one is named.

    Raises `OptionError` for a frame that is not there or has no pose, with the nearest one that has.
    """
    rows = _posed(store, session)
    found = [f for f in rows if f.frame_index == frame]
    if not found:
        near = min(rows, key=lambda f: abs(f.frame_index - frame), default=None)
        hint = "no frame has one" if near is None else f"the nearest that has one is {near.frame_index}"
        raise OptionError(f"frame {frame} has no pose in {store.path}; {hint}")
    return _camera(store, found[0])


def cameras_of_frames(store: Store, frames: Container[tuple[int, int]]) -> list[PosedCamera]:
    """Return the cameras of those of some frames (session id, Frame.index) that have a pose, in their order."""
    chunks = {c.chunk_id: c for c in store.chunks.all()}
    rows = (f for f in store.frames.all() if f.state == "posed" and (f.session_id, f.frame_index) in frames)
    return [_camera_in(chunks[f.chunk_id], f) for f in rows if f.chunk_id in chunks]


def camera_at_time(store: Store, time_s: float, session: int | None = None) -> PosedCamera:
    """Return the camera of the posed frame nearest to a time, seconds of the source's clock. Raises `OptionError`."""
    if not np.isfinite(time_s):
        raise OptionError(f"time {time_s} must be a finite number of seconds")
    rows = _posed(store, session)
    if not rows:
        raise OptionError(f"{store.path} has no frame with a pose")
    return _camera(store, min(rows, key=lambda f: (abs(f.time_s - time_s), f.session_id, f.frame_index)))


def camera_at_pose(
    store: Store,
    position: ArrayLike,
    quat_wxyz: ArrayLike,
    session: int | None = None,
) -> PosedCamera:
    """Return the camera of a session, put at a position of the world and turned by R_world_cam (OpenCV axes).

    Raises `OptionError` for a pose that is none and for a memory that has no camera.
    """
    place = checked_point(position, "position")
    try:
        quat = np.asarray(quat_wxyz, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"quat must be four numbers w, x, y, z, not {quat_wxyz!r}") from error
    if quat.shape != (4,) or not np.isfinite(quat).all() or not 1e-9 < np.abs(quat).max() < 1e9:
        raise OptionError(f"quat must be four finite numbers w, x, y, z, not all zero, not {str(quat.tolist())[:80]}")
    if session is not None:
        store.sessions.check(session)
    chunks = store.chunks.all(session)
    if not chunks:
        raise OptionError(f"{store.path} has no camera yet; give it a video first")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_quat_wxyz(quat), place
    c = chunks[0]
    return PosedCamera(pose, c.intrinsics, c.image_size, c.component, c.session_id)


def last_camera(store: Store, session: int | None = None) -> PosedCamera:
    """Return where the camera was last. Raises `OptionError` when no frame has a pose."""
    rows = _posed(store, session)
    if not rows:
        raise OptionError(f"{store.path} has no frame with a pose to look from")
    return _camera(store, rows[-1])


def _posed(store: Store, session: int | None) -> list[FrameRow]:
    """Return the posed frames of a session, or of all. Raises `OptionError` for a session that there is not."""
    if session is not None:
        store.sessions.check(session)
    return [f for f in store.frames.all(session) if f.state == "posed"]


def _camera(store: Store, frame: FrameRow) -> PosedCamera:
    return _camera_in(store.chunks.get(frame.chunk_id), frame)


def _camera_in(chunk: ChunkRow, frame: FrameRow) -> PosedCamera:
    S_world_cam = chunk.S_world_chunk @ Sim3.from_matrix(frame.T_chunk_cam)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = S_world_cam.rotation, S_world_cam.translation
    return PosedCamera(pose, chunk.intrinsics, chunk.image_size, chunk.component, frame.session_id, frame)
