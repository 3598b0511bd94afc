"""Walks filmed in wide steps, as exports of every few frames of a phone's video are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from benchmarks.simulation.buildings import Building
from benchmarks.simulation.presets import make_shot
from benchmarks.simulation.routes import Director, FreeMap
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.walk import PathSettings, camera_path
from list3r.simulation.worlds.world import SimulatedWorld

_DENSE = PathSettings(fps=60.0, speed_m_s=0.5, turn_deg_s=30.0)
"""The walk that frames are picked from."""
_ROOMS = (0, 0, 1, 0, 1)
"""Rooms in the order in which they are entered, again and again; a room is filmed from a new place each time."""
_SWEEP_DEG = 60.0
_HELD_M = 0.3
"""The camera is held so far before the body, so it moves when the body turns,"""
_DRAWN_IN_S = 0.5
"""and drawn in over about so long where it would come too near to something."""


@dataclass(frozen=True)
class WideStepWalk(WalkSettings):
    """A walk to and fro between the two rooms of a building, with a frame after each step. `frames` is its length,
    which must be given; `path` and `walk_seed` are unused.
    """

    step_m: float = 0.08
    """A frame is kept when the camera has moved so far,"""
    step_deg: float = 4.0
    """or turned so far, whichever comes first."""
    clear_m: float = 0.3
    """Least distance of the camera to an obstacle, unless the body is nearer itself. Without it and with steps of 6
    degrees walks are those of research/colour-video 0074, which touch door frames (research/colour-video 0075)."""

    def world(self) -> SimulatedWorld:
        """The world of the building."""
        return _building(self.seed).world

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Seconds (F,) and T_world_cam (F, 4, 4) of the frames to be written."""
        assert self.frames is not None, "a walk that goes on for ever needs a length"
        return _filmed(self.seed, self.frames, (self.step_m, self.step_deg), self.clear_m)


@lru_cache(maxsize=2)
def _building(seed: int) -> Building:
    return make_shot("calm", seed).building


@lru_cache(maxsize=2)
def _filmed(
    seed: int, frames: int, step: tuple[float, float], clear_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    building, rng = _building(seed), np.random.default_rng([seed, 47])
    free = FreeMap(building)
    director = Director(building, free, rng, _DENSE, float(rng.uniform(1.35, 1.6)))
    rooms, taken = building.north, 0
    while True:
        room = rooms[_ROOMS[taken % len(_ROOMS)] % len(rooms)]
        director.film(director.plan_views(room, 1, _SWEEP_DEG), look_round=0.2)
        taken += 1
        T = _held(camera_path(tuple(director.stops), None, _DENSE, seed)[1], free, clear_m)
        picked = np.searchsorted(_steps(T, *step), np.arange(frames))
        if picked[-1] < len(T):
            return np.arange(frames) / 3.0, T[picked]


def _held(T_world_body: NDArray[np.float64], free: FreeMap, clear_m: float) -> NDArray[np.float64]:
    """Poses (F, 4, 4) of a camera held before a body that faces the same way."""
    T = T_world_body.copy()
    level = T[:, :2, 2] / np.linalg.norm(T[:, :2, 2], axis=1, keepdims=True)
    least = np.minimum(free.clearance(T[:, :2, 3]), clear_m)
    held = np.zeros(len(T))
    for reach in np.linspace(0.0, _HELD_M, 7)[1:]:
        near = free.clearance(T[:, :2, 3] + reach * level) >= least
        held = np.where(near & (held > reach - 0.06), reach, held)
    if (held < _HELD_M).any():
        span = round(_DRAWN_IN_S * _DENSE.fps)
        held = gaussian_filter1d(minimum_filter1d(held, 2 * span + 1), span / 2)
    T[:, :2, 3] += held[:, None] * level
    return T


def _steps(T: NDArray[np.float64], step_m: float, step_deg: float) -> NDArray[np.float64]:
    """Steps up to each of the poses (F, 4, 4). Shape (F,)."""
    moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    cosine = (np.einsum("nji,nji->n", T[:-1, :3, :3], T[1:, :3, :3]) - 1.0) / 2.0
    turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.concatenate([[0.0], np.cumsum(np.maximum(moved / step_m, turned / step_deg))])
