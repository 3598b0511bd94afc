"""Full truth of a simulated video: the interface between worlds and simulated models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.simulation.worlds.world import SimulatedWorld


@dataclass(frozen=True)
class MoverTruth:
    """An object that moves while it is filmed."""

    id: int
    """Its id in `SimulatedVideo.ids`."""
    label: str
    T_world_object: NDArray[np.float64]
    """Where it is in each frame. Shape (F, 4, 4)."""


@dataclass(frozen=True)
class SimulatedVideo:
    """Truth of every frame of a walk through a world."""

    preset: str
    seed: int
    world: SimulatedWorld
    camera: Camera
    time_s: NDArray[np.float64]
    """Seconds. Shape (F,)."""
    T_world_cam: NDArray[np.float64]
    """Shape (F, 4, 4)."""
    depth: NDArray[np.float32]
    """Along the camera's z, metres, 0 where nothing is hit. Shape (F, H, W)."""
    ids: NDArray[np.int32]
    """Id of the object in every pixel, 0 for nothing. Shape (F, H, W)."""
    cuts: tuple[int, ...]
    """Frames before which the camera jumps."""
    movers: tuple[MoverTruth, ...]
    classes: dict[int, int]
    """Class of appearance of each object: two objects of one class are twins."""
    light: NDArray[np.int64] | None = None
    """Which light each frame was filmed in; None where it is all the same. Shape (F,)."""
    later: SimulatedWorld | None = None
    """The world after the first cut, where objects were moved in between."""
    later_camera: Camera | None = None
    """The camera after the first cut, of the same picture size, where it is another one."""

    def cameras(self, frames: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], Camera]]:
        """Return each camera that filmed some of the frames (N,), with the positions of its frames among them."""
        if self.later_camera is None:
            return [(np.arange(len(frames)), self.camera)]
        after = frames >= self.cuts[0]
        both = ((np.flatnonzero(~after), self.camera), (np.flatnonzero(after), self.later_camera))
        return [(where, camera) for where, camera in both if len(where)]

    def points(
        self, frames: NDArray[np.int64], row: NDArray[np.int64], column: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return where the pixels of frames (N,) are in the world, metres; the camera's place where nothing is hit.

        Shape (N, 3).
        """
        z = self.depth[frames, row, column].astype(np.float64)
        local = np.empty((len(frames), 3))
        for where, c in self.cameras(frames):
            rays = np.stack([(column[where] - c.cx) / c.fx, (row[where] - c.cy) / c.fy, np.ones(len(where))], axis=1)
            local[where] = z[where, None] * rays
        T = self.T_world_cam[frames]
        return np.einsum("nij,nj->ni", T[:, :3, :3], local) + T[:, :3, 3]

    def lights(self) -> NDArray[np.int64]:
        """Return the light of each frame, 0 where it is all the same. Shape (F,)."""
        return np.zeros(len(self.time_s), np.int64) if self.light is None else self.light
