"""Chunks of one video on the machines of a Ray cluster, handed over in their order."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from list3r.memory.core.errors import List3rError, OptionError
from list3r.pipeline.workers.cluster import RayCluster
from list3r.pipeline.workers.pool import in_order
from list3r.pipeline.workers.process import one_thread
from list3r.pipeline.workers.worker import WorkerError

Task = TypeVar("Task")
Result = TypeVar("Result")
Question = TypeVar("Question")
Answer = TypeVar("Answer")

_RETRIES = 3
"""How often Ray repeats a task whose process was ended; a task only computes, so that nothing is done twice."""
_AHEAD = 2
"""Tasks under way or waiting to be taken for each that the cluster can run, so that none waits for this process."""


class RayPool(Generic[Task, Result]):
    """Runs one function over tasks on a cluster; results come in the order of the tasks, as of an `OrderedPool`.

    A task has one core and one thread, and a GPU where `gpu` is wanted and there is one. All machines see the files
    that a task names at the same paths.
    """

    def __init__(
        self, work: Callable[[Task], Result], tasks: int | None = None, address: str | None = None, *, gpu: bool = False
    ) -> None:
        """So many `tasks` are under way at most. Raises `OptionError` where the cluster cannot be reached."""
        self._work = work
        self._cluster = RayCluster(address)
        gpus = 1.0 if gpu and self._cluster.has_gpu() else 0.0
        self._ahead = tasks or _AHEAD * max(1, self._cluster.fits(1, gpus))
        self._call = self._cluster.remote(_called, num_cpus=1, num_gpus=gpus, max_retries=_RETRIES)
        self._open: list[Any] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._cluster.leave(self._open)

    def map(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield results in order. Raises what the function raised, and `WorkerError` where a machine was lost."""
        return self.each(self._work, tasks)

    def each(self, work: Callable[[Question], Answer], questions: Iterable[Question]) -> Iterator[Answer]:
        """Yield what another function makes of some arguments, in the way of `map`."""
        return in_order(questions, lambda question: self._submit(work, question), self._outcome, self._ahead)

    def ask(self, work: Callable[[Question], Answer], question: Question) -> Answer:
        """Return what another function makes of its argument."""
        answer: Answer = self._outcome(self._submit(work, question))
        return answer

    def _submit(self, work: Callable[[Any], Any], argument: object) -> Any:
        reference = self._call(work, argument, str(Path.cwd()))
        self._open.append(reference)
        return reference

    def _outcome(self, reference: Any) -> Any:
        errors = self._cluster.errors
        try:
            return self._cluster.result(reference)
        except errors.RayTaskError as error:
            if isinstance(error.cause, List3rError):
                raise error.cause from None
            raise
        except errors.RayError as error:
            said = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
            raise WorkerError(f"a chunk was lost on the Ray cluster ({said}); continue with --resume") from error
        finally:
            self._open.remove(reference)


def _called(work: Callable[[Any], Any], argument: object, folder: str) -> Any:
    """Call a function on a machine of the cluster as a process of this machine would, from the same folder."""
    try:
        os.chdir(folder)
    except OSError:
        raise OptionError(
            f"{os.uname().nodename} has no folder {folder}; with --engine ray all machines must see the video at the "
            "same path"
        ) from None
    one_thread()
    return work(argument)
