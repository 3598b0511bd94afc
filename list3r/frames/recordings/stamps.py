"""Time stamps of lists and of names, brought to seconds whatever unit they are written in."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_UNITS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))
"""Seconds since 1970 are 1e9 to 1e10: what is larger is in another unit. From where, and how many a second."""
_STEPS = ((3e6, 1e9), (3e3, 1e6))
"""The same by the usual step of stamps that begin elsewhere: pictures come many a second."""
_WHOLE_NAME = re.compile(r"\d{9,19}(\.\d+)?")
_REDWOOD_NAME = re.compile(r"\d+-(\d{9,})")
"""A number, and microseconds since the recording began, as Redwood and Open3D name pictures."""


def as_seconds(stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return stamps of seconds, milli-, micro- or nanoseconds in seconds. Shape (N,)."""
    known = stamps[np.isfinite(stamps)]
    largest, steps = float(np.abs(known).max(initial=0.0)), np.diff(np.unique(known))
    step = float(np.median(steps)) if len(steps) else 0.0
    by_size = next((per_s for least, per_s in _UNITS if largest >= least), 1.0)
    by_step = next((per_s for least, per_s in _STEPS if step >= least), 1.0)
    return stamps / (by_size if by_size == _UNITS[0][1] else max(by_size, by_step))


def times_of_names(paths: Sequence[Path]) -> NDArray[np.float64] | None:
    """Return seconds that the names of pictures say, None where they say none. Shape (N,)."""
    stems = [p.stem for p in paths]
    if stems and all(_WHOLE_NAME.fullmatch(s) for s in stems):
        return as_seconds(np.array(stems, np.float64))
    found = [_REDWOOD_NAME.fullmatch(s) for s in stems]
    return 1e-6 * np.array([float(m[1]) for m in found if m]) if found and all(found) else None


def nearest_rows(ascending: NDArray[Any], wanted: NDArray[Any]) -> NDArray[np.int64]:
    """Return for each wanted value the row of the nearest one, the earlier of two as near. Shape (N,)."""
    right = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(wanted - ascending[left]) <= np.abs(ascending[right] - wanted), left, right)
