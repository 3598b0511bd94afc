"""Calibrated confidence of the classifier's names, also in rooms unlike its training data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
LEAST, MOST_SURE = 0.018, 1e-3
"""Odds take no name to be less probable, nor to be wrong with less probability."""


@dataclass(frozen=True)
class NameSigns:
    """Signs of whether the likeliest names of T objects are right."""

    odds: Float
    """Log odds of the name. Shape (T,)."""
    whole: Float
    """Probability that the object is one whole. Shape (T,)."""
    others: float
    """Mean log odds of the likeliest names of the chunk's objects, pulled towards 0 where they are few. It is low where
    the network does not know the room."""


@dataclass(frozen=True)
class NameConfidence:
    """Log odds that the likeliest name of an object is right: logistic regression on rooms that the networks did not
    learn from, none of them furnished by others (research/names 0144).
    """

    odds: float = 0.830
    whole: float = 2.65
    others: float = 0.555
    constant: float = -3.34

    def probability(self, signs: NameSigns) -> Float:
        """Return the probability that the likeliest name is right. Shape (T,)."""
        odds = self.odds * signs.odds + self.whole * signs.whole + self.others * signs.others + self.constant
        return np.asarray(1.0 / (1.0 + np.exp(-odds)), np.float64)


def name_signs(names: Float, whole: Float, structure: Float) -> NameSigns:
    """Return the signs of the likeliest of `names` (T, C); `whole` and `structure` have shape (T,)."""
    odds, weight = _log_odds(names.max(axis=1)), np.where(structure > 0.5, 0.0, whole)
    return NameSigns(odds, whole, float((weight * odds).sum() / (weight.sum() + 1.0)))


def with_confidence(names: Float, right: Float) -> Float:
    """Return names (T, C) with the likeliest at probability `right` (T,). Probability that it loses goes to no other
    name.
    """
    rows, best = np.arange(len(names)), names.argmax(axis=1)
    most = np.clip(names[rows, best], 1e-9, 1.0 - 1e-9)
    factor = np.minimum(right / most, (1.0 - right) / (1.0 - most))
    out = np.asarray(names * factor[:, None], np.float64)
    out[rows, best] = right
    return out


def _log_odds(probability: Float) -> Float:
    p = np.clip(probability, LEAST, 1.0 - MOST_SURE)
    return np.asarray(np.log(p / (1.0 - p)), np.float64)
