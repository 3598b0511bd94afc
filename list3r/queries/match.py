"""What every query answers with, and the filters that all of them share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.errors import OptionError
from list3r.memory.records import Instance

STATES = ("present", "moved", "removed", "added", "unseen")


@dataclass(frozen=True)
class Match:
    """One instance that answers a question.

    Distances are metres; in a memory whose scale is relative they are that memory's own units.
    """

    instance: Instance
    score: float
    """How well it answers, larger is better; what it means depends on the query and stands in `reason`."""
    distance_m: float | None
    """Between surfaces as they were seen, 0 where two things touch; None where the question has no place."""
    center_distance_m: float | None
    """Between centres of boxes (or from the point asked about to the centre)."""
    reason: str
    """Why it is here, in words."""


@dataclass(frozen=True)
class Filters:
    """Which instances a question is about."""

    structure: bool = False
    """Whether floor, walls and the like may answer."""
    min_confidence: float = 0.0
    state: str | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_confidence <= 1.0:
            raise OptionError(f"min_confidence {self.min_confidence} must lie between 0 and 1")
        if self.state is not None and self.state not in STATES:
            raise OptionError(f"state {self.state!r} is not known; choose one of: {', '.join(STATES)}")

    def select(self, instances: Iterable[Instance]) -> list[Instance]:
        """Those that pass."""
        return [
            i
            for i in instances
            if (self.structure or i.structure is None)
            and i.confidence >= self.min_confidence
            and (self.state is None or i.state == self.state)
        ]


def checked_count(k: int) -> int:
    """A count of answers, at least 1. Raises `OptionError`."""
    if k < 1:
        raise OptionError(f"k = {k}: ask for at least 1 answer")
    return int(k)


def checked_point(value: ArrayLike, name: str) -> NDArray[np.float64]:
    """Three finite numbers. Raises `OptionError`."""
    try:
        point = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{name} must be three numbers x, y, z, not {value!r}") from error
    if point.shape != (3,) or not np.isfinite(point).all():
        raise OptionError(f"{name} must be three finite numbers x, y, z, not {value!r}")
    return point


def checked_length(value: float, name: str) -> float:
    """A finite length that is not negative. Raises `OptionError`."""
    if not np.isfinite(value) or value < 0:
        raise OptionError(f"{name} {value} must be a finite length, 0 or more")
    return float(value)
