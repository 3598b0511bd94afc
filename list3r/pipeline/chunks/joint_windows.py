"""Joint windows of frames of two places, made in the processes that make the chunks.

A network is so loaded once, and its windows and its chunks do not ask a GPU for memory at the same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, TypeAlias

from list3r.association.revisits.joint_source import JointSourceReconstructor
from list3r.association.revisits.joint_window import JointReconstructor
from list3r.memory.core.records import ChunkResult, JointWindow
from list3r.memory.store.store import Store
from list3r.models.cards import find_card
from list3r.pipeline.chunks.chunk import ChunkTask, joint_model
from list3r.pipeline.workers import OrderedPool

if TYPE_CHECKING:
    from list3r.pipeline.workers.ray_pool import RayPool

Results: TypeAlias = tuple[ChunkResult, ...]
ChunkPool: TypeAlias = "OrderedPool[ChunkTask, Results] | RayPool[ChunkTask, Results]"


@dataclass(frozen=True)
class WindowTask:
    """What is needed to make one joint window."""

    chunk: ChunkTask
    """A chunk of the session under way: how its source is read and which model reconstructs it."""
    session: int
    """That session."""
    sources: tuple[tuple[int, str], ...]
    """(session, source) of all sessions."""
    u: tuple[int, tuple[int, ...]]
    """Session and frames (Frame.index) of one place."""
    v: tuple[int, tuple[int, ...]]
    """The same of the other."""


def joint_windows(store: Store, session: int, chunk: ChunkTask, pool: ChunkPool) -> JointReconstructor:
    """What makes joint windows for a session: here, or where its chunks are made if that takes a network."""
    if find_card(chunk.settings.reconstruction, "geometry") is None:
        return JointSourceReconstructor(_paths(store), {session: chunk.options}, joint_model(chunk))

    def ask(u_session: int, u_frames: Sequence[int], v_session: int, v_frames: Sequence[int]) -> JointWindow | None:
        sources = tuple(_paths(store).items())
        places = (u_session, tuple(u_frames)), (v_session, tuple(v_frames))
        return pool.ask(make_window, WindowTask(chunk, session, sources, *places))

    return ask


def make_window(task: WindowTask) -> JointWindow | None:
    """The window, None where its two sides cannot be related. Raises `SourceError`."""
    (u_session, u_frames), (v_session, v_frames) = task.u, task.v
    return _reconstructor(task.chunk, task.session, task.sources)(u_session, u_frames, v_session, v_frames)


@lru_cache(maxsize=1)
def _reconstructor(chunk: ChunkTask, session: int, sources: tuple[tuple[int, str], ...]) -> JointSourceReconstructor:
    return JointSourceReconstructor(dict(sources), {session: chunk.options}, joint_model(chunk))


def _paths(store: Store) -> dict[int, str]:
    """Where the sources of the sessions are."""
    return {s.session_id: s.source for s in store.sessions.all()}
