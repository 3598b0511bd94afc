"""pycolmap, kept quiet: loading it hands the signal that ends a process to its logger, which prints a native stack."""

from __future__ import annotations

import signal
import threading

_ended_by = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

__all__ = ["pycolmap"]

if _ended_by is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _ended_by)
pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
