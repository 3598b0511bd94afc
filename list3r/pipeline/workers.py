"""A small pool of processes that keeps order and never runs far ahead of whoever takes the results."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
import types
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Generic, TypeVar

from list3r.memory.errors import List3rError

Task = TypeVar("Task")
Result = TypeVar("Result")
Question = TypeVar("Question")
Answer = TypeVar("Answer")

DEFAULT_LIMIT = 4
"""Processes started unless more are asked for; each holds one chunk of frames (about 0.4 GB at 640x480)."""


def default_workers() -> int:
    """As many processes as there are cores to run on, at most `DEFAULT_LIMIT`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return max(1, min(cores, DEFAULT_LIMIT))


_ENDED = (
    "a worker process was ended from outside, most likely for want of memory; go on with --resume and fewer --workers"
)


class OrderedPool(Generic[Task, Result]):
    """Runs one function over tasks in processes; results come in the order of the tasks.

    The processes are started afresh (spawned), so that they share neither locks nor half-used threads with the caller.
    """

    def __init__(self, work: Callable[[Task], Result], workers: int) -> None:
        self._work = work
        self._workers = workers
        self._executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _prepare, (os.getpid(),))

    def map(self, tasks: Sequence[Task]) -> Iterator[Result]:
        """Results in order; at most `workers + 1` tasks are under way or waiting to be taken."""
        waiting: deque[Future[Result]] = deque()
        upcoming = iter(tasks)
        try:
            for task in upcoming:
                with _no_main_module():
                    waiting.append(self._executor.submit(self._work, task))
                if len(waiting) > self._workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as error:
            raise List3rError(_ENDED) from error

    def ask(self, work: Callable[[Question], Answer], question: Question) -> Answer:
        """What another function makes of its argument, in one of the processes, after the tasks that wait already."""
        with _no_main_module():
            coming = self._executor.submit(work, question)
        try:
            return coming.result()
        except BrokenProcessPool as error:
            raise List3rError(_ENDED) from error

    def stop(self) -> None:
        """End the processes at once."""
        results = getattr(self._executor, "_result_queue", None)
        self._executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()
            process.join()
        # One that was ended amid handing over a result leaves half of it, whose rest the pool would wait for for ever
        # while anybody could still write it; no other process can, and this one never does.
        writer = getattr(results, "_writer", None)
        if writer is not None and not writer.closed:
            writer.close()


@contextlib.contextmanager
def _no_main_module() -> Iterator[None]:
    """Keep new processes from running the caller's script again, which asks every script for a guard otherwise."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _prepare(parent: int) -> None:
    """In each process: leave Ctrl-C to the parent, use one thread, end when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow, args=(parent,), daemon=True).start()
    import cv2
    from threadpoolctl import threadpool_limits

    cv2.setNumThreads(1)
    threadpool_limits(1)


def _follow(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.3)
    os._exit(1)
