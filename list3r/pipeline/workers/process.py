"""What runs in a process of an `OrderedPool`: take a task from the parent, work on it, hand the result back."""

from __future__ import annotations

import contextlib
import os
import runpy
import signal
import sys
import threading
import time
import traceback
import types
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

PARENT_POLL_S = 0.3
"""How often a process looks whether its parent is still there; it may be deep in a computation when the parent dies."""


def serve(descriptor: int, parent: int, script: str) -> None:
    """Work on what comes over a connection until the other end is closed or the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent too, which ends this process
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    _prepare(script)
    connection = Connection(descriptor)
    while True:
        try:
            message = connection.recv_bytes()
        except (EOFError, OSError):
            os._exit(0)
        answer = _answer(message)
        try:
            connection.send(answer)
        except OSError:
            os._exit(0)
        except Exception as error:  # the result itself cannot be sent
            connection.send((False, _sendable(error)))


def _answer(message: bytes) -> tuple[bool, Any]:
    """Return (True, result) or (False, exception) of one task."""
    try:
        work, argument = ForkingPickler.loads(message)
        return True, work(argument)
    except BaseException as error:
        return False, _sendable(error)


def _sendable(error: BaseException) -> BaseException:
    """Return the exception with its traceback as a note; an exception that cannot be sent becomes a `RuntimeError`."""
    note = f"in a worker process:\n{traceback.format_exc()}"
    error.add_note(note)
    try:
        ForkingPickler.loads(ForkingPickler.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
        error.add_note(note)
    return error


def _prepare(script: str) -> None:
    """Keep standard output for the parent, use one thread, and know where the functions of the parent's script are."""
    with contextlib.suppress(OSError):
        os.dup2(2, 1)
    if script:
        sys.modules["__main__"] = sys.modules["__mp_main__"] = _Script(script)
    one_thread()


def one_thread() -> None:
    """Let OpenCV and BLAS use one thread in this process from now on, those of them that are installed."""
    with contextlib.suppress(ImportError):
        import cv2

        cv2.setNumThreads(1)
    with contextlib.suppress(ImportError):
        from threadpoolctl import threadpool_limits

        threadpool_limits(1)


class _Script(types.ModuleType):
    """The parent's script, which is run here only when a task names a function or class of it.

    It is run as `__mp_main__`, as `multiprocessing` does, so that what stands under a guard is not.
    """

    def __init__(self, path: str) -> None:
        super().__init__("__main__")
        self._path = path

    def __getattr__(self, name: str) -> Any:
        path = self.__dict__.pop("_path", None)
        if path is not None:
            self.__dict__.update(runpy.run_path(path, run_name="__mp_main__"))
        if name not in self.__dict__:
            raise AttributeError(f"{path or 'the script'} has no {name}")
        return self.__dict__[name]


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(1)
