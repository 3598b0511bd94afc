"""The weights of the learned discoverer."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from list3r.weights import Float, WeightsFormat

FORMAT = WeightsFormat("discovery", version=3)
SHIPPED = Path(__file__).with_name("weights.npz")
COMPUTED = Path(__file__).with_name("weights-computed.npz")
"""Shipped for computed depth: weights that also learned from few colours are worse there (research/discovery 0179)."""


@lru_cache(maxsize=4)
def load_weights(path: Path | None = None, *, sensed: bool = True) -> Mapping[str, Float]:
    """Return the weights of a file, by default the shipped ones, for depth that a sensor measured or that was computed.

    Raises `OptionError` for an invalid file.
    """
    fix = "make it again with training/train.py" if path else "install list3r again"
    return FORMAT.read(path or (SHIPPED if sensed else COMPUTED), fix)
