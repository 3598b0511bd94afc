"""The interface between a batch and its engine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from list3r.batch.work import BatchJob, Outcome
from list3r.memory.core.errors import OptionError


@dataclass(frozen=True)
class TaskResources:
    """Resources of one task."""

    cpus: int = 1
    memory_gb: float | None = None
    """GiB; None: not counted."""
    gpus: float = 0.0

    def __post_init__(self) -> None:
        if self.cpus < 1:
            raise OptionError(f"--cpus {self.cpus}: give 1 or more")
        if self.memory_gb is not None and not self.memory_gb > 0:
            raise OptionError(f"--task-memory {self.memory_gb}: give GiB above 0")
        if not self.gpus >= 0:
            raise OptionError(f"--gpus {self.gpus}: give 0 or more")


class Engine(Protocol):
    """Places tasks and reports how they ended. A task whose process dies is `lost`; the batch decides about a retry."""

    window: int
    """Tasks that are submitted at once, at most: more would only wait inside the engine."""

    def submit(self, job: BatchJob) -> None:
        """Take a task."""
        ...

    def as_completed(self) -> Iterator[Outcome]:
        """Yield tasks as they end, until none is left; more may be submitted meanwhile."""
        ...

    def cancel(self) -> None:
        """End all tasks at once and let the engine go."""
        ...
