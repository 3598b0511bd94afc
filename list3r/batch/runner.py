"""A batch: unfinished tasks are handed to an engine, and their outcomes are recorded."""

from __future__ import annotations

import hashlib
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from list3r.batch.engines.base import Engine
from list3r.batch.ledger import Ledger, TaskRow
from list3r.batch.storage import Output, is_remote
from list3r.batch.tasks import BatchTask
from list3r.batch.work import BatchJob, Outcome, run_task
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import JsonFields

STATE = "batch.sqlite"
"""Name of the manifest next to the memories."""


@dataclass(frozen=True)
class BatchSettings:
    """Where a batch works, and how often it tries."""

    out: str
    """Folder or URL of the memories."""
    scratch: Path | None = None
    """Folder on each machine's own disk for unfinished files; None: `.work` in a local `out`, else in the system's
    folder for temporary files."""
    state: Path | None = None
    """The manifest; None: in a local `out`."""
    retries: int = 3
    """Retries of a task whose process was ended from outside."""
    workers: int = 0
    """Processes of a task besides the one that runs it."""
    onto: bool = False
    force: bool = False

    def __post_init__(self) -> None:
        if self.retries < 0:
            raise OptionError(f"--retries {self.retries}: give 0 or more")
        if self.state is None and is_remote(self.out):
            raise OptionError(
                f"--out {self.out} is not a folder of this machine; say where the state file goes: --state FILE"
            )

    def ledger(self) -> Path:
        """Return where the manifest is."""
        return Path(self.out) / STATE if self.state is None else self.state

    def scratch_folder(self) -> Path:
        """Return where files under way are; the same for every run of a batch, so that they are gone on with."""
        if self.scratch is not None:
            return self.scratch.resolve()
        if not is_remote(self.out):
            return (Path(self.out) / ".work").resolve()
        return Path(tempfile.gettempdir()) / f"list3r-batch-{hashlib.sha256(self.out.encode()).hexdigest()[:16]}"

    def jobs(self, groups: Sequence[Sequence[BatchTask]]) -> list[deque[BatchJob]]:
        """Return the jobs of the tasks, those of one memory together."""
        out = self.out if is_remote(self.out) else str(Path(self.out).resolve())
        scratch = str(self.scratch_folder())
        return [
            deque(
                BatchJob(t, out, scratch, tuple(o.key for o in group), self.workers, self.onto, self.force)
                for t in group
            )
            for group in groups
        ]


@dataclass(frozen=True)
class BatchReport(JsonFields):
    """Result of a run of a batch."""

    done: int
    """Tasks that are done now."""
    built: int
    """Of them, by this run."""
    failed: int
    tasks: list[TaskRow] = field(default_factory=list)


OnOutcome = Callable[[Outcome, int, int], None]
"""Called with the outcome of an attempt, the number of finished tasks, and of all."""


def run_batch(
    groups: Sequence[Sequence[BatchTask]],
    engine: Engine,
    settings: BatchSettings,
    on_outcome: OnOutcome = lambda outcome, finished, total: None,
) -> BatchReport:
    """Do the tasks that are not done yet; tasks of one memory one after the other, others side by side.

    A task that fails leaves the others alone. When the batch is interrupted its tasks end at once and are pending; the
    same call goes on with them. Raises `OptionError` and `MemoryFileError` for errors that concern all tasks.
    """
    try:
        Output(settings.out).prepare()
        with Ledger(settings.ledger()) as ledger:
            return _Run(engine, ledger, settings, on_outcome).run(groups)
    finally:
        engine.cancel()


def run_here(group: Sequence[BatchTask], settings: BatchSettings, on_outcome: OnOutcome) -> BatchReport:
    """Do the tasks of one memory in this process, without a manifest: what an element of an array job does."""
    Output(settings.out).prepare()
    outcomes = []
    for finished, job in enumerate(settings.jobs([group])[0], 1):
        outcomes.append(run_task(job))
        on_outcome(outcomes[-1], finished, len(group))
    done = [o for o in outcomes if o.state == "done"]
    return BatchReport(len(done), sum(o.built for o in done), len(outcomes) - len(done), [_row(o) for o in outcomes])


def _row(o: Outcome) -> TaskRow:
    t = o.task
    reason = "" if o.state == "done" else o.reason
    values = (o.state, 1, reason, o.sha256, o.bytes, o.frames, o.instances, o.seconds)
    return TaskRow(t.memory, t.source, t.source_hash, t.settings_hash, *values)


class _Run:
    """The state of one run: which memories wait, and how often their tasks were tried."""

    def __init__(self, engine: Engine, ledger: Ledger, settings: BatchSettings, on_outcome: OnOutcome) -> None:
        self._engine, self._ledger, self._settings, self._on_outcome = engine, ledger, settings, on_outcome
        self._waiting: deque[deque[BatchJob]] = deque()
        self._under_way: dict[str, deque[BatchJob]] = {}
        self._lost: dict[str, int] = {}
        self._finished = self._built = self._total = 0

    def run(self, groups: Sequence[Sequence[BatchTask]]) -> BatchReport:
        tasks = [t for group in groups for t in group]
        rows = self._ledger.begin(tasks)
        output = Output(self._settings.out)
        there = {m: output.size(m) is not None for m in {t.memory for t in tasks if rows[t].state == "done"}}
        for jobs in self._settings.jobs(groups):
            left = deque(j for j in jobs if rows[j.task].state != "done" or not there[j.task.memory])
            self._finished += len(jobs) - len(left)
            if left:
                self._waiting.append(left)
        self._total = len(tasks)
        self._fill()
        for outcome in self._engine.as_completed():
            self._take(outcome)
            self._fill()
        asked = {(t.memory, t.source) for t in tasks}
        now = [r for r in self._ledger.rows() if (r.memory, r.source) in asked]
        return BatchReport(sum(r.state == "done" for r in now), self._built, sum(r.state == "failed" for r in now), now)

    def _fill(self) -> None:
        """Hand tasks to the engine until its window is full."""
        while self._waiting and len(self._under_way) < self._engine.window:
            jobs = self._waiting.popleft()
            task = jobs[0].task
            self._under_way[task.memory] = jobs
            self._ledger.started(task)
            self._engine.submit(jobs[0])

    def _take(self, outcome: Outcome) -> None:
        """Settle a task, or try it again; then the next video of its memory has its turn."""
        task = outcome.task
        jobs = self._under_way.pop(task.memory)
        if outcome.state == "lost":
            self._lost[task.key] = self._lost.get(task.key, 0) + 1
        again = outcome.state == "lost" and self._lost[task.key] <= self._settings.retries
        self._ledger.ended(outcome, "pending" if again else "done" if outcome.state == "done" else "failed")
        if not again:
            jobs.popleft()
            self._finished += 1
            self._built += outcome.built
        self._on_outcome(outcome, self._finished, self._total)
        if jobs:
            self._waiting.appendleft(jobs)
