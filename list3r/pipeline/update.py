"""One more video for a memory: placed against what is stored, merged, and what has changed is written down.

The chunks come in as in a build, one transaction each; until the last one is in, readers see the library as it was.
Then all chunks are placed once more and the library is derived from both sessions, with its events.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from list3r.association.revisits.session_ties import HELD
from list3r.frames.base import SourceInfo
from list3r.frames.source import SourceOptions
from list3r.memory.errors import MemoryFileError, OptionError, TrackingError
from list3r.memory.records import Edge
from list3r.memory.store.store import Store
from list3r.models.licences import DEFAULT_PROFILE
from list3r.pipeline.mapping import finish_session
from list3r.pipeline.session import (
    Look,
    Plan,
    Progress,
    add_chunks,
    lost_reasons,
    plan_session,
    prepare,
    settled_notes,
    take_back,
)
from list3r.pipeline.settings import BuildSettings


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
    force: bool = False,
    licence: str = DEFAULT_PROFILE,
    progress: Progress | None = None,
    look: Look | None = None,
) -> UpdateReport:
    """Add one more video to an existing memory.

    Raises `SourceError`, `MemoryFileError`, `OptionError`, `TrackingError`. When it fails or is interrupted, the memory
    keeps the library as it was and the chunks that were finished, if a camera was placed in any; `resume` goes on with
    them, `force` gives up what an interrupted update left, of this video or another.
    """
    started = time.monotonic()
    job = prepare(source, options, settings, workers, licence)
    with Store.open(memory, writable=True) as store:
        session = _session(store, job.info, job.settings, resume=resume, force=force)
        if _complete(store, session):
            return _report(store, job.info, plan_session(store, session, job, look), started)
        try:
            plan = plan_session(store, session, job, look)
            add_chunks(store, job, plan, progress, library=False)
            _check_posed(store, session, job.info)
        except BaseException:
            with suppress(MemoryFileError):  # what was wrong first is told; the next update takes it back
                if not _begun(store, session):
                    take_back(store, session)
            raise
        with threadpool_limits(1):
            finish_session(store, session, job.settings.association, job.settings.carving)
        return _report(store, job.info, plan, started)


def _begun(store: Store, session: int) -> bool:
    """Whether the camera of any frame of a session is placed."""
    return any(f.state == "posed" for f in store.frames(session))


def _complete(store: Store, session: int) -> bool:
    return any(s.session_id == session and s.state == "complete" for s in store.sessions())


def _check_posed(store: Store, session: int, info: SourceInfo) -> None:
    if not _begun(store, session):
        why = lost_reasons(store, session)
        reasons = "; ".join(("the memory is as it was", *why[:1]))
        raise TrackingError(f"the camera could not be followed in any frame of {info.path}; {reasons}")


def _session(store: Store, info: SourceInfo, settings: BuildSettings, *, resume: bool, force: bool) -> int:
    """The session to write to. Raises `OptionError` where this video cannot come next."""
    sessions = store.sessions()
    for s in sessions[1:]:
        if s.state != "complete" and ((force and not resume) or not _begun(store, s.session_id)):
            take_back(store, s.session_id)
    sessions = store.sessions()
    path = str(Path(info.path).resolve())
    if not sessions or not store.chunks(sessions[0].session_id):
        raise OptionError(f"{store.path} holds no video yet; make it with `list3r build {info.path} -m {store.path}`")
    for s in sessions:
        if s.state == "complete" and s.fingerprint == info.fingerprint:
            if resume and s is sessions[-1] and len(sessions) > 1:
                return s.session_id  # it was interrupted when all was done
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
            f"list3r update {store.path} {begun[0].source} --resume, or give it up with --force"
        )
    if begun:
        return begun[0].session_id
    with store.transaction():
        return store.add_session(path, info.fingerprint, settings.as_plain(), info.frame_count)


def ties(store: Store, session: int) -> list[Edge]:
    """The accepted relations between chunks of a session and chunks of the sessions before it."""
    owner = {c.chunk_id: c.session_id for c in store.chunks()}
    return [e for e in store.edges() if e.accepted and owner[e.u] < owner[e.v] == session]


def held(store: Store, session: int) -> int:
    """How many relations of a session to earlier ones are held back, see `association.session_ties`."""
    owner = {c.chunk_id: c.session_id for c in store.chunks()}
    return sum(HELD in e.scores and owner[e.u] < owner[e.v] == session for e in store.edges())


def _report(store: Store, info: SourceInfo, plan: Plan, started: float) -> UpdateReport:
    session = plan.session
    frames = store.frames(session)
    rows = store.chunks()
    own = [c for c in rows if c.session_id == session]
    known = {c.component for c in rows if c.session_id < session}
    placed = sum(c.component in known for c in own)
    lost, bad = (sum(f.state == state for f in frames) for state in ("lost", "bad"))
    events = [e.kind for e in store.events(session)]
    seconds = time.monotonic() - started
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
        frames_per_second=round(plan.fresh_frames() / seconds, 2),
        resumed_chunks=len(plan.done),
        notes=(
            *settled_notes(store, session),
            *_notes(info, len(own), placed, held(store, session), lost, len(frames)),
            *lost_reasons(store, session),
        ),
    )


def _notes(info: SourceInfo, chunks: int, placed: int, held: int, lost: int, frames: int) -> tuple[str, ...]:
    notes = []
    if placed == 0:
        notes.append(
            "no place in this video was recognised: it is kept apart, in a frame of its own, and is joined "
            "when a later session connects the two"
            if not held
            else "a place in this video seems known, but no second relation agrees on how the two worlds lie: it "
            "is kept apart until another does, or a later session connects the two"
        )
    elif placed < chunks:
        notes.append(f"{chunks - placed} of {chunks} chunks could not be placed; they are kept apart")
    if lost:
        notes.append(f"the camera could not be followed in {lost} of {frames} frames; they have no pose")
    return tuple(notes)
