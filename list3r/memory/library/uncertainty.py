"""How sure it is that an instance is one thing and all of it, and how well its position is known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array, Sim3, skew
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


def position_covariance(chunk: ChunkRow, center_world: Array) -> Array | None:
    """Return the covariance of a point that is fixed to a chunk, world units, from the chunk's own. Shape (3,) -> (3,
    3).

    S_true = S_world_chunk exp(x), x = (rho, omega, sigma), moves the point p of the chunk by rho + omega x p + sigma p
    (first order). None where the chunk's covariance is not known.
    """
    if chunk.covariance is None:
        return None
    S = chunk.S_world_chunk
    p = S.inverse().apply(center_world[None])[0]
    moves = np.concatenate([np.eye(3), -skew(p), p[:, None]], axis=1)
    moves = float(S.scale) * S.rotation @ moves
    return np.asarray(moves @ chunk.covariance @ moves.T)


def position_sigma(center_world: Array, chunks: Iterable[ChunkRow]) -> float | None:
    """Return the standard deviation of an instance's position along the worst axis, world units; None where no chunk
    knows its own.

    `chunks` are those that saw it. An instance is derived from what all of them saw, and its error is a weighted mean
    of theirs, which are correlated to an unknown degree: whatever the weights, it is no larger than that of the worst
    placed chunk, and that is what is given. Relative to the first chunk of the component, as the chunks' covariances.
    """
    known = [C for chunk in chunks if (C := position_covariance(chunk, center_world)) is not None]
    if not known:
        return None
    return float(max(np.sqrt(max(float(np.linalg.eigvalsh((C + C.T) / 2.0)[-1]), 0.0)) for C in known))


def position_sigmas(
    centers_world: Array, owner: NDArray[np.int64], seen_in: NDArray[np.int64], chunks: Sequence[ChunkRow]
) -> list[float | None]:
    """Return `position_sigma` of N instances at centres (N, 3); `owner`, (O,), are seen in the chunks `seen_in`."""
    known = np.array([c.covariance is not None for c in chunks], bool)
    owner, seen_in = owner[known[seen_in]], seen_in[known[seen_in]]
    out: list[float | None] = [None] * len(centers_world)
    if not len(owner):
        return out
    unknown = np.zeros((7, 7))
    covariance = np.array([unknown if c.covariance is None else c.covariance for c in chunks])[seen_in]
    scale = np.array([float(c.S_world_chunk.scale) for c in chunks])[seen_in]
    rotation = np.array([c.S_world_chunk.rotation for c in chunks])[seen_in]
    origin = np.array([c.S_world_chunk.translation for c in chunks])[seen_in]
    p = Sim3(scale, rotation, origin).inverse().apply(centers_world[owner][:, None])[:, 0]
    moves = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -skew(p), p[..., None]], axis=2)
    moves = scale[:, None, None] * (rotation @ moves)
    found = moves @ covariance @ np.swapaxes(moves, 1, 2)
    most = np.linalg.eigvalsh((found + np.swapaxes(found, 1, 2)) / 2.0)[:, -1]
    worst = np.full(len(centers_world), -1.0)
    np.maximum.at(worst, owner, np.sqrt(np.maximum(most, 0.0)))
    return [None if value < 0.0 else value for value in worst.tolist()]
