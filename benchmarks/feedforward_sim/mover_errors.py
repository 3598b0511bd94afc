"""Errors of a simulated feed-forward model on moving objects. // Such models are trained on static scenes. They place a
mover's points by neighbouring views: late, early, as if static, nearer or farther, each chunk in its own way, at times
with full confidence; and a large mover drags the camera along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.feedforward_sim.runs import runs_of
from benchmarks.simulation.video import MoverTruth, SimulatedVideo

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class MoverErrorSettings:
    """Errors on objects that move."""

    lag_s: float = 0.5
    """Deviation of how late (or early) a chunk places a mover, seconds."""
    frozen_share: float = 0.35
    """Share of the chunks that place a mover partly where it was on average."""
    frozen_window_s: float = 2.0
    """Over how long that average is taken, seconds."""
    depth: float = 0.20
    """Deviation of the logarithm of the factor on a mover's depth. No published figure was at hand: it is set to
    several times the error on static surfaces, as parallax and motion are ambiguous there."""
    steady_share: float = 0.7
    """Share of that deviation that a chunk keeps to; the rest comes and goes over `lasting_frames`."""
    lasting_frames: float = 20.0
    least_confidence: float = 0.35
    """The factor on a mover's confidence is between this and 1, the same for a chunk."""
    pull: float = 0.04
    """Motion of the camera, as a share of the mover's motion, for a mover that fills the picture."""


@dataclass(frozen=True)
class MoverErrors:
    """Errors that movers bring into a run of frames."""

    shift_m: Floats | None
    """Offsets to true points, world axes, metres; None without movers. Shape (F, H, W, 3)."""
    depth_factor: Floats
    """Shape (F, H, W)."""
    confidence_factor: Floats
    """Shape (F, H, W)."""
    pull_m: NDArray[np.float64]
    """Error of the camera's place, world axes, metres. Shape (F, 3)."""


def mover_errors(
    video: SimulatedVideo, frames: NDArray[np.int64], settings: MoverErrorSettings, seed: list[int]
) -> MoverErrors:
    """The errors of movers in frames that are reconstructed together."""
    rng = np.random.default_rng([*seed, 51])
    ids = video.ids[frames]
    depth, sure = np.ones(ids.shape, np.float32), np.ones(ids.shape, np.float32)
    shift = np.zeros((*ids.shape, 3), np.float32) if video.movers else None
    pull = np.zeros((len(frames), 3))
    for mover in video.movers:
        lag, frozen, amount, far, confidence = (
            settings.lag_s * rng.standard_normal(),
            rng.random() < settings.frozen_share,
            rng.uniform(0.4, 1.0),
            np.exp(settings.depth * _steady(frames, settings, rng)),
            rng.uniform(settings.least_confidence, 1.0),
        )
        mask = ids == mover.id
        if not mask.any() or shift is None:
            continue
        true = mover.T_world_object[frames, :3, 3]
        placed = _late(video, mover, frames, lag)
        if frozen:
            placed = placed + amount * (_average(video, mover, frames, settings.frozen_window_s) - placed)
        moves = np.ptp(mover.T_world_object[frames, :3, 3], axis=0).max() > 1e-3
        if moves:
            depth = np.where(mask, far[:, None, None], depth).astype(np.float32)
            sure[mask] = confidence
        shift += mask[..., None] * (placed - true).astype(np.float32)[:, None, None]
        share = mask.mean(axis=(1, 2))
        pull += settings.pull * share[:, None] * (true - true.mean(axis=0))
    return MoverErrors(shift, depth, sure, pull)


def _steady(frames: NDArray[np.int64], settings: MoverErrorSettings, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise of unit deviation, part of it the same in all frames. Shape (F,)."""
    own = rng.standard_normal(len(frames))
    for run in runs_of(frames):
        own[run] = gaussian_filter1d(own[run], settings.lasting_frames / 2, mode="wrap")
    own /= max(float(np.sqrt(np.mean(own**2))), 1e-9)
    lasting = settings.steady_share * rng.standard_normal()
    return np.asarray(lasting + np.sqrt(1 - settings.steady_share**2) * own)


def _late(video: SimulatedVideo, mover: MoverTruth, frames: NDArray[np.int64], lag_s: float) -> NDArray[np.float64]:
    """Where the mover was `lag_s` before each frame. Shape (F, 3)."""
    place = mover.T_world_object[:, :3, 3]
    return np.stack([np.interp(video.time_s[frames] - lag_s, video.time_s, place[:, k]) for k in range(3)], axis=1)


def _average(
    video: SimulatedVideo, mover: MoverTruth, frames: NDArray[np.int64], window_s: float
) -> NDArray[np.float64]:
    """Where the mover was on average about each frame. Shape (F, 3)."""
    steps = np.linspace(-window_s / 2, window_s / 2, 9)
    return np.asarray(np.mean([_late(video, mover, frames, float(step)) for step in steps], axis=0))
