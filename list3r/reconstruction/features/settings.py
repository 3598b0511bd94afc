"""Settings of local features."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FeatureSettings:
    """How local features are found, matched and verified."""

    width: int = 0
    """Pictures are shrunk to at most this many px on their longer side; 0 keeps their size."""
    count: int = 400
    """Most features on a frame."""
    ratio: float = 0.85
    """Lowe's ratio of best to second best distance."""
    trials: int = 400
    """RANSAC samples of three pairs."""
    least_pairs: int = 12
    """Fewest pairs that must agree."""
    gate_sigmas: float = 4.0
    """Largest distance of an agreeing pair, in standard deviations of its depth."""
    gate_least_m: float = 0.02
    """That distance is never less, metres."""
