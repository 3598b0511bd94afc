"""Pieces joined to objects by the affinity of their borders."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.instances.learned.kernels import least_of_groups

Float = NDArray[np.float32]

STRONGEST = 6.0
"""Log odds are cut at this, so that no single border decides."""


def agglomerate(
    count: int,
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    affinity: Float,
    weight: Float,
    threshold: float,
) -> NDArray[np.int64]:
    """Return the cluster of each of `count` pieces, numbered from 0 in order of their first piece.

    Clusters whose mean affinity (log odds, weighted by the length of their borders) is above the threshold are joined,
    the most similar first: average linkage. Mutual nearest neighbours are joined in parallel, with the same result as
    in sequence, since average linkage is reducible: a join is never nearer to a third cluster.
    """
    own = np.arange(count)
    score = np.clip(affinity.astype(np.float64), -STRONGEST, STRONGEST)
    mass: NDArray[np.float64] = weight.astype(np.float64)
    total = score * mass
    a, b = left.astype(np.int64), right.astype(np.int64)
    while len(a):
        mean = total / mass
        best = np.full(count, -np.inf)
        np.maximum.at(best, a, mean)
        np.maximum.at(best, b, mean)
        mutual = (mean > threshold) & (mean >= best[a]) & (mean >= best[b])
        if not mutual.any():
            break
        parent = least_of_groups(count, a[mutual], b[mutual])
        own = parent[own]
        a, b = parent[a], parent[b]
        apart = a != b
        low, high = np.minimum(a, b)[apart], np.maximum(a, b)[apart]
        code, at = np.unique(low * count + high, return_inverse=True)
        total = np.bincount(at, total[apart], minlength=len(code)).astype(np.float64)
        mass = np.bincount(at, mass[apart], minlength=len(code)).astype(np.float64)
        a, b = code // count, code % count
    _, first, number = np.unique(own, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return np.asarray(rank[number], np.int64)
