"""A pool of processes that keeps the order of its tasks and never runs far ahead of whoever takes the results.

The processes are started afresh with `subprocess`, not by `multiprocessing`: they share neither locks nor threads with
the caller, run nothing of the caller's script unless a task names it, and no other code of the caller sees them.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from multiprocessing.spawn import get_executable
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from list3r.memory.errors import List3rError

Task = TypeVar("Task")
Result = TypeVar("Result")
Question = TypeVar("Question")
Answer = TypeVar("Answer")

DEFAULT_LIMIT = 4
"""Processes started unless more are asked for; each holds one chunk of frames (about 0.4 GB at 640x480)."""
LIVENESS_POLL_S = 1.0
"""How often processes are looked after that say nothing; one that ends is usually noticed at once."""


class WorkerError(List3rError):
    """A worker process ended before its task was done."""


def default_workers() -> int:
    """Return as many processes as there are cores to run on, at most `DEFAULT_LIMIT`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return max(1, min(cores, DEFAULT_LIMIT))


class OrderedPool(Generic[Task, Result]):
    """Runs one function over tasks in processes; results come in the order of the tasks.

    Use it as a context manager: at its end the processes are gone. They also end when the caller's process is gone,
    however it went. `work` is a function of a module, or of the caller's script if that has a guard.
    """

    def __init__(self, work: Callable[[Task], Result], workers: int) -> None:
        self._work = work
        self._workers = workers
        self._processes: list[_Worker] = []
        self._waiting: deque[_Job] = deque()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def map(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield results in order; at most `workers + 1` tasks are under way or waiting to be taken.

        Raises what the function raised for a task, and `WorkerError` where a process was ended from outside.
        """
        ahead: deque[_Job] = deque()
        for task in tasks:
            ahead.append(self._submit(self._work, task))
            if len(ahead) > self._workers:
                yield self._outcome(ahead.popleft())
        while ahead:
            yield self._outcome(ahead.popleft())

    def ask(self, work: Callable[[Question], Answer], question: Question) -> Answer:
        """Return what another function makes of its argument, after the tasks that are under way."""
        answer: Answer = self._outcome(self._submit(work, question))
        return answer

    def stop(self) -> None:
        """End the processes of this pool at once."""
        processes, self._processes = self._processes, []
        self._waiting.clear()
        for process in processes:
            process.kill()
        for process in processes:
            process.close()

    def _submit(self, work: Callable[[Any], Any], argument: object) -> _Job:
        job = _Job(work, argument)
        self._waiting.append(job)
        self._hand_out()
        return job

    def _hand_out(self) -> None:
        """Give tasks that wait to processes that are idle, and start processes while fewer than allowed run."""
        while self._waiting:
            idle = next((p for p in self._processes if p.job is None), None)
            if idle is None and len(self._processes) < self._workers:
                idle = _Worker()
                self._processes.append(idle)
            if idle is None:
                return
            idle.begin(self._waiting.popleft())

    def _outcome(self, job: _Job) -> Any:
        """Return the result of a job when it is there, taking in other results meanwhile."""
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


class _Job:
    """A task on its way through the pool."""

    def __init__(self, work: Callable[[Any], Any], argument: object) -> None:
        self.work, self.argument = work, argument
        self.done = False
        self.result: Any = None
        self.error: BaseException | None = None


class _Worker:
    """One process, at the other end of a connection."""

    def __init__(self) -> None:
        self.job: _Job | None = None
        self.connection, theirs = Pipe()
        try:
            self._process = _start(theirs.fileno())
        finally:
            theirs.close()

    def begin(self, job: _Job) -> None:
        """Hand a job to the process, which must be idle."""
        self.job = job
        try:
            self.connection.send((job.work, job.argument))
        except OSError as error:
            raise self._ended() from error

    def finish(self) -> None:
        """Take the outcome of the job from the process."""
        assert self.job is not None
        try:
            succeeded, value = self.connection.recv()
        except (EOFError, OSError) as error:
            raise self._ended() from error
        job, self.job = self.job, None
        job.done = True
        if succeeded:
            job.result = value
        else:
            job.error = value

    def check_alive(self) -> None:
        """Raise `WorkerError` where the process ended and left no outcome."""
        if self.job is not None and self._process.poll() is not None and not self.connection.poll():
            raise self._ended()

    def kill(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()

    def close(self) -> None:
        """Wait for the end of a process that was killed."""
        self.connection.close()
        self._process.wait()

    def _ended(self) -> WorkerError:
        status = self._process.wait()
        if status >= 0:
            return WorkerError(f"a worker process ended with status {status}; what it said stands above")
        return WorkerError(
            f"a worker process was ended from outside (signal {-status}), most likely for want of memory; "
            "go on with --resume and fewer --workers"
        )


_BOOT = """
import json, sys
sys.path[:] = json.loads(sys.argv[4])
from list3r.pipeline.workers.process import serve
serve(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
"""


def _start(descriptor: int) -> subprocess.Popen[bytes]:
    """Start a process that serves a connection; it finds its modules where the caller does, and BLAS uses one thread.

    Ctrl-C is held back from it until it ignores it by itself.
    """
    script = getattr(sys.modules.get("__main__"), "__file__", None) or ""
    folders = json.dumps([folder or str(Path.cwd()) for folder in sys.path])
    words = [get_executable(), "-c", _BOOT, str(descriptor), str(os.getpid()), str(script), folders]
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return subprocess.Popen(
            [os.fsdecode(word) for word in words],
            stdin=subprocess.DEVNULL,
            pass_fds=(descriptor,),
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
