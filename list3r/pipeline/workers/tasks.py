"""A pool of processes that hands over results as they come; a process that is ended costs its own task alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from queue import SimpleQueue
from typing import Generic, TypeVar

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
        self._work, self._environment = work, environment
        self._threads = ThreadPoolExecutor(workers)  # each waits for one process
        self._free = SimpleQueue[int]()
        for place in range(workers):
            self._free.put(place)
        self._processes: dict[int, Worker] = {}
        self._open: dict[Future[Result], Task] = {}
        self._cancelled = False

    def submit(self, task: Task) -> None:
        """Take a task, which begins as soon as a process is idle."""
        self._open[self._threads.submit(self._run, task)] = task

    def as_completed(self) -> Iterator[tuple[Task, Result | BaseException]]:
        """Yield tasks as they end, with the result, with what the function raised, or with a `WorkerError`.

        More may be submitted meanwhile.
        """
        while self._open:
            for future in wait(self._open, return_when=FIRST_COMPLETED).done:
                error = future.exception()
                yield self._open.pop(future), future.result() if error is None else error

    def cancel(self) -> None:
        """End all processes at once and forget all tasks."""
        self._cancelled = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        processes = list(self._processes.values())
        for process in processes:
            process.kill()
        self._threads.shutdown()
        for process in processes:
            process.close()
        self._open.clear()

    def _run(self, task: Task) -> Result:
        job, place = WorkerJob(self._work, task), self._free.get()
        try:
            if place not in self._processes:
                self._processes[place] = Worker(self._environment(place))
                if self._cancelled:
                    self._processes[place].kill()
            self._processes[place].begin(job)
            self._processes[place].finish()
        except WorkerError:
            self._processes.pop(place).close()
            raise
        finally:
            self._free.put(place)
        if job.error is not None:
            raise job.error
        return job.result  # type: ignore[no-any-return]
