"""Stretches of frames that follow on one another: errors that last over time last within them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray


def runs_of(frames: Sequence[int] | NDArray[np.int64], most_gap: int = 5) -> list[slice]:
    """Runs of positions with frame numbers that ascend by at most `most_gap`."""
    numbers = np.asarray(frames, np.int64)
    step = np.diff(numbers)
    starts = [0, *(np.flatnonzero((step <= 0) | (step > most_gap)) + 1).tolist(), len(numbers)]
    return [slice(a, b) for a, b in pairwise(starts) if b > a]
