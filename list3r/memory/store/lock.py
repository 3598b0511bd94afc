"""One writer at a time: an advisory lock on a file beside the memory, which says who holds it."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import stat
import sys
import weakref
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from list3r.memory.core.errors import MemoryFileError

_MOST_BYTES = 4096
"""Of a lock file; a longer one is not ours."""
_OPEN = os.O_RDWR | sum(getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK"))


class WriterLock:
    """The lock of one memory, taken when made and held until `release`, or until nothing refers to it any more.

    The kernel frees that of a killed process. The file is created exclusively or must be a lock that was left behind:
    no link is followed, and a file that is somebody's own is neither written nor removed. It is not on the memory
    itself: closing any other handle of that file would drop the locks of SQLite.
    """

    def __init__(self, path: Path) -> None:
        """Raises `MemoryFileError` naming the holder when another process, or this one, writes the memory; also where
        the system has no locks that end with their process (Windows): memories are only read there.
        """
        self._path = lock_path(path)
        descriptor, ours = self._take(path)
        try:
            _write_holder(descriptor)
        except OSError as error:
            _let_go(descriptor, self._path, os.getpid(), ours)
            raise MemoryFileError(
                f"{path} cannot be written: {self._path.name}: {error.strerror}; free some space and run the command "
                "again"
            ) from error
        self._end = weakref.finalize(self, _let_go, descriptor, self._path, os.getpid(), ours)

    def _take(self, memory: Path) -> tuple[int, bool]:
        """The descriptor that holds the lock, and whether its file is ours to remove: one that was empty is not."""
        try:
            import fcntl
        except ImportError:
            raise MemoryFileError(f"{memory} can only be read on this system; write it on Linux or macOS") from None
        while True:
            descriptor, made = self._opened(memory)
            if descriptor < 0:
                continue
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                holder = _holder(descriptor)
                os.close(descriptor)
                raise MemoryFileError(f"{memory} is being written by {holder}; wait for it to end") from error
            if _is_current(descriptor, self._path):
                return descriptor, made or _read_holder(descriptor) is not None
            os.close(descriptor)

    def _opened(self, memory: Path) -> tuple[int, bool]:
        """The descriptor of the lock file, -1 where it went in between, and whether it was made."""
        try:
            return os.open(self._path, _OPEN | os.O_CREAT | os.O_EXCL, 0o644), True
        except FileExistsError:
            pass
        except OSError as error:
            raise MemoryFileError(
                f"{memory} cannot be written ({error.strerror}); check the permissions of its folder"
            ) from error
        try:
            if not stat.S_ISREG(os.lstat(self._path).st_mode):
                raise MemoryFileError(_in_the_way(memory, self._path))
            descriptor = os.open(self._path, _OPEN)
        except FileNotFoundError:
            return -1, False
        except OSError as error:
            raise MemoryFileError(f"{memory} cannot be written: {self._path}: {error.strerror}") from error
        if not _is_lock(descriptor):
            os.close(descriptor)
            raise MemoryFileError(_in_the_way(memory, self._path))
        return descriptor, False

    def release(self) -> None:
        """Remove the file and free the lock. A second call does nothing; in a forked child the lock stays."""
        self._end()


def lock_path(memory: Path) -> Path:
    """Where the lock of a memory lies while it is written."""
    return memory.with_name(f"{memory.name}-writer")


def _write_holder(descriptor: int) -> None:
    """Say in a lock who holds it. Raises `OSError` where that does not fit on the disk."""
    text = json.dumps(_me()).encode()
    os.ftruncate(descriptor, 0)
    if os.pwrite(descriptor, text, 0) < len(text):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _let_go(descriptor: int, path: Path, process: int, ours: bool) -> None:
    if os.getpid() == process and _is_current(descriptor, path):
        with contextlib.suppress(OSError):
            path.unlink() if ours else os.ftruncate(descriptor, 0)
    with contextlib.suppress(OSError):
        os.close(descriptor)


def _is_current(descriptor: int, path: Path) -> bool:
    """Whether the file that was locked is still the one that has the name: the last holder removes it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except OSError:
        return False


def _is_lock(descriptor: int) -> bool:
    """Whether an open file is one that we wrote, or empty: one that was made and not written yet."""
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1 or found.st_size > _MOST_BYTES:
        return False
    return found.st_size == 0 or _read_holder(descriptor) is not None


def _read_holder(descriptor: int) -> dict[str, Any] | None:
    """What a lock says of its holder; None where it is no lock."""
    try:
        held = json.loads(os.pread(descriptor, _MOST_BYTES, 0))
    except (OSError, ValueError, RecursionError):
        return None
    return held if isinstance(held, dict) and held.keys() == _me().keys() else None


def _in_the_way(memory: Path, lock: Path) -> str:
    return f"{memory} cannot be written: {lock} is not a lock of this program; move it away"


def _me() -> dict[str, object]:
    name = Path(sys.argv[0]).name if sys.argv and sys.argv[0] else "python"
    program = "list3r" if name == "__main__.py" else name
    words = [w for w in sys.argv[1:2] if program == "list3r" and w.isalpha()]
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "program": " ".join([program, *words]),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _holder(descriptor: int) -> str:
    """The holder of a lock in words."""
    held = _read_holder(descriptor)
    if held is None:
        return "another process"
    if held["pid"] == os.getpid() and held["host"] == socket.gethostname():
        return f"this process already, since {held['since']}"
    return f"another process: {held['program']} (process {held['pid']} on {held['host']}, since {held['since']})"
