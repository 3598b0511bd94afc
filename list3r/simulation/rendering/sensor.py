"""A real RGB-D camera's errors, added to a perfect picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.simulation.rendering.render import RenderedFrame

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class SensorSettings:
    """Noise of a structured-light camera of the first Kinect's kind, and of its colour camera."""

    depth_sigma_m: float = 0.0015
    """Deviation of depth at zero distance, metres; the floor that Nguyen et al. (2012) find near 0.4 m."""
    depth_sigma_per_m: float = 0.0019
    """Growth of the deviation with the square of depth, 1/m (Nguyen et al. 2012; Khoshelham and Elberink 2012)."""
    disparity_step_per_m: float = 0.0028
    """Step in which inverse depth is quantised, 1/m: 1/8 px of disparity over focal length 580 px and base 75 mm."""
    noise_patch_px: float = 0.7
    """Blur of the noise: block matching makes neighbouring errors alike. Pixels at 320x240."""
    range_m: tuple[float, float] = (0.4, 5.0)
    """Depth that the sensor reports."""
    grazing_cosine: tuple[float, float] = (0.08, 0.22)
    """Every reading is lost below the first cosine of incidence, none above the second."""
    edge_jitter_px: float = 0.5
    """Deviation of the place at which depth is read; frays the edges by about a pixel (Nguyen et al.: 0.8 px)."""
    edge_step: float = 0.03
    """Relative jump between neighbours that counts as an edge."""
    edge_dropout: float = 0.35
    """Share of readings lost next to an edge."""
    dropout: float = 0.002
    """Share of readings lost anywhere."""
    optics_px: float = 0.5
    """Blur of the lens and the pixel's own area."""
    read_noise: float = 1.2
    """Deviation of dark pixels, of 255."""
    shot_noise: float = 0.02
    """Variance for each unit of brightness: 2.3 of 255 in the middle of the range, as of a webcam in lamp light."""
    exposure: float = 0.03
    """Amplitude of the slow drift of exposure."""
    noise: bool = True
    """False gives the perfect picture and depth, still limited to the range."""


@dataclass(frozen=True)
class SensedFrame:
    """The camera's output."""

    color: NDArray[np.uint8]
    """RGB. Shape (H, W, 3)."""
    depth: Floats
    """Metres, 0 where unknown. Shape (H, W)."""


def sense(frame: RenderedFrame, settings: SensorSettings, seed: int, index: int, time_s: float) -> SensedFrame:
    """Return the noisy reading of a rendered frame; the same for the same seed and index."""
    low, high = settings.range_m
    if not settings.noise:
        depth = np.where((frame.depth >= low) & (frame.depth <= high), frame.depth, 0).astype(np.float32)
        return SensedFrame(np.clip(frame.color + 0.5, 0, 255).astype(np.uint8), depth)
    rng = np.random.default_rng([seed, 3, index])
    return SensedFrame(_color(frame, settings, rng, seed, time_s), _depth(frame, settings, rng))


def _color(
    frame: RenderedFrame, settings: SensorSettings, rng: np.random.Generator, seed: int, time_s: float
) -> NDArray[np.uint8]:
    phase = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi, 2)
    drift = np.sin(0.9 * time_s + phase[0]) + 0.5 * np.sin(2.1 * time_s + phase[1])
    light = cv2.GaussianBlur(frame.color, (0, 0), settings.optics_px) * np.float32(1 + settings.exposure * drift / 1.5)
    sigma = np.sqrt(settings.read_noise**2 + settings.shot_noise * light)
    noisy = light + sigma * rng.standard_normal(light.shape, dtype=np.float32)
    return np.asarray(np.clip(noisy + 0.5, 0, 255), dtype=np.uint8)


def _depth(frame: RenderedFrame, settings: SensorSettings, rng: np.random.Generator) -> Floats:
    height, width = frame.depth.shape
    place = rng.standard_normal((2, height, width), dtype=np.float32) * settings.edge_jitter_px
    column = np.clip(np.rint(np.arange(width) + place[0]), 0, width - 1).astype(np.int64)
    row = np.clip(np.rint(np.arange(height)[:, None] + place[1]), 0, height - 1).astype(np.int64)
    edge = _edges(frame.depth, settings.edge_step)
    z = np.where(edge, frame.depth[row, column], frame.depth)
    patch = cv2.GaussianBlur(
        rng.standard_normal((height, width), dtype=np.float32), (0, 0), settings.noise_patch_px * width / 320
    )
    z = z + (settings.depth_sigma_m + settings.depth_sigma_per_m * z * z) * patch / patch.std()
    steps = np.rint(1 / np.maximum(z, 1e-3) / settings.disparity_step_per_m)
    z = 1 / np.maximum(steps * settings.disparity_step_per_m, 1e-3)
    chance = rng.uniform(size=(4, height, width)).astype(np.float32)
    blind, sure = settings.grazing_cosine
    lost = chance[0] > (frame.incidence - blind) / (sure - blind)
    lost |= (edge & (chance[1] < settings.edge_dropout)) | (chance[2] < settings.dropout)
    low, high = settings.range_m
    lost |= (frame.depth < low) | (frame.depth > high) | (z < low) | (z > high)
    return np.where(lost, 0, z).astype(np.float32)


def _edges(depth: Floats, step: float) -> NDArray[np.bool_]:
    """Pixels next to a jump of depth, relative to the nearer side."""
    kernel = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    middle = (near + far) / 2
    curved = np.abs(depth - middle) > 0.25 * (far - near)
    return np.asarray((far - near > step * np.maximum(near, 0.1)) & curved)
