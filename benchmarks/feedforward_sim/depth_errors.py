"""Errors of the depth that a simulated feed-forward model gives to pixels, and how sure it says it is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.feedforward_sim.runs import runs_of
from benchmarks.simulation.video import SimulatedVideo

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class DepthErrorSettings:
    """Errors of depth as shares of it, and confidence.

    Together they put depth off by 3 % on average. Confidence ranks pixels by their true error with a Spearman
    coefficient of 0.35 to 0.5. It is wrong in three ways: plain surfaces and runs of frames
    (`PoseErrorSettings.glitch_rate`) that are wrong but confident, and good objects of low confidence, for which the
    paper blames the loss of tables and chairs in confidence-only support (3.2).
    """

    noise: float = 0.006
    """Deviation of depth near the camera."""
    noise_per_m: float = 0.005
    """Growth of the deviation with depth, 1/m."""
    patch_share: float = 0.7
    """Share of the noise's deviation that comes in patches over the picture and lasts over frames; the rest is the
    pixel's own."""
    bland: float = 0.025
    """Deviation of an error in wide patches over walls, floors and ceilings, which offer little to match."""
    bland_known: float = 0.4
    """Share of that error that the confidence goes by: it is mostly wrong and confident."""
    flying_share: float = 0.35
    """Share of the pixels next to a jump of depth that float between its sides."""
    jump: float = 0.05
    """Relative difference between neighbours that counts as a jump."""
    lasting_frames: float = 6.0
    """Frames over which patches last."""
    focal: float = 0.01
    """Deviation of the logarithm of the focal length that goes with a chunk."""
    half_error: float = 0.03
    """Relative error at which confidence is one half."""
    knowing: float = 0.6
    """Share in the confidence of the true error; the rest comes from the error to be expected there."""
    confidence_noise: float = 0.35
    """Deviation of the logarithm of the error that the confidence goes by."""
    doubted_share: float = 0.35
    """Share of the objects in a chunk that are right and yet doubted (chairs and tables from a new side)."""
    doubted_factor: tuple[float, float] = (0.08, 0.8)
    """Median and deviation of the logarithm of the factor on their confidence."""


def focal_factor(settings: DepthErrorSettings, seed: list[int]) -> float:
    """Factor on the focal length that the model believes in."""
    return float(np.exp(settings.focal * np.random.default_rng([*seed, 21]).standard_normal()))


def wrong_depth(
    video: SimulatedVideo, frames: NDArray[np.int64], settings: DepthErrorSettings, seed: list[int]
) -> tuple[Floats, Floats]:
    """Depth factors, 1 where right, and confidence in [0, 1] of the pixels of frames. Two of shape (F, H, W)."""
    rng = np.random.default_rng([*seed, 22])
    depth = video.depth[frames]
    sigma = (settings.noise + settings.noise_per_m * depth).astype(np.float32)
    own = np.float32(np.sqrt(1 - settings.patch_share**2)) * rng.standard_normal(depth.shape, dtype=np.float32)
    error = sigma * (np.float32(settings.patch_share) * patches(frames, depth.shape[1:], (6, 8), settings, rng) + own)
    floating, at_jump = _floating(depth, settings, rng)
    error = np.where(floating != 0, floating, error)
    expected = np.where(at_jump, 2 * settings.jump, sigma)
    bland = settings.bland * patches(frames, depth.shape[1:], (3, 4), settings, rng) * structure_mask(video, frames)
    factor = np.maximum(1 + error, 0.2) * np.exp(bland)
    mist = patches(frames, depth.shape[1:], (6, 8), settings, rng)
    felt = settings.knowing * np.abs(error + settings.bland_known * bland) + (1 - settings.knowing) * expected
    felt = felt * np.exp(settings.confidence_noise * mist)
    confidence = 1 / (1 + (felt / settings.half_error) ** 2) * _doubt(video, frames, settings, rng)
    return factor.astype(np.float32), np.where(depth > 0, confidence, 0).astype(np.float32)


def patches(
    frames: NDArray[np.int64],
    shape: tuple[int, int],
    cells: tuple[int, int],
    settings: DepthErrorSettings,
    rng: np.random.Generator,
) -> Floats:
    """Noise of unit deviation that is smooth over the picture and over frames that follow on one another. (F, H, W)."""
    coarse = rng.standard_normal((len(frames), *cells))
    for run in runs_of(frames):
        kept = gaussian_filter1d(coarse[run], settings.lasting_frames / 2, axis=0, mode="wrap")
        coarse[run] = kept / max(float(kept.std()), 1e-9)
    size = (shape[1], shape[0])
    fine = np.stack([cv2.resize(c, size, interpolation=cv2.INTER_CUBIC) for c in coarse.astype(np.float32)])
    return np.asarray(fine / max(float(fine.std()), 1e-9), np.float32)


def structure_mask(video: SimulatedVideo, frames: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Pixels of walls, floors and ceilings. Shape (F, H, W)."""
    ids = [t.id for t in video.world.objects if t.structure is not None]
    return np.isin(video.ids[frames], ids)


def _floating(
    depth: Floats, settings: DepthErrorSettings, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.bool_]]:
    """Relative errors of pixels that float between the sides of a jump, 0 elsewhere; where jumps are."""
    kernel = np.ones((3, 3), np.uint8)
    near = np.stack([cv2.erode(d, kernel) for d in depth])
    far = np.stack([cv2.dilate(d, kernel) for d in depth])
    z = np.maximum(depth, 1e-3)
    at_jump = (far - near > 2 * settings.jump * z) & (near > 0)
    bend = np.abs(depth - (near + far) / 2) > 0.25 * (far - near)
    at_jump &= bend
    share = rng.random(depth.shape, dtype=np.float32)
    chosen = at_jump & (rng.random(depth.shape, dtype=np.float32) < settings.flying_share)
    return np.where(chosen, (near + share * (far - near)) / z - 1, 0).astype(np.float32), at_jump


def _doubt(
    video: SimulatedVideo, frames: NDArray[np.int64], settings: DepthErrorSettings, rng: np.random.Generator
) -> Floats:
    """Factors on the confidence: objects that are doubted without cause. Shape (F, H, W)."""
    top = max(int(video.ids.max()), max((t.id for t in video.world.objects), default=0))
    doubted = rng.random(top + 1) < settings.doubted_share
    median, spread = settings.doubted_factor
    factor = np.minimum(median * np.exp(spread * rng.standard_normal(top + 1)), 1.0)
    for obj in video.world.objects:
        doubted[obj.id] &= obj.structure is None
    doubted[[0, *(m.id for m in video.movers)]] = False
    return np.where(doubted, factor, 1.0).astype(np.float32)[video.ids[frames]]
