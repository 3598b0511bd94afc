"""Learned local features: a network's output, and how descriptors are stored as bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEARNED_WIDTH = 256
"""Bytes of a stored descriptor, unlike SIFT's 128, so that the width names the kind."""


@dataclass(frozen=True)
class LearnedFeatures:
    """Local features of one picture, N of them, best first."""

    xy: NDArray[np.float32]
    """px. Shape (N, 2)."""
    descriptors: NDArray[np.float32]
    """Unit vectors. Shape (N, D)."""
    score: NDArray[np.float32]
    """In [0, 1]. Shape (N,)."""


LearnedDetector = Callable[[NDArray[np.uint8], int], LearnedFeatures]
"""A network that returns at most so many of the most confident features of a picture (H, W, 3)."""


def as_bytes(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return unit descriptors (N, D) as bytes (N, 256) whose square roots, made unit, have about the same products.

    Positive and negative parts are kept apart and squared, so that storing and matching are those of RootSIFT; the rest
    is zeros.
    """
    halves = np.concatenate([np.maximum(descriptors, 0.0), np.maximum(-descriptors, 0.0)], axis=1) ** 2
    halves *= 255.0 / np.maximum(halves.max(axis=1, keepdims=True, initial=0.0), 1e-12)
    out = np.zeros((len(descriptors), LEARNED_WIDTH), np.uint8)
    out[:, : halves.shape[1]] = np.rint(halves)
    return out
