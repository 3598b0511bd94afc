"""One process of a pool, seen from the side that hands it tasks."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from multiprocessing import Pipe
from multiprocessing.spawn import get_executable
from pathlib import Path
from typing import Any

from list3r.memory.core.errors import List3rError


class WorkerError(List3rError):
    """A worker process ended before its task was done."""


class WorkerJob:
    """A task on its way through the pool."""

    def __init__(self, work: Callable[[Any], Any], argument: object) -> None:
        self.work, self.argument = work, argument
        self.done = False
        self.result: Any = None
        self.error: BaseException | None = None


class Worker:
    """One process, at the other end of a connection."""

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        self.job: WorkerJob | None = None
        self.connection, theirs = Pipe()
        try:
            self._process = _start(theirs.fileno(), environment or {})
        finally:
            theirs.close()

    def begin(self, job: WorkerJob) -> None:
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
            return WorkerError(f"a worker process ended with status {status}; its output is above")
        return WorkerError(
            f"a worker process was ended from outside (signal {-status}), probably because memory ran out; "
            "continue with --resume and fewer --workers"
        )


_BOOT = """
import json, sys
sys.path[:] = json.loads(sys.argv[4])
from list3r.pipeline.workers.process import serve
serve(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
"""


def _start(descriptor: int, environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
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
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", **environment},
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
