"""What cameras make of perfect pictures: four kinds of depth and one of colour."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.reconstruction.base import DepthNoise
from training.worlds.render import Picture

Floats = NDArray[np.float32]

SENSORS = ("structured", "tof", "lidar", "computed")
HELD_OUT_SENSORS = ("tof",)


@dataclass(frozen=True)
class Reading:
    """One frame as a camera hands it out."""

    color: NDArray[np.uint8]
    """RGB. Shape (H, W, 3)."""
    depth: Floats
    """Metres, 0 where unknown. Shape (H, W)."""


def depth_noise(sensor: str) -> DepthNoise | None:
    """Return what a reconstruction says of the noise of depth that was computed, None for a sensor's."""
    return DepthNoise(0.004, 0.003, 0.02) if sensor == "computed" else None


def read(picture: Picture, sensor: str, rng: np.random.Generator, drift: Floats, patches: float = 0.0) -> Reading:
    """Return the noisy reading of a picture.

    `drift` is the shared error of computed depth, see `drift_field`; `patches` by how much, as a share of depth, what
    has little texture is off in steps.
    """
    models = {"structured": _structured, "tof": _time_of_flight, "lidar": _lidar}
    depth = _computed(picture, rng, drift, patches) if sensor == "computed" else models[sensor](picture, rng)
    if sensor != "computed":
        depth = np.where(_patchy(rng, depth.shape) < picture.glass, 0, depth)
    return Reading(_color(picture, rng), depth.astype(np.float32))


def drift_field(shape: tuple[int, int], rng: np.random.Generator) -> Floats:
    """Return a smooth field of unit deviation that neighbouring frames share. Shape (H, W)."""
    coarse = rng.standard_normal((8, 10)).astype(np.float32)
    field = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field / field.std(), np.float32)


def _patchy(rng: np.random.Generator, shape: tuple[int, ...]) -> Floats:
    """Return numbers in [0, 1] that neighbours share. Shape (H, W)."""
    coarse = rng.random((shape[0] // 12, shape[1] // 12)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR))


def _noise(rng: np.random.Generator, shape: tuple[int, ...], blur_px: float) -> Floats:
    noise = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), blur_px)
    return np.asarray(noise / noise.std(), np.float32)


def _edges(depth: Floats, step: float) -> NDArray[np.bool_]:
    near, far = cv2.erode(depth, np.ones((3, 3), np.uint8)), cv2.dilate(depth, np.ones((3, 3), np.uint8))
    return np.asarray(far - near > step * np.maximum(near, 0.1) + 0.02)


def _shifted(depth: Floats, rng: np.random.Generator, deviation_px: float) -> Floats:
    """Return depth read at places off by some pixels."""
    h, w = depth.shape
    x = np.arange(w, dtype=np.float32)[None] + deviation_px * rng.standard_normal((h, w), dtype=np.float32)
    y = np.arange(h, dtype=np.float32)[:, None] + deviation_px * rng.standard_normal((h, w), dtype=np.float32)
    return np.asarray(cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE))


def _structured(picture: Picture, rng: np.random.Generator) -> Floats:
    """A first Kinect: noise quadratic in depth, quantised disparity, shadows, lost edges."""
    z = picture.depth
    edge = _edges(z, 0.03)
    z = np.where(edge, _shifted(z, rng, 0.7), z)
    z = z + (0.0012 + 0.0019 * z * z) * _noise(rng, z.shape, 0.8)
    steps = np.rint(1 / np.maximum(z, 1e-3) / 0.0028)
    z = 1 / np.maximum(steps * 0.0028, 1e-3)
    chance = rng.random((3, *z.shape)).astype(np.float32)
    lost = (chance[0] > (picture.cosine - 0.07) / 0.14) | (edge & (chance[1] < 0.4)) | (chance[2] < 0.003)
    return np.where(lost | (picture.depth < 0.4) | (picture.depth > 5.0), 0, z).astype(np.float32)


def _time_of_flight(picture: Picture, rng: np.random.Generator) -> Floats:
    """A time-of-flight camera: linear noise, flying pixels at edges, dark surfaces noisy, corners bent by multipath."""
    z = picture.depth
    light = picture.color.mean(axis=2) / 255.0
    smooth = cv2.blur(z, (9, 9))
    edge = _edges(z, 0.03)
    mixed = cv2.blur(z, (3, 3))
    z = np.where(edge & (rng.random(z.shape) < 0.5), mixed, z)
    z = z + 0.25 * np.clip(smooth - z, -0.02, 0.02)
    deviation = (0.0015 + 0.0012 * z) / np.sqrt(np.clip(light, 0.06, 1.0))
    z = z + deviation * _noise(rng, z.shape, 0.5)
    lost = (rng.random(z.shape) > (picture.cosine - 0.04) / 0.1) | (light < 0.02)
    return np.where(lost | (picture.depth < 0.25) | (picture.depth > 5.5), 0, z).astype(np.float32)


def _lidar(picture: Picture, rng: np.random.Generator) -> Floats:
    """A phone's LiDAR: sparse dots guided up to 256 x 192, so that edges are soft and thin things vanish."""
    h, w = picture.depth.shape
    tiny = cv2.resize(_shifted(picture.depth, rng, 0.5), (w // 4, h // 4), interpolation=cv2.INTER_NEAREST)
    tiny = tiny * (1 + 0.004 * _noise(rng, tiny.shape, 0.8))
    guide = cv2.resize(
        cv2.cvtColor(picture.color / 255.0, cv2.COLOR_RGB2GRAY), (256, 192), interpolation=cv2.INTER_AREA
    )
    depth = cv2.resize(tiny, (256, 192), interpolation=cv2.INTER_LINEAR)
    sharp = cv2.resize(picture.depth, (256, 192), interpolation=cv2.INTER_NEAREST)
    soft = cv2.GaussianBlur(np.abs(cv2.Laplacian(guide, cv2.CV_32F)), (0, 0), 1.5) > 0.02
    depth = np.where(soft, 0.5 * depth + 0.5 * sharp, depth)
    depth = cv2.resize(depth.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    spread = cv2.dilate(depth, np.ones((7, 7), np.uint8)) - cv2.erode(depth, np.ones((7, 7), np.uint8))
    lost = (spread > 0.25 * depth) | (picture.depth > 5.0) | (picture.depth < 0.2)
    return np.where(lost, 0, depth).astype(np.float32)


def _computed(picture: Picture, rng: np.random.Generator, drift: Floats, patches: float) -> Floats:
    """Depth of a network or of stereo: bent surfaces, edges too wide, holes where nothing is to be matched.

    With `patches`, a share of depth, what has little texture falls into patches that stand before or behind it.
    """
    z = picture.depth
    z = z * (1 + 0.008 * drift + 0.0015 * _noise(rng, z.shape, 3.0))
    gray = cv2.cvtColor(picture.color / 255.0, cv2.COLOR_RGB2GRAY)
    texture = cv2.GaussianBlur(np.abs(cv2.Laplacian(gray, cv2.CV_32F)), (0, 0), 4.0)
    z = z * (1 + patches * np.exp(-texture / 0.02) * np.rint(1.5 * drift) / 1.5)
    size = 7
    near = cv2.erode(z, np.ones((size, size), np.uint8))
    wide = _patchy(rng, z.shape) < 0.6
    z = np.where(wide & (z - near > 0.05 * z), near, z)
    blank = (texture < 0.003) & (_patchy(rng, z.shape) < 0.35)
    return np.where(blank | (picture.depth <= 0) | (picture.depth > 6.0), 0, z).astype(np.float32)


def _color(picture: Picture, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Colour through a lens, with exposure, noise and motion blur."""
    color = cv2.GaussianBlur(picture.color, (0, 0), 0.5)
    if rng.random() < 0.25:
        length = int(rng.integers(2, 6))
        kernel = np.zeros((5, 5), np.float32)
        cv2.line(kernel, (2 - length // 2, 2), (2 + length // 2, 2 + int(rng.integers(-1, 2))), 1.0)
        color = cv2.filter2D(color, -1, kernel / kernel.sum())
    color = color * rng.uniform(0.93, 1.07)
    noisy = color + np.sqrt(1.4 + 0.025 * np.clip(color, 0, 255)) * rng.standard_normal(color.shape, dtype=np.float32)
    return np.asarray(np.clip(noisy + 0.5, 0, 255), np.uint8)
