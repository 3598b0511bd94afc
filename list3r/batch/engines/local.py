"""Tasks in processes of this machine, each started afresh and ended with the batch."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping

from list3r.batch.engines.base import TaskResources
from list3r.batch.work import BatchJob, Outcome, run_task
from list3r.memory.core.errors import OptionError
from list3r.pipeline.workers import TaskPool

_GIB = 2**30


class LocalEngine:
    """As many tasks side by side as cores, memory and GPUs allow."""

    def __init__(self, resources: TaskResources, jobs: int | None = None) -> None:
        """`jobs` overrides how many run side by side. Raises `OptionError` where a task needs more than there is."""
        self.window = _side_by_side(resources) if jobs is None else jobs
        self._gpus = resources.gpus
        self._pool = TaskPool(run_task, self.window, self._environment)

    def submit(self, job: BatchJob) -> None:
        self._pool.submit(job)

    def as_completed(self) -> Iterator[Outcome]:
        for job, result in self._pool.as_completed():
            if isinstance(result, Outcome):
                yield result
            else:
                yield Outcome(job.task, "lost", f"{type(result).__name__}: {result}".splitlines()[0])

    def cancel(self) -> None:
        self._pool.cancel()

    def _environment(self, place: int) -> Mapping[str, str]:
        """Return which GPUs the process in a place sees."""
        if not self._gpus:
            return {}
        count = max(1, math.ceil(self._gpus))
        first = int(place * self._gpus) if self._gpus < 1 else place * count
        return {"CUDA_VISIBLE_DEVICES": ",".join(_devices()[first : first + count])}


def _side_by_side(resources: TaskResources) -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    fits = {"cores": cores // resources.cpus}
    if resources.memory_gb is not None:
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / _GIB
        fits["GiB of memory"] = int(there / resources.memory_gb)
    if resources.gpus:
        fits["GPUs"] = int(len(_devices()) / resources.gpus)
    for what, count in fits.items():
        if count < 1:
            raise OptionError(f"one task needs more {what} than this machine has; ask for less, or give --jobs 1")
    return min(fits.values())


def _devices() -> list[str]:
    """Return the GPUs that this process may use. Raises `OptionError` where there is none."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        found = [d for d in visible.split(",") if d]
    else:
        import torch

        found = [str(n) for n in range(torch.cuda.device_count())]
    if not found:
        raise OptionError("--gpus: this machine has no usable GPU; leave it out")
    return found
