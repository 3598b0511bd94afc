"""Processes of a build and of a batch: `pool` and `ray_pool` keep the order of tasks, `tasks` does not."""

from list3r.pipeline.workers.pool import OrderedPool, default_workers
from list3r.pipeline.workers.tasks import TaskPool
from list3r.pipeline.workers.worker import WorkerError

__all__ = ["OrderedPool", "TaskPool", "WorkerError", "default_workers"]
