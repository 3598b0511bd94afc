"""A hand-held camera on its way through a world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from list3r.memory.core.errors import OptionError
from list3r.simulation.worlds.world import Stop

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PathSettings:
    """How the camera moves. The limits are those of a person who films a room on purpose."""

    fps: float = 12.0
    speed_m_s: float = 0.5
    """Upper bound of the speed along the path, before the hand's own motion."""
    turn_deg_s: float = 33.0
    """Upper bound of the turning rate along the path, before the hand's own motion."""
    sway_m: float = 0.004
    """Deviation of the hand's own motion, about 1 Hz."""
    sway_deg: float = 0.25
    """Deviation of the hand's own rotation, about 1 Hz."""

    def __post_init__(self) -> None:
        if not (self.fps > 0 and self.speed_m_s > 0 and self.turn_deg_s > 0):
            raise OptionError("fps, speed and turning rate of a walk must be greater than 0")


def walk_duration(stops: tuple[Stop, ...], settings: PathSettings) -> float:
    """Seconds of the whole round at the limits of speed."""
    return float(_path(stops, settings)[0][-1])


def camera_path(
    stops: tuple[Stop, ...], frames: int | None, settings: PathSettings, seed: int = 0
) -> tuple[Array, Array]:
    """Times and poses of a walk past the stops.

    Returns seconds (F,) and T_world_cam (F, 4, 4), camera axes x right, y down, z forward. None for `frames` takes as
    many as the whole round needs; fewer cut it short, more walk it slower.
    """
    clock, eye, yaw, pitch = _path(stops, settings)
    needed = int(np.ceil(clock[-1] * settings.fps)) + 1
    count = needed if frames is None else frames
    time_s = np.arange(count) / settings.fps
    moment = time_s * min(1.0, clock[-1] / max(time_s[-1], 1e-9)) if count > needed else np.minimum(time_s, clock[-1])
    rng = np.random.default_rng([seed, 2])
    position = np.stack([np.interp(moment, clock, eye[:, k]) for k in range(3)], axis=1)
    position = position + settings.sway_m * _sway(rng, time_s, 3)
    tilt = np.deg2rad(settings.sway_deg) * _sway(rng, time_s, 3)
    heading = np.interp(moment, clock, yaw) + tilt[:, 0]
    return time_s, viewing_poses(position, heading, np.interp(moment, clock, pitch) + tilt[:, 1], tilt[:, 2])


def viewing_poses(position: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """T_world_cam of cameras at `position` (F, 3) that look along yaw (from +x), pitch (up) and roll, radians."""
    forward = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=1)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = c * right + s * down, c * down - s * right, forward
    poses[:, :3, 3] = position
    return poses


def _path(stops: tuple[Stop, ...], settings: PathSettings) -> tuple[Array, Array, Array, Array]:
    """Dense clock (s), eye (m), yaw and pitch (rad) of a round that keeps the limits everywhere."""
    eye = np.array([s.eye for s in stops])
    look = np.array([s.target for s in stops]) - eye
    yaw = np.unwrap(np.arctan2(look[:, 1], look[:, 0]))
    pitch = np.arctan2(look[:, 2], np.hypot(look[:, 0], look[:, 1]))
    rates = np.array([settings.speed_m_s, *[np.deg2rad(settings.turn_deg_s)] * 2])
    legs = np.stack([np.linalg.norm(np.diff(eye, axis=0), axis=1), np.abs(np.diff(yaw)), np.abs(np.diff(pitch))], 1)
    knots = np.concatenate([[0.0], np.cumsum((legs / rates).max(axis=1) + 1e-3)])
    dense = np.linspace(0, knots[-1], 4000)
    curve = PchipInterpolator(knots, np.column_stack([eye, yaw, pitch]))(dense)
    smooth = gaussian_filter1d(curve, 0.35 * len(dense) / knots[-1], axis=0, mode="nearest")
    step = np.diff(smooth, axis=0)
    spent = np.maximum(np.linalg.norm(step[:, :3], axis=1) / rates[0], np.hypot(step[:, 3], step[:, 4]) / rates[1])
    even = gaussian_filter1d(spent, 0.25 * len(dense) / knots[-1], mode="nearest")
    clock = np.concatenate([[0.0], np.cumsum(np.maximum(np.maximum(spent, even), 1e-9))])
    return clock, smooth[:, :3], smooth[:, 3], smooth[:, 4]


def _sway(rng: np.random.Generator, time_s: Array, channels: int) -> Array:
    """Sums of slow sines of unit deviation, 0.4 to 1.6 Hz. Shape (F, channels)."""
    hertz = rng.uniform(0.4, 1.6, (channels, 5))
    phase = rng.uniform(0, 2 * np.pi, (channels, 5))
    waves = np.sin(2 * np.pi * hertz[None] * time_s[:, None, None] + phase[None])
    return np.asarray(waves.sum(axis=2) / np.sqrt(2.5))
