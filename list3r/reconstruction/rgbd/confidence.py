"""Confidence of sensor depth: noise that grows with distance, grazing angles, and edges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled
from list3r.frames.base import Camera
from list3r.reconstruction.rgbd.settings import ConfidenceSettings
from list3r.reconstruction.rgbd.view import Floats, cosines, shrink_depth, surface

_BEYOND = 1e6
"""Farther than any depth, metres."""


def depth_confidence(
    depth: Floats, camera: Camera, settings: ConfidenceSettings, cosine: Floats | None = None
) -> NDArray[np.float16]:
    """Confidence in [0, 1] of each pixel, 0 where depth is unknown. Shape (H, W).

    `cosine` is the result of `cosines` for the depth at a small size, where that is known already.
    """
    window, noise = np.ones((3, 3), np.uint8), settings.noise
    lowest = cv2.erode(np.where(depth > 0, depth, np.float32(_BEYOND)), window)
    law = noise.constant_m, noise.quadratic_per_m, noise.nearest_m, settings.half_sigma_m
    edge = 2 * settings.edge_step, settings.edge_confidence
    facing = _facing(_cosines(depth, camera, settings) if cosine is None else cosine, camera, settings)
    found = _confidence(depth, cv2.dilate(depth, window) - lowest, facing, law, edge)
    return found.astype(np.float16)


@compiled
def _confidence(
    depth: Floats, relief: Floats, facing: Floats, law: tuple[float, float, float, float], edge: tuple[float, float]
) -> Floats:
    """Confidence of each pixel, by its depth, its depth step, and its viewing angle. Shape (H, W).

    `law` is that of `SensorNoise` and the noise at which confidence is one half, metres; `edge` the depth step of an
    edge, as a share of depth, and the factor there.
    """
    out = np.zeros(depth.shape, np.float32)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if z > 0:
                sigma = (law[0] + law[1] * (z - law[2]) * (z - law[2])) / law[3]
                found = facing[row, column] / (1 + sigma * sigma)
                out[row, column] = found * edge[1] if relief[row, column] > edge[0] * z else found
    return out


def _cosines(depth: Floats, camera: Camera, settings: ConfidenceSettings) -> Floats:
    small = camera.shrunk(settings.working_width)
    return cosines(*surface(shrink_depth(depth, small, settings.noise), small))


def _facing(cosine: Floats, camera: Camera, settings: ConfidenceSettings) -> Floats:
    """Factor of the grazing angle, from small cosines (h, w). Shape (H, W)."""
    factor = np.where(np.isnan(cosine), 0.5, np.clip(cosine / settings.full_cosine, 0.0, 1.0)).astype(np.float32)
    return np.asarray(cv2.resize(factor, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR), np.float32)


def next_to_edge(depth: Floats, known: NDArray[np.bool_], step: float) -> NDArray[np.bool_]:
    """Pixels next to a jump of depth by more than a share `step` of it. Shape (H, W)."""
    window = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(depth, window)
    lowest = cv2.erode(np.where(known, depth, np.float32(_BEYOND)), window)
    return known & (highest - lowest > np.float32(2 * step) * depth)
