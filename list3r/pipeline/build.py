"""From a video to a memory: the page that reads like the paper's method, and the only writer of memories.

frames -> chunks -> reconstruction + local instance library        (any process, side by side; `chunk`)
       -> edges -> graph -> up -> global instance library -> store (in order, one transaction each; `mapping`)
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

from threadpoolctl import threadpool_limits

from list3r import __version__
from list3r.frames.base import SourceInfo
from list3r.frames.source import SourceOptions
from list3r.memory.core.address_space import BUILD_MB, check_address_space
from list3r.memory.core.records import ChunkResult
from list3r.memory.store.store import Store
from list3r.pipeline.finishing import finish
from list3r.pipeline.mapping import finish_session
from list3r.pipeline.reports import BuildReport, build_report
from list3r.pipeline.request import BuildRequest, RunOptions, Watch
from list3r.pipeline.session import Before, Job, add_chunks, check_posed, chunk_pool, plan_session, prepare
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.target import Target, make_folder, open_target
from list3r.reconstruction.registry import entry


def build(
    source: str | Path,
    memory: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | BuildRequest | None = None,
    run: RunOptions | None = None,
    watch: Watch | None = None,
) -> BuildReport:
    """Build the memory of one video; see `list3r.build` for the arguments. `watch` hears of the work as it goes on.

    Raises `SourceError`, `MemoryFileError`, `OptionError`, `TrackingError`; then nothing half-written is left, except a
    memory in which cameras are placed, which `resume` goes on with. `FinishingError` where the memory is built and only
    its scale or its names are not.
    """
    check_address_space(BUILD_MB, "a build")
    started = time.monotonic()
    run, watch, memory = run or RunOptions(), watch or Watch(), Path(memory)
    job = prepare(source, options, settings, run, Before(memory), watch)
    watch.tell((*job.info.notes, *job.notes))
    if watch.debug_dir is not None:
        make_folder(watch.debug_dir)
    with open_target(memory, job.info, job.settings, resume=run.resume, force=run.force) as target:
        session = _session(target.store, job)
        with chunk_pool(job) as pool:
            plan = plan_session(target.store, session, job, watch, pool)
            add_chunks(target.store, job, plan, pool, watch, partial(_keep, target))
        check_posed(target.store, plan.session, job.info)
        with threadpool_limits(1):
            finish_session(target.store, session, job.settings.association, job.settings.carving)
        report = build_report(target.store, plan, started)
    return finish(report, memory, source, job.options, run, watch)


def _keep(target: Target, part: ChunkResult) -> None:
    """Keep the memory, whatever happens, once the camera is placed somewhere."""
    if part.posed.any():
        target.keep()


def _session(store: Store, job: Job) -> int:
    """The session to write to: a new one, or the one that a build before left unfinished."""
    sessions = store.sessions.all()
    if sessions:
        return sessions[0].session_id
    return begin_session(store, job)


def begin_session(store: Store, job: Job) -> int:
    """Write down what a new memory is of and begin its first session; its number."""
    info, settings = job.info, job.settings
    where = info.path if "://" in info.path else str(Path(info.path).resolve())
    with store.transaction():
        store.facts.created_by = f"list3r {__version__}"
        store.facts.scale_kind = _scale_kind(info, settings)
        store.facts.scale_source = _scale_source(info, settings)
        store.facts.gravity = "unknown"
        store.facts.poses = settings.poses
        return store.sessions.add(where, info.fingerprint, settings.as_plain(), info.frame_count)


def _scale_kind(info: SourceInfo, settings: BuildSettings) -> str:
    """Whether a unit is a metre; sensor depth says nothing where the model does not look at it."""
    source = _scale_source(info, settings)
    if source == "given poses":
        return "metric" if info.poses_metric else "relative"
    return "relative" if source == "none" else "metric"


def _scale_source(info: SourceInfo, settings: BuildSettings) -> str:
    """Who says how long a unit is, as far as the source and the settings do."""
    if info.has_depth and entry(settings.reconstruction).needs_depth:
        return "sensor depth"
    return "given poses" if settings.poses == "given" else "none"
