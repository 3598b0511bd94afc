"""Which chunks of computed depth looked at a thing of another one in the frames that they share.

What computed depth shows of far or plain surfaces in one chunk is not there in the next; a sensor repeats itself.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from list3r.memory.meetings import Key
from list3r.memory.shapes import PIXEL_BITS, SAMPLED_FRAMES, ChunkShapes, Ints


def frames_beside(chunks: Mapping[int, ChunkShapes], pairs: Collection[tuple[int, int]]) -> dict[int, dict[int, Ints]]:
    """For chunks of computed depth: the sampled frames that each shares with others near it, by their ids.

    `pairs` are the chunks that are near each other.
    """
    out: dict[int, dict[int, Ints]] = {}
    looked = {k: np.unique(c.samples >> PIXEL_BITS) for k, c in chunks.items() if len(c.samples)}
    for u, v in pairs:
        if u != v and u in looked and v in looked and chunks[u].session_id == chunks[v].session_id:
            shared = np.intersect1d(looked[u], looked[v])
            if len(shared):
                out.setdefault(u, {})[v] = out.setdefault(v, {})[u] = shared
    return out


def looks_at(
    other: int,
    group: Sequence[Key],
    chunks: Mapping[int, ChunkShapes],
    beside: Mapping[int, Mapping[int, Ints]],
    *,
    least_frames: int,
    least_share: float,
) -> bool:
    """Whether another chunk has depth for `least_share` of a group in `least_frames` of the frames that they share."""
    seen: set[int] = set()
    for chunk_id, local_id in group:
        if other in beside.get(chunk_id, {}):
            shapes = chunks[chunk_id]
            mine = shapes.samples[shapes.sample_owner == int(np.searchsorted(shapes.local_id, local_id))]
            mine = mine[np.isin(mine >> PIXEL_BITS, beside[chunk_id][other])]
            frames, at = np.unique(mine >> PIXEL_BITS, return_inverse=True)
            known = np.bincount(at, np.isin(mine, chunks[other].samples), minlength=len(frames))
            seen.update(frames[known >= least_share * np.bincount(at, minlength=len(frames))].tolist())
    return SAMPLED_FRAMES * len(seen) >= least_frames


def bears_out(
    inner: Key,
    outer: Key,
    chunks: Mapping[int, ChunkShapes],
    beside: Mapping[int, Mapping[int, Ints]],
    least_share: float,
) -> bool:
    """Whether pixels agree that a local instance is part of one of another chunk of computed depth: in the frames that
    both saw, at least `least_share` of its pixels are the other's. True where they saw none together.

    Surfaces that meet do not tell: what computed depth makes too wide reaches over what stands beside it.
    """
    shared = beside.get(inner[0], {}).get(outer[0])
    if shared is None:
        return True
    a, b = chunks[inner[0]], chunks[outer[0]]
    mine = a.samples[a.sample_owner == int(np.searchsorted(a.local_id, inner[1]))]
    mine = mine[np.isin(mine >> PIXEL_BITS, shared)]
    theirs = b.samples[b.sample_owner == int(np.searchsorted(b.local_id, outer[1]))]
    return len(mine) == 0 or float(np.isin(mine, theirs).mean()) >= least_share
