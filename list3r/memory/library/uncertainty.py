"""How sure it is that an instance is one thing and all of it, and how well its position is known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array, Sim3, skew, stack, take
from list3r.memory.core.records import ChunkRow
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.voxels import ChunkShapes


@dataclass(frozen=True)
class Signs:
    """What tells whether a group of local instances is one thing and all of it."""

    stability: float
    """How probably its members are one thing each, times how well their masks fit; mean weighted by their frames."""
    frames: float
    """Different frames of the recording in which it is seen, by those in which instances of its chunks usually are."""
    area: float
    """Share of what is seen in a frame that its mask covers, in the middle of its frames."""
    size_m: float
    """Diagonal of what one chunk saw of it."""
    structure: float
    """Share of it that its chunks took for structure."""
    found: float = 1.0
    """Share of the chunks that saw its place and found it."""


def signs_of(group: Sequence[Key], chunks: Mapping[int, ChunkShapes], frames: int, found: float) -> Signs:
    """Return the signs of a group that is seen in so many different frames, and found by this share of the chunks that
    saw its place.

    Frames are counted by what is usual, as a slow camera and a fast one see the same thing in many frames or few.
    """
    own = [(chunks[k], int(np.searchsorted(chunks[k].local_id, n))) for k, n in group]
    weight = [max(1, c.seen_for(at)) for c, at in own]
    rows = [(c.stability[at], _area(c, at), c.size[at] / c.unit, c.structure[at]) for c, at in own]
    stability, area, size, structure = np.average(np.array(rows, np.float64), axis=0, weights=weight).tolist()
    usual = float(np.mean([chunks[k].stands_for * chunks[k].usual_frames for k in sorted({k for k, _ in group})]))
    return Signs(stability, max(frames, 1) / usual, area, size, structure, found)


def _area(chunk: ChunkShapes, at: int) -> float:
    """Return the share of what is seen in a frame that the mask of an instance covers, in the middle of its frames."""
    seen = float(np.prod(chunk.seen[2:] - chunk.seen[:2]))
    return float(np.median(chunk.areas_px[at])) / max(seen, 1.0) if len(chunk.areas_px[at]) else 0.0


@dataclass(frozen=True)
class ConfidenceWeights:
    """Log odds that a person would call an instance one thing and all of it: logistic regression on whole memories of
    simulated walks with a sensor's depth (docs/decisions/0209-confidence-by-what-is-usual.md).
    """

    stability: float = 9.31
    frames: float = 0.74
    """Of the logarithm of the frames, up to `most_frames`."""
    most_frames: float = 2.0
    area: float = 0.57
    """Of the logarithm of the share of the picture, from `least_area` on."""
    least_area: float = 1e-4
    size: float = -1.03
    """Of the logarithm of the diagonal in metres, from `least_size_m` on."""
    least_size_m: float = 0.01
    found: float = 3.42
    """Of the logarithm of the share of the chunks that saw its place and found it."""
    constant: float = -4.74

    def probability(self, signs: Signs) -> float:
        """Return the probability; of structure, which is never seen whole, how sure its chunks are."""
        if signs.structure > 0.5:
            return signs.stability
        weights = self.stability, self.frames, self.area, self.size, self.found
        odds = self.constant + sum(w * x for w, x in zip(weights, self.inputs(signs), strict=True))
        return 1.0 / (1.0 + math.exp(-odds))

    def inputs(self, signs: Signs) -> tuple[float, float, float, float, float]:
        """Return what stability, frames, area, size and found are the weights of."""
        frames, area = min(signs.frames, self.most_frames), max(signs.area, self.least_area)
        size, found = math.log(max(signs.size_m, self.least_size_m)), math.log(signs.found)
        return signs.stability, math.log(frames), math.log(area), size, found


OF_COMPUTED_DEPTH = ConfidenceWeights(stability=9.56, frames=2.46, area=0.53, size=-0.94, found=1.45, constant=-6.17)
"""Weights where no sensor measured depth, fitted to videos without depth alone (decision 0209): what is there in few
frames is more often a bit that was computed wrongly, and what another chunk missed tells less."""


def point_covariances(S_world_chunk: Sim3, covariance: Array, points_world: Array) -> Array:
    """Return covariances of points that are fixed to chunks, from those of the chunks. Shapes of N: (N, 7, 7), (N, 3)
    -> (N, 3, 3).

    S_true = S_world_chunk exp(x), x = (rho, omega, sigma), moves the point p of the chunk by rho + omega x p + sigma p
    (first order).
    """
    p = S_world_chunk.inverse().apply(points_world[:, None])[:, 0]
    moves = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -skew(p), p[..., None]], axis=2)
    moves = S_world_chunk.scale[:, None, None] * (S_world_chunk.rotation @ moves)
    return np.asarray(moves @ covariance @ np.swapaxes(moves, 1, 2))


def position_sigmas(
    centers_world: Array, owner: NDArray[np.int64], seen_in: NDArray[np.int64], chunks: Sequence[ChunkRow]
) -> list[float | None]:
    """Return the standard deviations of the positions of N instances along their worst axes, world units; None for one
    of which no chunk knows its own. The instances `owner`, (O,), at centres (N, 3), are seen in the chunks `seen_in`.

    An instance is derived from what all of its chunks saw, and its error is a weighted mean of theirs, which are
    correlated to an unknown degree: whatever the weights, it is no larger than that of the worst placed chunk, and that
    is what is given. Relative to the first chunk of the component, as the chunks' covariances.
    """
    known = np.array([c.covariance is not None for c in chunks], bool)
    owner, seen_in = owner[known[seen_in]], seen_in[known[seen_in]]
    if not len(owner):
        return [None] * len(centers_world)
    covariance = np.array([np.zeros((7, 7)) if c.covariance is None else c.covariance for c in chunks])[seen_in]
    found = point_covariances(take(stack([c.S_world_chunk for c in chunks]), seen_in), covariance, centers_world[owner])
    most = np.linalg.eigvalsh((found + np.swapaxes(found, 1, 2)) / 2.0)[:, -1]
    worst = np.full(len(centers_world), -1.0)
    np.maximum.at(worst, owner, np.sqrt(np.maximum(most, 0.0)))
    return [None if value < 0.0 else value for value in worst.tolist()]
