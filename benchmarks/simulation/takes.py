"""A video before it is rendered: where the camera is in every frame, and how that comes about."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.buildings import Building
from benchmarks.simulation.routes import Director, FreeMap
from list3r.simulation.walk import PathSettings, camera_path
from list3r.simulation.worlds.objects import MovingObject

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shot:
    """A video without pictures: the camera's poses, the building and the movers."""

    preset: str
    seed: int
    building: Building
    time_s: Array
    """Seconds. Shape (F,)."""
    T_world_cam: Array
    """Shape (F, 4, 4)."""
    cuts: tuple[int, ...]
    """Frames before which the camera jumps."""
    movers: tuple[MovingObject, ...] = ()


@dataclass
class Take:
    """A shot while it is made."""

    building: Building
    free: FreeMap
    rng: np.random.Generator
    path: PathSettings
    eye_m: float
    poses: list[Array] = field(default_factory=list)
    """One array of shape (F, 4, 4) for each run of the camera."""

    def director(self) -> Director:
        return Director(self.building, self.free, self.rng, self.path, self.eye_m)

    def shoot(self, director: Director, frames: int) -> None:
        """Film a director's stops in a number of frames; fewer than the stops need cut them short."""
        seed = int(self.rng.integers(1 << 31))
        self.poses.append(camera_path(tuple(director.stops), frames, self.path, seed)[1])

    def fit(self, director: Director, frames: int) -> None:
        """Change the pace so that the stops take a number of frames."""
        pace = director.seconds() * self.path.fps / frames
        self.path = replace(self.path, speed_m_s=self.path.speed_m_s * pace, turn_deg_s=self.path.turn_deg_s * pace)
        director.path = self.path
