"""One task, in any process or machine: fetch, build or update, seal, publish.

The file under way is on the machine's own disk under a name of the task's key, and is the checkpoint: a task that was
killed goes on with the chunks that are in it. A published file names its tasks, so one killed after publishing is known
to be done.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from list3r.batch.sealing import batch_keys, seal
from list3r.batch.storage import Output, fetched, is_remote
from list3r.batch.tasks import BatchTask
from list3r.memory.core.errors import List3rError, MemoryFileError
from list3r.memory.store.connection import remove_memory
from list3r.memory.store.file import file_hash
from list3r.memory.store.store import Store
from list3r.pipeline.build import build
from list3r.pipeline.reports import BuildReport, UpdateReport
from list3r.pipeline.update import update


@dataclass(frozen=True)
class BatchJob:
    """A task, and where it is done."""

    task: BatchTask
    out: str
    """Folder or URL of the memories."""
    scratch: str
    """Folder on the machine's own disk."""
    siblings: tuple[str, ...] = ()
    """Keys of all tasks of the same memory."""
    workers: int = 0
    """Processes besides the one that runs the task."""
    onto: bool = False
    """Whether the video may be added to a memory that no batch made."""
    force: bool = False
    """Whether a memory of other settings or another video is replaced."""


@dataclass(frozen=True)
class Outcome:
    """How a task ended."""

    task: BatchTask
    state: str
    """done; failed, which would fail again; lost, where the process ended before the task did."""
    reason: str = ""
    built: bool = False
    """Whether this attempt did the work; a memory that was there already was not built again."""
    sha256: str = ""
    """Of the published file."""
    bytes: int = 0
    frames: int = 0
    instances: int = 0
    seconds: float = 0.0
    """Wall time of this attempt."""
    where: str = ""
    """Host and process."""


def run_task(job: BatchJob) -> Outcome:
    """Do one task; return how it ended. Never raises for errors of one video."""
    started = time.monotonic()
    where = f"{socket.gethostname()}:{os.getpid()}"
    try:
        done = _done(job)
        return replace(done, seconds=round(time.monotonic() - started, 3), where=where)
    except List3rError as error:
        reason = str(error)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
    first = reason.splitlines()[0] if reason else "no reason was given"
    return Outcome(job.task, "failed", first, seconds=round(time.monotonic() - started, 3), where=where)


def _done(job: BatchJob) -> Outcome:
    task, folder, output = job.task, Path(job.scratch) / job.task.memory, Output(job.out)
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(Path(job.scratch) / f".{task.memory}.lock"):
        work, before = folder / f"{task.key}.l3r", folder / "before.l3r"
        keys, adding = _published(job, output, before)
        if task.key in keys:
            found = Outcome(task, "done", "already there", sha256=file_hash(before), bytes=before.stat().st_size)
            shutil.rmtree(folder)
            return found
        report = _worked(job, work, before if adding else None)
        sealed = folder / f"{task.key}.sealed"
        source = task.source if is_remote(task.source) else str(Path(task.source).resolve())
        sha256 = seal(work, sealed, (*keys, task.key) if adding else (task.key,), source)
        output.publish(sealed, task.memory, replace=before.exists())
        size = sealed.stat().st_size
        shutil.rmtree(folder)
        return Outcome(task, "done", "", True, sha256, size, report.frames, report.instances)


def _published(job: BatchJob, output: Output, copy: Path) -> tuple[tuple[str, ...], bool]:
    """Copy the published memory, if any; return the keys of its tasks, and whether to add to it. Raises
    `MemoryFileError` for one that this task may neither extend nor replace.
    """
    remove_memory(copy)
    if output.size(job.task.memory) is None:
        return (), False
    output.fetch(job.task.memory, copy)
    keys = batch_keys(copy)
    adding = set(keys) <= set(job.siblings) if keys else job.onto
    if not adding and not job.force and job.task.key not in keys:
        what = "a memory of another video or other settings" if keys else "a memory that no batch made"
        raise MemoryFileError(
            f"{output.place(job.task.memory)} holds {what}; name another --out, or --force to replace it"
            + ("" if keys else ", or --onto to add the video to it")
        )
    return keys, adding


@dataclass(frozen=True)
class _FinishedBefore:
    """The outcome of a memory that was finished before its task was killed."""

    frames: int
    instances: int


def _worked(job: BatchJob, work: Path, before: Path | None) -> BuildReport | UpdateReport | _FinishedBefore:
    """Build the file under way, or update the file published `before`, or resume either."""
    task = job.task
    known = _finished(work, before)
    if known is not None and task.run.scale_anchor is None and task.run.detector is None:
        return known
    if known is not None:  # whether its scale and its names are in it is not known
        remove_memory(work)
    if before is not None and not work.exists():
        part = work.with_suffix(".part")
        shutil.copyfile(before, part)
        part.replace(work)
    source = fetched(task.source, work.with_suffix(".source"))
    run = replace(task.run, workers=job.workers, resume=True, force=False)
    if before is None:
        return build(source, work, options=task.options, settings=task.request, run=run)
    return update(work, source, options=task.options, settings=task.request, run=run)


def _finished(work: Path, before: Path | None) -> _FinishedBefore | None:
    """Return the content of the file under way if the whole video is in it; None where work is left."""
    if not work.exists():
        return None
    known = 0
    if before is not None:
        with Store.open(before) as store:
            known = len(store.sessions.all())
    with Store.open(work) as store:
        sessions = store.sessions.all()
        if len(sessions) <= known or sessions[-1].state != "complete":
            return None
        return _FinishedBefore(len(store.frames.all(sessions[-1].session_id)), store.instances.count()[0])


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep other processes from the files of a memory; one that is being ended is waited for."""
    import fcntl

    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
