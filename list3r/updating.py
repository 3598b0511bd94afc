"""One more video for a memory: placed against what is stored, merged, and what has changed is written down.

The chunks come in as in a build, one transaction each; until the last one is in, readers see the library as it was.
Then all chunks are placed once more and the library is derived from both sessions, with its events.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

from threadpoolctl import threadpool_limits

from list3r.association.joint_rgbd import RgbdJointReconstructor
from list3r.association.session_ties import HELD
from list3r.calibration_stage import with_camera
from list3r.chunk_stage import BuildSettings, ChunkTask, joint_model, process_parts
from list3r.frames.base import SourceInfo
from list3r.frames.chunks import ChunkSpan, plan_chunks
from list3r.frames.cuts import find_cuts
from list3r.frames.source import SourceOptions, check_bad_share, open_source
from list3r.mapping import add_chunk, finish_session
from list3r.memory.errors import OptionError
from list3r.memory.records import Edge
from list3r.memory.store import Store
from list3r.pipeline import Progress, check_buildable, resolve_settings, usual_workers, with_weights
from list3r.workers import OrderedPool


@dataclass(frozen=True)
class UpdateReport:
    """What an update did."""

    session: int
    """Number of the new session."""
    frames: int
    posed: int
    lost: int
    bad: int
    chunks: int
    placed: int
    """Chunks of the session that lie in the world of an earlier one."""
    ties: int
    """Accepted relations between chunks of this session and of earlier ones."""
    components: int
    instances: int
    events: dict[str, int]
    """How many things were seen_again, moved, removed and added."""
    seconds: float
    frames_per_second: float
    resumed_chunks: int
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def update(
    memory: str | Path,
    source: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | None = None,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    scan: Progress | None = None,
) -> UpdateReport:
    """Add one more video to an existing memory.

    Raises `SourceError`, `MemoryFileError`, `OptionError`. When it is interrupted, the memory keeps the library as it
    was and the chunks that were finished, which `resume` goes on with.
    """
    started = time.monotonic()
    options = options or SourceOptions()
    info = open_source(source, options).info
    settings = resolve_settings(settings or BuildSettings(poses="auto"), info)
    check_buildable(info, settings)
    settings = with_weights(settings)
    if workers is not None and workers < 1:
        raise OptionError(f"--workers {workers}: at least 1 process is needed")
    with Store.open(memory, writable=True) as store:
        session = _session(store, info, settings, resume=resume)
        spans = plan_chunks(info.frame_count, settings.chunks, _cuts(store, session, source, options, settings, scan))
        done = {c.index for c in store.chunks(session)}
        found = with_camera(store, session, source, options, settings.reconstruction, info)
        tasks = [ChunkTask(str(source), found, span, settings) for span in spans if span.index not in done]
        with threadpool_limits(1):
            if tasks:
                _add_all(store, session, tasks, min(workers or usual_workers(settings), len(tasks)), info, progress)
            finish_session(store, session)
        return _report(store, session, info, spans, done, started)


def _session(store: Store, info: SourceInfo, settings: BuildSettings, *, resume: bool) -> int:
    """The session to write to. Raises `OptionError` where this video cannot come next."""
    sessions = store.sessions()
    path = str(Path(info.path).resolve())
    if not sessions or not store.chunks(sessions[0].session_id):
        raise OptionError(f"{store.path} holds no video yet; make it with `list3r build {info.path} -m {store.path}`")
    for s in sessions:
        if s.state == "complete" and s.fingerprint == info.fingerprint:
            raise OptionError(f"{info.path} is in {store.path} already, as session {s.session_id}")
    begun = [s for s in sessions if s.state != "complete"]
    if begun and begun[0].session_id == sessions[0].session_id:
        raise OptionError(
            f"the build of {store.path} was interrupted; finish it first: "
            f"list3r build {begun[0].source} -m {store.path} --resume"
        )
    if begun and (begun[0].fingerprint != info.fingerprint or not resume):
        raise OptionError(
            f"an update of {store.path} was interrupted; finish it first: "
            f"list3r update {store.path} {begun[0].source} --resume"
        )
    if begun:
        return begun[0].session_id
    with store.transaction():
        return store.add_session(path, info.fingerprint, asdict(settings), info.frame_count)


def _cuts(
    store: Store,
    session: int,
    source: str | Path,
    options: SourceOptions,
    settings: BuildSettings,
    scan: Progress | None,
) -> tuple[int, ...]:
    """Where the video jumps, found once; given poses know where the camera is on either side."""
    if settings.poses == "given":
        return ()
    name = f"cuts {session}"
    known = store.get_value(name)
    if known is None:
        known = list(find_cuts(open_source(source, options), progress=scan))
        with store.transaction():
            store.set_value(name, known)
    return tuple(known)


def _add_all(
    store: Store, session: int, tasks: Sequence[ChunkTask], workers: int, info: SourceInfo, progress: Progress | None
) -> None:
    """Place the chunks in order; the library waits for the last one."""
    joint = RgbdJointReconstructor(store, {session: tasks[0].options}, joint_model(tasks[0]))
    bad = {index for s, index, _ in store.bad_frames() if s == session}
    if progress is not None:
        progress(len(store.frames(session)), info.frame_count)
    known = {c.index for c in store.chunks(session)}
    pool = OrderedPool(process_parts, workers)
    try:
        for task, results in zip(tasks, pool.map(tasks), strict=True):
            bad.update(index for part in results for index, _ in part.bad_frames)
            check_bad_share(len(bad), info.frame_count)
            for part in results:
                if part.index not in known:
                    add_chunk(store, session, part, joint, library=False)
            if progress is not None:
                progress(task.span.stop, info.frame_count)
    finally:
        pool.stop()


def ties(store: Store, session: int) -> list[Edge]:
    """The accepted relations between chunks of a session and chunks of the sessions before it."""
    owner = {c.chunk_id: c.session_id for c in store.chunks()}
    return [e for e in store.edges() if e.accepted and owner[e.u] < owner[e.v] == session]


def held(store: Store, session: int) -> int:
    """How many relations of a session to earlier ones are held back, see `association.session_ties`."""
    owner = {c.chunk_id: c.session_id for c in store.chunks()}
    return sum(HELD in e.scores and owner[e.u] < owner[e.v] == session for e in store.edges())


def _report(
    store: Store, session: int, info: SourceInfo, spans: Sequence[ChunkSpan], done: set[int], started: float
) -> UpdateReport:
    frames = store.frames(session)
    rows = store.chunks()
    own = [c for c in rows if c.session_id == session]
    known = {c.component for c in rows if c.session_id < session}
    placed = sum(c.component in known for c in own)
    lost, bad = (sum(f.state == state for f in frames) for state in ("lost", "bad"))
    events = [e.kind for e in store.events(session)]
    seconds = time.monotonic() - started
    fresh = sum(s.stop - s.start for s in spans if s.index not in done)
    fresh -= sum(max(0, a.stop - b.start) for a, b in pairwise(spans) if b.index not in done)
    tied = ties(store, session)
    return UpdateReport(
        session=session,
        frames=len(frames),
        posed=sum(f.state == "posed" for f in frames),
        lost=lost,
        bad=bad,
        chunks=len(own),
        placed=placed,
        ties=len(tied),
        components=len({c.component for c in rows}),
        instances=len(store.instances(structure=False)),
        events={kind: events.count(kind) for kind in ("seen_again", "moved", "removed", "added")},
        seconds=round(seconds, 2),
        frames_per_second=round(max(0, fresh) / seconds, 2),
        resumed_chunks=len(done),
        notes=_notes(info, len(own), placed, held(store, session), lost, len(frames)),
    )


def _notes(info: SourceInfo, chunks: int, placed: int, held: int, lost: int, frames: int) -> tuple[str, ...]:
    notes = []
    if lost == frames:
        notes.append(f"the camera could not be followed in any frame of {info.path}; the library is as it was")
    elif placed == 0:
        notes.append(
            "no place in this video was recognised: it is kept apart, in a frame of its own, and is joined "
            "when a later session connects the two"
            if not held
            else "a place in this video seems known, but no second relation agrees on how the two worlds lie: it "
            "is kept apart until another does, or a later session connects the two"
        )
    elif placed < chunks:
        notes.append(f"{chunks - placed} of {chunks} chunks could not be placed; they are kept apart")
    if 0 < lost < frames:
        notes.append(f"the camera could not be followed in {lost} of {frames} frames; they have no pose")
    return tuple(notes)
