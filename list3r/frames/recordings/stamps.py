"""Time stamps of lists and of names, brought to seconds whatever unit they are written in."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_UNITS = ((1e17, 1e9, "nanoseconds"), (1e14, 1e6, "microseconds"), (1e11, 1e3, "milliseconds"))
"""Seconds since 1970 are 1e9 to 1e10: what is larger is in another unit. From where, how many a second, name."""
_WHOLE_NAME = re.compile(r"\d{9,19}(\.\d+)?")
_REDWOOD_NAME = re.compile(r"\d+-(\d{9,})")
"""A number, and microseconds since the recording began, as Redwood and Open3D name pictures."""


def as_seconds(stamps: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Return stamps in seconds, and the unit they were in. Shape (N,)."""
    largest = float(np.abs(stamps[np.isfinite(stamps)]).max(initial=0.0))
    for least, per_s, unit in _UNITS:
        if largest >= least:
            return stamps / per_s, unit
    return stamps, "seconds"


def times_of_names(paths: Sequence[Path]) -> NDArray[np.float64] | None:
    """Return seconds that the names of pictures say, None where they say none. Shape (N,)."""
    stems = [p.stem for p in paths]
    if stems and all(_WHOLE_NAME.fullmatch(s) for s in stems):
        return as_seconds(np.array(stems, np.float64))[0]
    found = [_REDWOOD_NAME.fullmatch(s) for s in stems]
    return 1e-6 * np.array([float(m[1]) for m in found if m]) if found and all(found) else None
