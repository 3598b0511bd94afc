"""SIFT features of grey pictures and their matches."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

SIFT_WIDTH = 128
RATIO = 0.85
"""Lowe's ratio of best to second best distance."""
CONTRAST = 0.015
"""SIFT's contrast threshold; low, so that plain rooms give some."""


def sift(
    gray: NDArray[np.uint8], count: int, width: int | None = None, contrast: float = CONTRAST
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return positions (N, 2), px, and descriptors (N, 128) of at most `count` features, strongest first.

    They are sought in a picture shrunk to a longer side of at most `width`.
    """
    factor = 1.0 if width is None else shrinkage(gray.shape, width)
    detector = cv2.SIFT.create(nfeatures=count, contrastThreshold=contrast)
    keypoints, descriptors = detector.detectAndCompute(shrunk(gray, factor), None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, SIFT_WIDTH), np.uint8)
    xy = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
    order = np.lexsort((xy[:, 0], xy[:, 1], -np.array([k.response for k in keypoints])))[:count]
    xy = xy[order] if factor == 1.0 else ((xy[order] + 0.5) / factor - 0.5).astype(np.float32)
    return xy, descriptors[order].astype(np.uint8)


def root_sift(descriptors: NDArray[np.uint8]) -> Floats:
    """Square roots of SIFT descriptors of unit sum, shape (N, 128).

    RootSIFT: Arandjelovic, Zisserman, "Three things everyone should know to improve object retrieval", 2012.
    """
    x = descriptors.astype(np.float32)
    return np.asarray(np.sqrt(x / np.maximum(x.sum(axis=1, keepdims=True), np.float32(1e-6))))


def nearest_pairs(a: Floats, b: Floats, ratio: float = RATIO) -> NDArray[np.int64]:
    """Mutual nearest neighbours of unit descriptors (N, D), (M, D) that pass the ratio test. Shape (K, 2)."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = a @ b.T
    forth, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    rows = np.flatnonzero(back[forth] == np.arange(len(a)))
    top = np.partition(likeness[rows], -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0))
    rows = rows[distance[:, 1] < ratio * distance[:, 0]]
    return np.stack([rows, forth[rows]], axis=1)


def shrinkage(shape: tuple[int, ...], width: int) -> float:
    """Return the factor by which a picture (h, w) is shrunk to a longer side of at most `width` px."""
    return min(1.0, width / max(shape))


def shrunk(gray: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    """Return a picture shrunk by a factor. Its point x is at (x + 0.5) / factor - 0.5 of the picture."""
    if factor == 1.0:
        return gray
    size = (round(gray.shape[1] * factor), round(gray.shape[0] * factor))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)
