"""A pool of processes that hands over results as they come; a process that is ended costs its own task alone."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import wait
from typing import Generic, TypeVar

from list3r.pipeline.workers.pool import LIVENESS_POLL_S
from list3r.pipeline.workers.worker import Worker, WorkerError, WorkerJob

Task = TypeVar("Task")
Result = TypeVar("Result")


class TaskPool(Generic[Task, Result]):
    """Runs one function over tasks, each in one of so many processes, which also end when the caller's is gone.

    `environment` gives further variables of the environment of the process in a place, by the place's number.
    """

    def __init__(
        self,
        work: Callable[[Task], Result],
        workers: int,
        environment: Callable[[int], Mapping[str, str]] = lambda place: {},
    ) -> None:
        self._work = work
        self._places: list[Worker | None] = [None] * workers
        self._environment = environment
        self._waiting: deque[WorkerJob] = deque()

    def submit(self, task: Task) -> None:
        """Take a task, which begins as soon as a process is idle."""
        self._waiting.append(WorkerJob(self._work, task))

    def as_completed(self) -> Iterator[tuple[Task, Result | BaseException]]:
        """Yield tasks as they end, with the result, with what the function raised, or with a `WorkerError`.

        Ends when no task is left; those that are submitted between two of them are worked on as well.
        """
        while self._waiting or any(p is not None and p.job is not None for p in self._places):
            yield from self._hand_out()
            busy = {p.connection: n for n, p in enumerate(self._places) if p is not None and p.job is not None}
            ready = {busy[c] for c in wait(list(busy), LIVENESS_POLL_S)}  # type: ignore[index]
            for place in sorted(busy.values()):
                yield from self._look_at(place, place in ready)

    def cancel(self) -> None:
        """End all processes at once and forget all tasks."""
        self._waiting.clear()
        processes = [p for p in self._places if p is not None]
        self._places = [None] * len(self._places)
        for process in processes:
            process.kill()
        for process in processes:
            process.close()

    def _hand_out(self) -> Iterator[tuple[Task, WorkerError]]:
        """Give tasks to idle processes; yield those whose process had ended meanwhile."""
        for place, process in enumerate(self._places):
            if not self._waiting or (process is not None and process.job is not None):
                continue
            job = self._waiting.popleft()
            if process is None:
                process = self._places[place] = Worker(self._environment(place))
            try:
                process.begin(job)
            except WorkerError as error:
                self._remove(place)
                yield job.argument, error  # type: ignore[misc]

    def _look_at(self, place: int, ready: bool) -> Iterator[tuple[Task, Result | BaseException]]:
        process = self._places[place]
        assert process is not None and process.job is not None
        job = process.job
        try:
            process.finish() if ready else process.check_alive()
        except WorkerError as error:
            self._remove(place)
            yield job.argument, error  # type: ignore[misc]
        if job.done:
            yield job.argument, job.result if job.error is None else job.error  # type: ignore[misc]

    def _remove(self, place: int) -> None:
        process, self._places[place] = self._places[place], None
        if process is not None:
            with contextlib.suppress(OSError):
                process.kill()
            process.close()
