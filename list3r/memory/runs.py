"""Runs of consecutive frames: when something was seen in a long recording, in little memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int32] | NDArray[np.int64]


def runs_of(frames: Ints) -> NDArray[np.int64]:
    """Return first number and end of every run of numbers, which ascend. Shape (F,) -> (R, 2)."""
    at = np.flatnonzero(np.diff(frames, prepend=-2) != 1)
    return np.stack([frames[at], np.append(frames[at[1:] - 1], frames[-1:]) + 1], axis=1).astype(np.int64)


def merged_runs(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the runs of all numbers that are in one of some runs. Shapes (R, 2)."""
    runs = np.concatenate(parts)
    runs = runs[np.argsort(runs[:, 0], kind="stable")]
    end = np.maximum.accumulate(runs[:, 1])
    at = np.flatnonzero(np.append(True, runs[1:, 0] > end[:-1])[: len(runs)])
    return np.stack([runs[at, 0], np.append(end[at[1:] - 1], end[-1:])], axis=1)


@dataclass(frozen=True)
class SeenRuns:
    """The frames of one session in which something is seen."""

    runs: NDArray[np.int64]
    """First frame and end of each run, in order. Shape (R, 2)."""
    first: int
    """Id of the chunk that saw the first frame; 0 where there is none."""
    last: int
    """Of the one that saw the last one."""


def runs_seen(chunk_id: int, frames: Ints) -> SeenRuns:
    """Return the frames in which a chunk saw something, which ascend. Shape (F,)."""
    return SeenRuns(runs_of(frames), chunk_id, chunk_id)


def seen_together(parts: Sequence[SeenRuns]) -> SeenRuns:
    """Return the frames that are among any of some."""
    parts = [p for p in parts if len(p.runs)]
    if not parts:
        return SeenRuns(np.zeros((0, 2), np.int64), 0, 0)
    first = min(parts, key=lambda p: (p.runs[0, 0], p.first)).first
    last = max(parts, key=lambda p: (p.runs[-1, 1], p.last)).last
    return SeenRuns(merged_runs([p.runs for p in parts]), first, last)
