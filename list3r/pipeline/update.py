"""One more video for a memory: placed against what is stored, merged, and what has changed is written down.

The chunks come in as in a build, one transaction each; until the last one is in, readers see the library as it was.
Then all chunks are placed once more and the library is derived from both sessions, with its events.
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

from threadpoolctl import threadpool_limits

from list3r.frames.source import SourceOptions
from list3r.memory.core.address_space import BUILD_MB, check_address_space
from list3r.memory.core.errors import MemoryFileError, OptionError
from list3r.memory.store.store import Store
from list3r.pipeline.finishing import finish
from list3r.pipeline.mapping import finish_session
from list3r.pipeline.reports import UpdateReport, update_report
from list3r.pipeline.request import BuildRequest, RunOptions, Watch
from list3r.pipeline.session import (
    Before,
    Job,
    Plan,
    add_chunks,
    check_posed,
    chunk_pool,
    plan_session,
    prepare,
    take_back,
)
from list3r.pipeline.settings import BuildSettings


def update(
    memory: str | Path,
    source: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | BuildRequest | None = None,
    run: RunOptions | None = None,
    watch: Watch | None = None,
) -> UpdateReport:
    """Add one more video to an existing memory; see `list3r.update` for the arguments.

    Raises `SourceError`, `MemoryFileError`, `OptionError`, `TrackingError`. When it fails or is interrupted, the memory
    keeps the library as it was and the chunks that were finished, if a camera was placed in any; `resume` goes on with
    them, `force` gives up what an interrupted update left, of this video or another. `FinishingError` where the video
    is in the memory and only the scale or names are not.
    """
    check_address_space(BUILD_MB, "a build")
    started = time.monotonic()
    run, watch, memory = run or RunOptions(), watch or Watch(), Path(memory)
    job = prepare(source, options, settings, run, Before(memory, update=True), watch)
    watch.tell(job.notes)
    with Store.open(memory, writable=True) as store:
        session = _session(store, job)
        plan = _added(store, session, job, watch)
        report = update_report(store, plan, started)
    return finish(report, memory, source, job.options, run, watch)


def _added(store: Store, session: int, job: Job, watch: Watch) -> Plan:
    """Add the chunks of a session and derive the library, unless that was all done when an update was interrupted."""
    if any(s.session_id == session and s.state == "complete" for s in store.sessions.all()):
        return plan_session(store, session, job, watch)
    try:
        with chunk_pool(job) as pool:
            plan = plan_session(store, session, job, watch, pool)
            add_chunks(store, job, plan, pool, watch)
        check_posed(store, session, job.info, "the memory is as it was")
    except BaseException:
        with suppress(MemoryFileError):  # the first error is reported; the next update takes it back
            if not _begun(store, session):
                take_back(store, session)
        raise
    with threadpool_limits(1):
        finish_session(store, session, job.settings.association, job.settings.carving)
    return plan


def _begun(store: Store, session: int) -> bool:
    """Whether the camera of any frame of a session is placed."""
    return any(f.state == "posed" for f in store.frames.all(session))


def _session(store: Store, job: Job) -> int:
    """The session to write to. Raises `OptionError` where this video cannot come next."""
    info, resume, force = job.info, job.run.resume, job.run.force
    sessions = store.sessions.all()
    for s in sessions[1:]:
        if s.state != "complete" and ((force and not resume) or not _begun(store, s.session_id)):
            take_back(store, s.session_id)
    sessions = store.sessions.all()
    path = str(Path(info.path).resolve())
    if not sessions or not store.chunks.all(sessions[0].session_id):
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
        return store.sessions.add(path, info.fingerprint, job.settings.as_plain(), info.frame_count)
