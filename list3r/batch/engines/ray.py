"""Tasks on a Ray cluster, or on one that is started on this machine for the batch."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Iterator
from typing import Any

from list3r.batch.engines.base import TaskResources
from list3r.batch.work import BatchJob, Outcome, run_task
from list3r.memory.errors import MissingPackageError, OptionError

_GIB = 2**30
_AHEAD = 2
"""Tasks that are handed to Ray for each that the cluster can run at once, so that no node waits for this process."""


class RayEngine:
    """Ray chooses the node of a task by its resources. It never runs a task twice by itself: the batch does that."""

    def __init__(self, resources: TaskResources, jobs: int | None = None, address: str | None = None) -> None:
        """Connect to the cluster at an `address`, else to the one of this machine's environment, else start one.

        Raises `OptionError` where it cannot be reached, `MissingPackageError` without Ray.
        """
        try:
            ray: Any = importlib.import_module("ray")
        except ModuleNotFoundError:
            raise MissingPackageError(
                "--engine ray takes ray, which is not installed: pip install 'list3r[ray]'"
            ) from None
        self._ray = ray
        self._ours = not ray.is_initialized()
        if self._ours:
            wanted = address or os.environ.get("RAY_ADDRESS")
            try:
                ray.init(address=wanted, log_to_driver=False, include_dashboard=False, logging_level="error")
            except (ConnectionError, RuntimeError, ValueError) as error:
                said = str(error).splitlines()[0]
                raise OptionError(f"the Ray cluster at {wanted or 'this machine'} cannot be reached: {said}") from error
        there = ray.cluster_resources()
        fits = int(there.get("CPU", 0)) // resources.cpus
        if resources.gpus:
            fits = min(fits, int(there.get("GPU", 0) / resources.gpus))
        self.window = jobs if jobs is not None else _AHEAD * max(1, fits)
        memory = None if resources.memory_gb is None else math.ceil(resources.memory_gb * _GIB)
        asked = {"num_cpus": resources.cpus, "num_gpus": resources.gpus, "memory": memory, "max_retries": 0}
        self._work = ray.remote(**{k: v for k, v in asked.items() if v is not None})(run_task)
        self._open: dict[Any, BatchJob] = {}

    def submit(self, job: BatchJob) -> None:
        """Take a task."""
        self._open[self._work.remote(job)] = job

    def as_completed(self) -> Iterator[Outcome]:
        """Yield tasks as they end, until none is left."""
        while self._open:
            (done, *_), _ = self._ray.wait(list(self._open), num_returns=1)
            job = self._open.pop(done)
            try:
                outcome = self._ray.get(done)
            except self._ray.exceptions.RayError as error:
                said = next((line for line in str(error).splitlines() if line.strip()), "")
                outcome = Outcome(job.task, "lost", f"{type(error).__name__}: {said}".rstrip(": "))
            yield outcome

    def cancel(self) -> None:
        """End all tasks at once, and the cluster where this engine started or joined it."""
        for reference in self._open:
            self._ray.cancel(reference, force=True)
        self._open.clear()
        if self._ours:
            self._ray.shutdown()
