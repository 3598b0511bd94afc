"""The program as tests run it: in this process, or in one of its own where that is what is tested."""

from __future__ import annotations

import contextlib
import io
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from list3r.cli.app import run


def in_process(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the program without a process of its own, which would take a second or two to start."""
    out, err = io.StringIO(), io.StringIO()
    words = [str(a) for a in arguments]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = run(words)
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


def with_signals() -> None:
    """Run in a new process: signals do what they do by default, also where a shell's background ignores them."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


def as_user(*arguments: str | Path, before: Callable[[], None] | None = None) -> subprocess.CompletedProcess[str]:
    """Run the program as a user starts it; `before` runs in the new process."""
    command = [sys.executable, "-m", "list3r", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, preexec_fn=before)
