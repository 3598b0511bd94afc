"""Descriptors of whole frames: what finds a place again. The default is `vlad`; here the protocol and an older kind.

`WordsDescriptor` tells what local features occur, and how brightness edges are laid out: a histogram of local features
over cells of seeded random hyperplanes (locality-sensitive hashing: Charikar, "Similarity estimation techniques from
rounding algorithms", 2002), which does not care where in the image a thing is; and a grid of gradient orientations (in
the manner of GIST: Oliva, Torralba, "Modeling the shape of the scene", 2001), which does.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.rgbd.view import Floats


class FrameDescriptor(Protocol):
    """A kind of frame descriptor; `association.frame_search` holds what its cosines mean, by its length."""

    @property
    def length(self) -> int:
        """Numbers in a descriptor."""
        ...

    def __call__(self, color: NDArray[np.uint8], local_descriptors: NDArray[np.uint8]) -> Floats:
        """Unit-length descriptor of an RGB image (H, W, 3) and its SIFT descriptors (N, 128). Shape (length,)."""
        ...


@dataclass(frozen=True)
class DescriptorSettings:
    """Layout of the frame descriptor; its length is tables * 2^bits + 8 * grid^2."""

    tables: int = 4
    """Independent hash tables of local features."""
    bits: int = 6
    """Hyperplanes in a table."""
    grid: int = 4
    """Cells across and down for the gradients."""
    layout_share: float = 0.25
    """Share of the layout half in the cosine."""

    @property
    def length(self) -> int:
        """Numbers in a descriptor."""
        return int(self.tables * 2**self.bits + 8 * self.grid**2)


@dataclass(frozen=True)
class WordsDescriptor:
    """A `FrameDescriptor` by hashed words and a layout of gradients."""

    settings: DescriptorSettings = field(default_factory=DescriptorSettings)

    @property
    def length(self) -> int:
        """Numbers in a descriptor."""
        return self.settings.length

    def __call__(self, color: NDArray[np.uint8], local_descriptors: NDArray[np.uint8]) -> Floats:
        """See `frame_descriptor`."""
        return frame_descriptor(color, local_descriptors, self.settings)


def frame_descriptor(
    color: NDArray[np.uint8], local_descriptors: NDArray[np.uint8], settings: DescriptorSettings
) -> Floats:
    """Unit-length descriptor of an RGB image and its SIFT descriptors (N, 128). Shape (settings.length,)."""
    words, layout = _words(local_descriptors, settings), _layout(color, settings.grid)
    share = settings.layout_share
    joined = np.concatenate([np.sqrt(1.0 - share) * _unit(words), np.sqrt(share) * _unit(layout)])
    return _unit(joined).astype(np.float32)


@lru_cache(maxsize=4)
def _planes(tables: int, bits: int) -> Floats:
    """Differences of random groups of bins: nearly balanced on any picture, with nothing learned. Shape (T b, 128)."""
    rng = np.random.default_rng(20250611)
    planes = np.zeros((tables * bits, 128), np.float32)
    for plane in planes:
        chosen = rng.permutation(128)[:32]
        plane[chosen[:16]], plane[chosen[16:]] = 1.0, -1.0
    return planes


def _words(descriptors: NDArray[np.uint8], settings: DescriptorSettings) -> NDArray[np.float64]:
    tables, bits = settings.tables, settings.bits
    counts = np.zeros(tables * 2**bits)
    if len(descriptors):
        root = np.sqrt(descriptors.astype(np.float32))
        side = (root @ _planes(tables, bits).T > 0).reshape(len(root), tables, bits)
        cell = side @ (1 << np.arange(bits)) + np.arange(tables) * 2**bits
        counts += np.bincount(cell.ravel(), minlength=len(counts))
    root_counts = np.sqrt(counts)
    return np.asarray(root_counts - root_counts.mean())


def _layout(color: NDArray[np.uint8], grid: int) -> NDArray[np.float64]:
    size = grid * 16
    gray = cv2.cvtColor(cv2.resize(color, (size, size), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    dx = cv2.Sobel(gray, cv2.CV_32F, 1, 0)
    dy = cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    strength = np.sqrt(np.hypot(dx, dy))
    bin_ = (np.arctan2(dy, dx) / (2 * np.pi) * 8).astype(np.int64) % 8
    cell = (np.arange(size) // 16)[:, None] * grid + (np.arange(size) // 16)[None]
    histogram = np.bincount((cell * 8 + bin_).ravel(), strength.ravel().astype(np.float64), minlength=8 * grid * grid)
    return np.asarray(histogram - histogram.mean())


def _unit(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(v / max(float(np.linalg.norm(v)), 1e-12))
