"""A memory of a source that still grows: chunks are added as their frames come, and readers see each at once.

stream -> folder of pictures (a thread; what cannot wait is dropped) -> chunks in order -> the same steps as in a build
"""

from __future__ import annotations

import shutil
import signal
import statistics
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from list3r.frames.base import SourceInfo
from list3r.frames.chunking.chunks import ChunkSettings, ChunkSpan, plan_chunks
from list3r.frames.live.addresses import is_stream, without_secrets
from list3r.frames.live.feed import Feed, FeedState, LiveSettings
from list3r.frames.live.growing import FolderFeed
from list3r.frames.live.spooled import StreamFeed
from list3r.frames.live.stream import open_camera
from list3r.frames.options import SourceOptions
from list3r.frames.readers.rosbag import is_recording
from list3r.memory.core.errors import MemoryFileError, OptionError, SourceError
from list3r.memory.store.store import Store
from list3r.pipeline.build import begin_session, build
from list3r.pipeline.chunks.calibration import estimated_camera, with_camera
from list3r.pipeline.chunks.chunk import ChunkTask, process_parts
from list3r.pipeline.finishing import finish
from list3r.pipeline.mapping import add_chunk, finish_session
from list3r.pipeline.reports import BuildReport, LiveReport, build_report
from list3r.pipeline.request import BuildRequest, RunOptions, Watch
from list3r.pipeline.session import Before, Job, Plan, check_posed, note_lost, prepare, settled_step
from list3r.pipeline.settings import BuildSettings
from list3r.pipeline.target import Target, open_target
from list3r.pipeline.workers import OrderedPool

_FIRST_FRAMES = 2
"""Frames by which it is known what comes."""


@dataclass
class LiveSession:
    """The chunks of a live source, as far as they are known."""

    store: Store
    session: int
    job: Job
    feed: Feed
    options: SourceOptions
    step: int
    done: int = 0
    """Chunks that are in the memory."""
    stop: int = 0
    """Position up to which they reach."""
    latencies_s: tuple[float, ...] = ()

    def next_span(self, state: FeedState) -> ChunkSpan | None:
        """Return the next chunk of which all frames are there."""
        spans = ready_spans(state, self.job.settings.chunks.times(self.step))
        return spans[self.done] if self.done < len(spans) else None

    def add(self, span: ChunkSpan, pool: OrderedPool[ChunkTask, object], target: Target) -> None:
        """Work on a chunk and add it to the memory."""
        options = replace(self.options, start=span.start, stop=span.stop)
        here = ChunkSpan(span.index, 0, span.stop - span.start)
        task = ChunkTask(str(self.feed.folder), options, here, self.job.settings, depth_every=self.step)
        for part in pool.ask(process_parts, task):
            add_chunk(self.store, self.session, part, None, self.job.settings.association)
            note_lost(self.store, self.session, part)
            if part.posed.any():
                target.keep()
        self.done, self.stop = self.done + 1, max(self.stop, span.stop)
        late_s = time.monotonic() - self.feed.arrived_s(span.stop - 1)
        self.latencies_s = (*self.latencies_s, round(late_s, 2))


def build_any(
    source: str | Path,
    memory: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | BuildRequest | None = None,
    run: RunOptions | None = None,
    watch: Watch | None = None,
) -> BuildReport:
    """Build the memory of a source, live where it is; see `build` and `build_live`."""
    work = build_live if is_live(source, run or RunOptions()) else build
    return work(source, memory, options=options, settings=settings, run=run, watch=watch)


def is_live(source: str | Path, run: RunOptions) -> bool:
    """Return whether a source is followed while it grows."""
    return run.live or is_stream(str(source))


def ready_spans(state: FeedState, settings: ChunkSettings) -> list[ChunkSpan]:
    """Return the chunks that later frames no longer change, in order; those that wait come later, too."""
    spans = plan_chunks(state.count, settings, state.cuts)
    if (state.ended and not state.waiting) or not spans:
        return spans
    last_shot = max((c for c in state.cuts if c < state.count), default=0)
    return [s for s in spans if s.start < last_shot or s.stop - s.start == settings.length]


def build_live(
    source: str | Path,
    memory: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | BuildRequest | None = None,
    run: RunOptions | None = None,
    watch: Watch | None = None,
    live: LiveSettings | None = None,
) -> BuildReport:
    """Build the memory of a webcam, a stream or a growing folder until it ends or Ctrl-C ends it.

    Ctrl-C lets the chunk that is worked on be finished and leaves out what waits; a second one stops at once. Raises
    as `build` does.
    """
    started, run, watch, memory = time.monotonic(), run or RunOptions(), watch or Watch(), Path(memory)
    options, how = options or SourceOptions(), live or LiveSettings()
    if options.more:
        raise OptionError("a live source is one source; only recordings can be several files")
    if run.engine != "local":
        raise OptionError("a live source is processed on this machine as it comes; leave out --engine")
    if run.resume:
        raise OptionError("a live source cannot be resumed; `list3r update` adds a later session")
    if not run.force and memory.is_file() and memory.stat().st_size:
        raise MemoryFileError(f"{memory} already exists; --force replaces it")
    spool = memory.with_name(f"{memory.name}.frames")
    with _until_interrupted() as interrupted, _feed(str(source), spool, options, how, watch) as feed:
        first = replace(options, fps=None) if feed.folder == spool else options
        _await(feed, _FIRST_FRAMES, how, interrupted, source)
        job = _job(feed, first, settings, run, memory, str(source))
        watch.tell((*job.info.notes, *job.notes))
        _await(feed, job.settings.chunks.length, how, interrupted, source)
        with open_target(memory, job.info, job.settings, resume=False, force=run.force) as target:
            ours = _begun(target.store, feed, job, first, watch)
            _follow(ours, target, how, interrupted, watch)
            store, state = target.store, feed.state()
            check_posed(store, ours.session, job.info)
            with threadpool_limits(1):
                finish_session(store, ours.session, job.settings.association, job.settings.carving)
            with store.transaction():
                store.sessions.put(replace(store.sessions.get(ours.session), frame_count=state.count))
            report = _report(ours, state, started)
    return finish(report, memory, feed.folder, first, replace(run, detector=None, names="none"), watch)


@contextmanager
def _until_interrupted() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second one is raised."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    before = signal.getsignal(signal.SIGINT)

    def interrupted(number: int, frame: object) -> None:
        event.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, interrupted)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _feed(source: str, spool: Path, options: SourceOptions, how: LiveSettings, watch: Watch) -> Iterator[Feed]:
    """The feed of a source; pictures of a stream are removed when it is over."""
    if not is_stream(source):
        folder = Path(source).expanduser()
        if not folder.is_dir() and not is_recording(folder):
            raise SourceError(
                f"{folder} is not a folder; --live follows a folder or a bag that grows, or the address of a stream"
            )
        yield FolderFeed(folder, options, how)
        return
    if spool.exists():
        raise OptionError(f"{spool} is left from an earlier stream; it is a folder of images: keep or remove it")
    if not spool.parent.is_dir():
        raise MemoryFileError(f"the folder {spool.parent} does not exist; create it first")
    camera = open_camera(source, lambda line: watch.tell((line,)))
    feed = StreamFeed(camera, spool, how, options.fps, lambda line: watch.tell((line,)))
    try:
        yield feed
    finally:
        feed.close()
        shutil.rmtree(spool, ignore_errors=True)


def _await(feed: Feed, count: int, how: LiveSettings, interrupted: threading.Event, source: str | Path) -> None:
    """Wait until so many frames are there, or all that come. Raises `SourceError` where none does."""
    while True:
        feed.admit()
        state = feed.state()
        if state.count >= count or (state.ended and state.count):
            return
        if state.ended or interrupted.is_set():
            if state.count:
                return
            raise SourceError(f"no picture came from {without_secrets(str(source))}: {state.reason or 'stopped here'}")
        time.sleep(how.poll_s)


def _job(
    feed: Feed,
    options: SourceOptions,
    settings: BuildSettings | BuildRequest | None,
    run: RunOptions,
    memory: Path,
    source: str,
) -> Job:
    job = prepare(feed.folder, options, settings, run, Before(memory))
    info: SourceInfo = replace(job.info, fingerprint=uuid.uuid4().hex, path=without_secrets(source))
    return replace(job, info=info, opened=None)


def _begun(store: Store, feed: Feed, job: Job, options: SourceOptions, watch: Watch) -> LiveSession:
    """The session, with what is settled by its first frames."""
    session = begin_session(store, job)
    begun = replace(options, start=0, stop=max(_FIRST_FRAMES, feed.state().count))
    first = replace(job, options=begun, source=feed.folder)
    step = settled_step(store, session, first, watch)
    known = with_camera(
        store, session, begun, lambda: estimated_camera(first.frames(), begun, job.settings, watch.look)
    )
    whole = replace(known, start=options.start, stop=options.stop)
    chunks = job.settings.chunks.times(step)
    feed.hold(2 * chunks.length - chunks.overlap)
    return LiveSession(store, session, job, feed, whole, step)


def _follow(ours: LiveSession, target: Target, how: LiveSettings, interrupted: threading.Event, watch: Watch) -> None:
    """Add chunks until the source ends and none is left, or until Ctrl-C."""
    with OrderedPool[ChunkTask, object](process_parts, 1) as pool, threadpool_limits(1):
        while not interrupted.is_set():
            state = ours.feed.state()
            span = ours.next_span(state)
            if span is not None:
                ours.add(span, pool, target)
                watch.show(ours.stop, state.count)
                continue
            admitted = ours.feed.admit()
            if not admitted and state.ended:
                return
            time.sleep(0.0 if admitted else how.poll_s)
    ours.feed.close()


def _report(ours: LiveSession, state: FeedState, started: float) -> BuildReport:
    spans = ready_spans(state, ours.job.settings.chunks.times(ours.step))[: ours.done]
    report = build_report(ours.store, Plan(ours.session, spans, set()), started)
    waiting = max(0, state.count + state.waiting - ours.stop)
    live = LiveReport(
        received=state.received,
        thinned=state.thinned,
        dropped=state.dropped,
        waiting=waiting,
        reconnects=state.reconnects,
        gaps=len(state.cuts),
        latency_s=statistics.median(ours.latencies_s) if ours.latencies_s else 0.0,
        most_latency_s=max(ours.latencies_s, default=0.0),
    )
    notes = [f"the source ended: {state.reason}"]
    if state.dropped:
        notes.append(f"{state.dropped} of {state.received} pictures were dropped, because the machine was too slow")
    if waiting:
        notes.append(f"{waiting} pictures were still waiting and are left out")
    if state.reconnects:
        notes.append(f"the connection was lost {state.reconnects} times")
    return replace(report, live=live, notes=(*report.notes, *notes))
