"""A pool of processes that keeps the order of its tasks and never runs far ahead of whoever takes the results.

The processes are started afresh with `subprocess`, not by `multiprocessing`: they share neither locks nor threads with
the caller, run nothing of the caller's script unless a task names it, and no other code of the caller sees them.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from list3r.pipeline.workers.process import one_thread
from list3r.pipeline.workers.worker import Worker, WorkerJob

Task = TypeVar("Task")
Result = TypeVar("Result")
Question = TypeVar("Question")
Answer = TypeVar("Answer")
Job = TypeVar("Job")

DEFAULT_LIMIT = 4
"""Processes started unless more are asked for; each holds one chunk of frames (about 0.4 GB at 640x480)."""
LIVENESS_POLL_S = 1.0
"""How often processes are looked after that say nothing; one that ends is usually noticed at once."""


def default_workers() -> int:
    """Return as many processes as there are cores to run on, at most `DEFAULT_LIMIT`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return max(1, min(cores, DEFAULT_LIMIT))


def in_order(
    tasks: Iterable[Task], submit: Callable[[Task], Job], outcome: Callable[[Job], Result], most: int
) -> Iterator[Result]:
    """Yield the outcomes of tasks in their order; at `most` so many are under way or waiting to be taken."""
    ahead: deque[Job] = deque()
    for task in tasks:
        ahead.append(submit(task))
        if len(ahead) >= most:
            yield outcome(ahead.popleft())
    while ahead:
        yield outcome(ahead.popleft())


class OrderedPool(Generic[Task, Result]):
    """Runs one function over tasks in processes; results come in the order of the tasks.

    Use it as a context manager: at its end the processes are gone. They also end when the caller's process is gone,
    however it went. `work` is a function of a module, or of the caller's script if that has a guard. With 0 workers
    there is no process: tasks are worked on in the caller's, which then uses one thread.
    """

    def __init__(self, work: Callable[[Task], Result], workers: int) -> None:
        self._work = work
        self._workers = workers
        self._processes: list[Worker] = []
        self._waiting: deque[WorkerJob] = deque()

    def __enter__(self) -> Self:
        if self._workers == 0:
            one_thread()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def map(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield results in order; at most `workers + 1` tasks are under way or waiting to be taken.

        Raises what the function raised for a task, and `WorkerError` where a process was ended from outside.
        """
        return self.each(self._work, tasks)

    def each(self, work: Callable[[Question], Answer], questions: Iterable[Question]) -> Iterator[Answer]:
        """Yield what another function makes of some arguments, in the way of `map`."""
        return in_order(questions, lambda question: self._submit(work, question), self._outcome, self._workers + 1)

    def ask(self, work: Callable[[Question], Answer], question: Question) -> Answer:
        """Return what another function makes of its argument, after the tasks that are under way."""
        answer: Answer = self._outcome(self._submit(work, question))
        return answer

    def start(self, work: Callable[[Question], object], question: Question) -> None:
        """Start all processes now and let each call a function first, such as one that imports what tasks will need.

        Nothing waits for it, and what it raises is dropped.
        """
        for _ in range(self._workers):
            self._submit(work, question)

    def keep(self, most: int) -> None:
        """Use so many processes at most from now on; end the last ones of those that run."""
        self._workers = min(self._workers, most)
        spare, self._processes = self._processes[self._workers :], self._processes[: self._workers]
        _end(spare)

    def stop(self) -> None:
        """End the processes of this pool at once."""
        processes, self._processes = self._processes, []
        self._waiting.clear()
        _end(processes)

    def _submit(self, work: Callable[[Any], Any], argument: object) -> WorkerJob:
        job = WorkerJob(work, argument)
        self._waiting.append(job)
        self._hand_out()
        return job

    def _hand_out(self) -> None:
        """Give tasks that wait to processes that are idle, and start processes while fewer than allowed run."""
        while self._waiting and self._workers:
            idle = next((p for p in self._processes if p.job is None), None)
            if idle is None and len(self._processes) < self._workers:
                idle = Worker()
                self._processes.append(idle)
            if idle is None:
                return
            idle.begin(self._waiting.popleft())

    def _outcome(self, job: WorkerJob) -> Any:
        """Return the result of a job when it is there, taking in other results meanwhile."""
        if self._workers == 0:
            self._waiting.remove(job)
            return job.work(job.argument)
        while not job.done:
            busy = {p.connection: p for p in self._processes if p.job is not None}
            for connection in wait(list(busy), LIVENESS_POLL_S):
                assert isinstance(connection, Connection)
                busy[connection].finish()
            for process in self._processes:
                process.check_alive()
            self._hand_out()
        if job.error is not None:
            raise job.error
        return job.result


def _end(processes: Sequence[Worker]) -> None:
    for process in processes:
        process.kill()
    for process in processes:
        process.close()
