"""Where the evidence parts an instance best: two sets of its local instances."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from list3r.memory.core.constraints import Key
from list3r.memory.core.geometry import Array
from list3r.memory.library.overlap.pair_scores import pair_scores
from list3r.memory.library.overlap.summaries import chunk_summaries
from list3r.memory.store.store import Store

_SEEN_APART = 4.0
"""Distance of two that were seen side by side in one frame; two that share no surface and lie side by side have 2."""


def propose_split(store: Store, keys: Sequence[Key]) -> tuple[Key, ...]:
    """Return the smaller of the two parts, by average linkage over how little two local instances cover each other, how
    far apart they lie for their size, how unlike they look, and whether they were seen side by side.
    """
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial.distance import squareform

    distance = _distances(store, keys)
    part = fcluster(linkage(squareform(distance, checks=False), "average"), 2, "maxclust")
    if part.max() < 2:
        part = np.where(np.arange(len(keys)) == int(np.argmax(distance.sum(axis=0))), 2, 1)
    smaller = min((1, 2), key=lambda p: (int(np.sum(part == p)), p == part[0]))
    return tuple(k for k, p in zip(keys, part, strict=True) if p == smaller)


def _distances(store: Store, keys: Sequence[Key]) -> Array:
    """Shape (N, N), symmetric, 0 on the diagonal."""
    summaries = chunk_summaries(store)
    placed = {c.chunk_id: c.S_world_chunk for c in store.chunks.all()}
    shapes = {k: summaries[k].shapes for k in sorted({k for k, _ in keys})}
    at = [int(np.searchsorted(shapes[k].local_id, n)) for k, n in keys]
    center = np.array([placed[k].apply(shapes[k].center[[a]])[0] for (k, _), a in zip(keys, at, strict=True)])
    size = np.array([shapes[k].size[a] * float(placed[k].scale) for (k, _), a in zip(keys, at, strict=True)])
    feature = np.array([shapes[k].feature[a] for (k, _), a in zip(keys, at, strict=True)], float)
    place = {(k, a): n for n, ((k, _), a) in enumerate(zip(keys, at, strict=True))}
    cover = np.zeros((len(keys), len(keys)))
    for u, v in combinations_with_replacement(shapes, 2):
        p = pair_scores(shapes[u], shapes[v], placed[u].inverse() @ placed[v])
        for i, j, share in zip(p.i.tolist(), p.j.tolist(), np.maximum(p.i_on_j, p.j_on_i), strict=True):
            if (u, i) in place and (v, j) in place:
                cover[place[u, i], place[v, j]] = cover[place[v, j], place[u, i]] = share
    larger = np.maximum(np.maximum(size[:, None], size[None]), 1e-9)
    offset = np.linalg.norm(center[:, None] - center[None], axis=2) / larger
    unlike = 0.5 * (1.0 - np.clip(feature @ feature.T, -1.0, 1.0))
    out = np.asarray((1.0 - cover) + np.minimum(offset, 1.0) + unlike)
    number = {key: n for n, key in enumerate(keys)}
    apart = [((k, a), (k, b)) for k in shapes for a, b in summaries[k].cannot_link.tolist()]
    for x, y in ((number[x], number[y]) for x, y in apart if x in number and y in number):
        out[x, y] = out[y, x] = _SEEN_APART
    np.fill_diagonal(out, 0.0)
    return out
