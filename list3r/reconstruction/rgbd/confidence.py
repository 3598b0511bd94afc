"""Confidence of sensor depth: noise that grows with distance, grazing angles, and edges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.reconstruction.rgbd.settings import ConfidenceSettings
from list3r.reconstruction.rgbd.view import Floats, shrink_depth, surface


def depth_confidence(depth: Floats, camera: Camera, settings: ConfidenceSettings) -> NDArray[np.float16]:
    """Confidence in [0, 1] of each pixel, 0 where depth is unknown. Shape (H, W)."""
    known = depth > 0
    sigma = settings.noise.sigma(depth) * np.float32(1.0 / settings.half_sigma_m)
    confidence = np.where(known, 1.0 / (1.0 + sigma * sigma), np.float32(0))
    confidence *= _facing(depth, camera, settings)
    confidence[beside_edge(depth, known, settings.edge_step)] *= np.float32(settings.edge_confidence)
    return confidence.astype(np.float16)


def _facing(depth: Floats, camera: Camera, settings: ConfidenceSettings) -> Floats:
    """Factor of the grazing angle, measured on a small image. Shape (H, W)."""
    small = camera.shrunk(settings.working_width)
    points, normals, valid = surface(shrink_depth(depth, small, settings.noise), small)
    distance = np.sqrt(np.einsum("...i,...i->...", points, points))
    cosine = -np.einsum("...i,...i->...", points, normals) / np.maximum(distance, 1e-6)
    factor = np.where(valid, np.clip(cosine / settings.full_cosine, 0.0, 1.0), 0.5).astype(np.float32)
    return np.asarray(cv2.resize(factor, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR), np.float32)


def beside_edge(depth: Floats, known: NDArray[np.bool_], step: float) -> NDArray[np.bool_]:
    """Pixels next to a jump of depth by more than a share `step` of it. Shape (H, W)."""
    window = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(depth, window)
    lowest = cv2.erode(np.where(known, depth, np.float32(1e6)), window)
    return known & (highest - lowest > np.float32(2 * step) * depth)
