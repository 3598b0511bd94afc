"""How a chunk's frames lie beside the one similarity that places the chunk: a reconstruction bends slowly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Sim3

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Bend:
    """The bending of one chunk, undone: S_world_frame = S_world_chunk exp(x(frame)) takes what a frame saw, in chunk
    coordinates, to the world. Instances keep the chunk's one similarity, so that nothing of them tears."""

    frames: Array
    """Frame.index at which x is known, ascending; fractions are between frames. Shape (N,)."""
    twists: Array
    """x = (rho, omega, sigma) there, chunk units; linear between and constant beyond. Shape (N, 7)."""

    @staticmethod
    def none() -> Bend:
        """Return a chunk that does not bend."""
        return Bend(np.zeros(1), np.zeros((1, 7)))

    def at(self, frames: Ints) -> Sim3:
        """exp(x) at frames (Frame.index). Batched (F,)."""
        x = np.stack([np.interp(frames, self.frames, self.twists[:, k]) for k in range(7)], axis=-1)
        return Sim3.exp(x)
