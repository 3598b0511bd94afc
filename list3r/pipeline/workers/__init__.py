"""Processes of a build: `pool` starts and ends them, `process` is what runs in one."""

from list3r.pipeline.workers.pool import OrderedPool, WorkerError, default_workers

__all__ = ["OrderedPool", "WorkerError", "default_workers"]
