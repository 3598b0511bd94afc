"""Tasks on a Ray cluster, or on one that is started on this machine for the batch."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from list3r.batch.engines.base import TaskResources
from list3r.batch.work import BatchJob, Outcome, run_task
from list3r.memory.core.errors import first_line
from list3r.pipeline.workers.cluster import RayCluster

_GIB = 2**30
_AHEAD = 2
"""Tasks that are handed to Ray for each that the cluster can run at once, so that no node waits for this process."""


class RayEngine:
    """Ray chooses the node of a task by its resources. It never retries a task: the batch does."""

    def __init__(self, resources: TaskResources, jobs: int | None = None, address: str | None = None) -> None:
        """Connect to the cluster at an `address`, else to the one of this machine's environment, else start one.

        Raises `OptionError` where it cannot be reached, `MissingPackageError` without Ray.
        """
        self._cluster = RayCluster(address)
        fits = self._cluster.fits(resources.cpus, resources.gpus)
        self.window = jobs if jobs is not None else _AHEAD * max(1, fits)
        memory = None if resources.memory_gb is None else math.ceil(resources.memory_gb * _GIB)
        asked = {"num_cpus": resources.cpus, "num_gpus": resources.gpus, "memory": memory, "max_retries": 0}
        self._submit = self._cluster.remote(run_task, **{k: v for k, v in asked.items() if v is not None})
        self._open: dict[Any, BatchJob] = {}

    def submit(self, job: BatchJob) -> None:
        self._open[self._submit(job)] = job

    def as_completed(self) -> Iterator[Outcome]:
        while self._open:
            done = self._cluster.first(list(self._open))
            job = self._open.pop(done)
            try:
                outcome = self._cluster.result(done)
            except self._cluster.errors.RayError as error:
                reason = first_line(error)
                outcome = Outcome(job.task, "lost", f"{type(error).__name__}: {reason}".rstrip(": "))
            yield outcome

    def cancel(self) -> None:
        self._cluster.leave(list(self._open))
        self._open.clear()
