"""Reconstruction `pi3x`, the successor of `pi3`: smoother, and can be told the intrinsics."""

from __future__ import annotations

from list3r.reconstruction.feedforward import FeedforwardReconstructor
from list3r.reconstruction.pi3 import Pi3
from list3r.reconstruction.registry import ModelOptions


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """The model with the weights that the options name."""
    return FeedforwardReconstructor(Pi3(conditional=True), options)
