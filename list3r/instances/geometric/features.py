"""Object features without weights: colour and metric shape, the same from every side as far as geometry allows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_CHROMA_BINS = 24
_LIGHT_BINS = 12


def object_feature(
    points: NDArray[np.float32], rgb: NDArray[np.uint8], up: NDArray[np.float64], unit: float
) -> NDArray[np.float32]:
    """Unit-length feature of an object from its surface points (N, 3), colours (N, 3) and the upward direction. (64,).

    Square roots of soft histograms (so that the inner product is the Bhattacharyya coefficient) of chroma and
    lightness, and soft codes of the sizes along and across the vertical and of flatness.
    """
    lab = cv2.cvtColor(rgb[None].astype(np.float32) / 255.0, cv2.COLOR_RGB2Lab)[0]
    blocks = [
        (1.0, _chroma_histogram(lab)),
        (0.5, _soft_histogram(lab[:, 0] / 100.0, _LIGHT_BINS)),
        (0.8, _shape_code(points, up, unit)),
    ]
    parts = [np.sqrt(weight) * block for weight, block in blocks]
    feature = np.concatenate(parts).astype(np.float32)
    return feature / max(float(np.linalg.norm(feature)), 1e-9)


COLOR_PART = _CHROMA_BINS + _LIGHT_BINS
"""The first numbers of a feature describe colour, the rest shape."""


def color_feature(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The colour part of `object_feature`, of unit length: usable without depth. (N, 3) -> (36,)."""
    lab = cv2.cvtColor(rgb[None].astype(np.float32) / 255.0, cv2.COLOR_RGB2Lab)[0]
    part = np.concatenate([_chroma_histogram(lab), np.sqrt(0.5) * _soft_histogram(lab[:, 0] / 100.0, _LIGHT_BINS)])
    return np.asarray(part / max(float(np.linalg.norm(part)), 1e-9), dtype=np.float32)


def mean_feature(features: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """z of the paper: the normalised weighted mean of unit features. Shape (N, D) -> (D,)."""
    mean = (features * weights[:, None]).sum(axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-9), dtype=np.float32)


def _soft_histogram(values: NDArray[np.float32], bins: int) -> NDArray[np.float64]:
    """Square roots of shares with linear interpolation between bin centres. Values in [0, 1] -> (bins,)."""
    at = np.clip(values, 0.0, 1.0) * (bins - 1)
    low = np.minimum(at.astype(np.int64), bins - 2)
    part = at - low
    count = np.bincount(low, 1.0 - part, minlength=bins) + np.bincount(low + 1, part, minlength=bins)
    smooth = np.convolve(count, [0.25, 0.5, 0.25], mode="same")
    return np.asarray(np.sqrt(smooth / max(smooth.sum(), 1e-9)))


def _chroma_histogram(lab: NDArray[np.float32]) -> NDArray[np.float64]:
    """Hue weighted by chroma in 23 circular bins, and the share without colour in the last."""
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    coloured = np.clip((chroma - 6.0) / 14.0, 0.0, 1.0)
    bins = _CHROMA_BINS - 1
    at = (np.arctan2(lab[:, 2], lab[:, 1]) / (2 * np.pi) % 1.0) * bins
    low = at.astype(np.int64) % bins
    part = at - np.floor(at)
    count = np.bincount(low, coloured * (1 - part), minlength=bins)
    count += np.bincount((low + 1) % bins, coloured * part, minlength=bins)
    smooth = 0.5 * count + 0.25 * (np.roll(count, 1) + np.roll(count, -1))
    full = np.append(smooth, np.sum(1.0 - coloured))
    return np.asarray(np.sqrt(full / max(full.sum(), 1e-9)))


def _shape_code(points: NDArray[np.float32], up: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    """Soft one-hot codes of log size along the vertical and across it, and flatness. (28,), unit length."""
    metres = points / unit
    height = np.ptp(np.quantile(metres @ up, [0.03, 0.97]))
    level = metres - np.outer(metres @ up, up)
    width = 2.0 * np.quantile(np.linalg.norm(level - np.median(level, axis=0), axis=1), 0.95)
    values = np.linalg.eigvalsh(np.cov(metres.T)) if len(metres) > 3 else np.zeros(3)
    flat = np.sqrt(max(values[0], 0.0) / max(values[2], 1e-12))
    codes = [_bump(np.log2(max(size, 0.01) / 0.01) / 9.0, 10) for size in (height, width)] + [_bump(flat * 2.0, 8)]
    code = np.concatenate(codes)
    return np.asarray(code / np.linalg.norm(code))


def _bump(value: float, bins: int) -> NDArray[np.float64]:
    """A Gaussian bump at `value` in [0, 1] over `bins` cells."""
    centres = np.linspace(0.0, 1.0, bins)
    out = np.exp(-0.5 * np.square((centres - np.clip(value, 0.0, 1.0)) * (bins - 1) / 1.3))
    return np.asarray(out / np.linalg.norm(out))


def lab_of(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Half lightness, a and b of colours in [0, 255]. Shape (N, 3)."""
    lab = cv2.cvtColor(np.ascontiguousarray(rgb[None]) / np.float32(255.0), cv2.COLOR_RGB2Lab)[0]
    return np.asarray(lab * np.array([0.5, 1.0, 1.0], np.float32), np.float32)
