"""How far stated probabilities can be believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DRAWS = 200
"""Samples for estimating the error by chance alone."""


def calibration(probability: NDArray[np.float64], right: NDArray[np.bool_], bins: int = 10) -> dict[str, float]:
    """Return the expected calibration error, and the precision of the surest 0.6 and 0.8 and of all. `ece_by_chance` is
    the mean error if all probabilities were right: it is not 0 for few samples.
    """
    bin_of = np.clip((probability * bins).astype(int), 0, bins - 1)
    rng = np.random.default_rng(0)
    chance = [_error(bin_of, probability, rng.random(len(right)) < probability) for _ in range(DRAWS)]
    order = np.argsort(-probability, kind="stable")
    tops = {f"right_at_{c:g}": float(right[order[: max(1, round(c * len(order)))]].mean()) for c in (0.6, 0.8, 1.0)}
    errors = {"ece": _error(bin_of, probability, right), "ece_by_chance": float(np.mean(chance))}
    return {"count": len(right), **{k: round(v, 4) for k, v in (errors | tops).items()}}


def _error(bin_of: NDArray[np.int64], probability: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Mean distance of the share right from the mean probability of each bin."""
    apart = np.bincount(bin_of, probability - right)
    return float(np.abs(apart).sum() / len(right))
