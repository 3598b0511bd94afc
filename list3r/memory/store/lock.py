"""One writer at a time: an advisory lock on a file beside the memory, which says who holds it."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import sys
from datetime import datetime
from pathlib import Path

from list3r.memory.errors import MemoryFileError


class WriterLock:
    """The lock of one memory, taken when made and held until `release`; the kernel frees that of a killed process.

    It is not on the memory itself: closing any other handle of that file would drop the locks of SQLite.
    """

    def __init__(self, path: Path) -> None:
        """Raises `MemoryFileError` naming the holder when another process, or this one, writes the memory."""
        self._path = lock_path(path)
        self._descriptor = self._take(path)
        os.truncate(self._descriptor, 0)
        os.pwrite(self._descriptor, json.dumps(_me()).encode(), 0)

    def _take(self, memory: Path) -> int:
        while True:
            try:
                descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            except OSError as error:
                raise MemoryFileError(f"{memory} cannot be written: {error.strerror}") from error
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(descriptor)
                raise MemoryFileError(f"{memory} is being written by {_holder(self._path)}; wait for it to end") from (
                    error
                )
            if self._is_current(descriptor):
                return descriptor
            os.close(descriptor)

    def _is_current(self, descriptor: int) -> bool:
        """Whether the file that was locked is still the one that bears the name: the last holder removes it."""
        try:
            return os.path.samestat(os.fstat(descriptor), self._path.stat())
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Remove the file and free the lock. A second call does nothing."""
        if self._descriptor < 0:
            return
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        os.close(self._descriptor)
        self._descriptor = -1


def lock_path(memory: Path) -> Path:
    """Where the lock of a memory lies while it is written."""
    return memory.with_name(f"{memory.name}-writer")


def _me() -> dict[str, object]:
    name = Path(sys.argv[0]).name if sys.argv and sys.argv[0] else "python"
    program = "list3r" if name == "__main__.py" else name
    words = [w for w in sys.argv[1:2] if program == "list3r" and w.isalpha()]
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "program": " ".join([program, *words]),
        "since": datetime.now().astimezone().isoformat(timespec="seconds"),
    }


def _holder(path: Path) -> str:
    """The holder of a lock in words."""
    try:
        held = json.loads(path.read_bytes()[:4096])
        if held["pid"] == os.getpid() and held["host"] == socket.gethostname():
            return f"this process already, since {held['since']}"
        return f"another process: {held['program']} (process {held['pid']} on {held['host']}, since {held['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
