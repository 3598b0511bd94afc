"""How well the position of an instance is known, from how well the chunks that saw it are placed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from list3r.memory.geometry import Array, skew
from list3r.memory.records import ChunkRow


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
