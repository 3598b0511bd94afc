"""Local features of a frame as one vector: VLAD over a fixed vocabulary (Jegou et al., "Aggregating local descriptors
into a compact image representation", 2010, with the normalisation within each word of Arandjelovic, Zisserman, "All
about VLAD", 2013).

The vocabulary is in this folder and was learned on simulated rooms, so that a chunk's descriptors depend on that
chunk alone, and frames of different videos can be compared (research/association 0061).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.sift import root_sift

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Vocabulary:
    """Words of local features."""

    mean: Floats
    """Mean RootSIFT descriptor. Shape (128,)."""
    axes: Floats
    """Principal directions. Shape (128, d)."""
    words: Floats
    """Centres of the words along those. Shape (K, d)."""

    @staticmethod
    @lru_cache(maxsize=1)
    def built_in() -> Vocabulary:
        """Return the vocabulary that comes with the package."""
        with np.load(Path(__file__).with_name("vocabulary.npz"), allow_pickle=False) as data:
            return Vocabulary(*(data[name].astype(np.float32) for name in ("mean", "axes", "words")))

    def reduced(self, rooted: Floats) -> Floats:
        """Return RootSIFT descriptors (N, 128) along the principal directions (N, d)."""
        return np.asarray((rooted - self.mean) @ self.axes)


def describe_frame(local_descriptors: NDArray[np.uint8]) -> Floats:
    """Return the unit descriptor of a frame's SIFT descriptors (N, 128), zeros without any: residuals to their words.

    Shape (words * d,).
    """
    return describe_rooted(root_sift(local_descriptors))


def describe_rooted(rooted: Floats) -> Floats:
    """Return the same of descriptors that are RootSIFT already, (N, 128)."""
    v = Vocabulary.built_in()
    if not len(rooted):
        return np.zeros(v.words.size, np.float32)
    x = v.reduced(rooted)
    word = np.argmin((v.words**2).sum(axis=1) - 2.0 * x @ v.words.T, axis=1)
    sums = np.zeros(v.words.shape, np.float64)
    np.add.at(sums, word, x - v.words[word])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    rooted = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray(rooted.ravel() / max(float(np.linalg.norm(rooted)), 1e-9), np.float32)
