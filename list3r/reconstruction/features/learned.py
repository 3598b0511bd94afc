"""What learned local features are, and how they are matched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LearnedFeatures:
    """Local features of one picture, N of them, the surest first."""

    xy: NDArray[np.float32]
    """px. Shape (N, 2)."""
    descriptors: NDArray[np.float32]
    """Unit vectors. Shape (N, D)."""
    score: NDArray[np.float32]
    """In [0, 1]. Shape (N,)."""


class LearnedDetector(Protocol):
    """A network that detects and describes."""

    kind: str
    """aliked or xfeat."""

    def __call__(self, color: NDArray[np.uint8], count: int) -> LearnedFeatures:
        """The `count` surest features of a picture (H, W, 3)."""
        ...


def match_unit(a: NDArray[np.float32], b: NDArray[np.float32], min_cosine: float = 0.7) -> NDArray[np.int64]:
    """Mutual nearest neighbours of unit descriptors (N, D), (M, D) with at least this cosine. Shape (K, 2)."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64)
    cosine = a @ b.T
    forth, back = cosine.argmax(axis=1), cosine.argmax(axis=0)
    rows = np.flatnonzero((back[forth] == np.arange(len(a))) & (cosine.max(axis=1) >= min_cosine))
    return np.stack([rows, forth[rows]], axis=1)


WIDTHS = {"aliked": 256, "xfeat": 130}
"""Bytes of a stored descriptor, no two kinds alike and none like SIFT's 128, so that the width names the kind."""


def as_bytes(descriptors: NDArray[np.float32], kind: str) -> NDArray[np.uint8]:
    """Unit descriptors (N, D) as bytes (N, `WIDTHS`) whose square roots, made unit, have about the same inner products.

    Positive and negative parts are kept apart and squared, so that what stores and matches RootSIFT serves these too;
    the rest is zeros.
    """
    halves = np.concatenate([np.maximum(descriptors, 0.0), np.maximum(-descriptors, 0.0)], axis=1) ** 2
    halves *= 255.0 / np.maximum(halves.max(axis=1, keepdims=True, initial=0.0), 1e-12)
    out = np.zeros((len(descriptors), WIDTHS[kind]), np.uint8)
    out[:, : halves.shape[1]] = np.rint(halves)
    return out
