"""Which chunks of computed depth looked at an instance of another one in the frames that they share.

What computed depth shows of far or plain surfaces in one chunk is not there in the next; a sensor repeats itself.
That the other found nothing is judged by its masks in those frames, not by where its instances lie, which follows the
scale of the chunk (decision 0022).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.voxels import PIXEL_BITS, SAMPLED_FRAMES, ChunkShapes, Ints


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


@dataclass(frozen=True)
class MissedSettings:
    """When another chunk has looked at the place of an instance and missed it."""

    least_frames: int = 8
    """Frames that two chunks share in which one must see an instance and the other look at its place: as many as a
    track of a chunk of 100 frames needs."""
    least_share: float = 0.25
    """Share of an instance in a frame where the other has depth, to look at its place: a part of it would do."""
    least_area: float = 0.4
    """Share of its largest area that an instance must show in such a frame: what was found close by may well be missed
    from afar or at the border of the picture."""
    same_iou: float = 0.5
    """What the other found there is the instance itself where their masks in those frames agree so well, though the
    surfaces may not meet in space."""


def misses(
    other: int,
    group: Sequence[Key],
    chunks: Mapping[int, ChunkShapes],
    beside: Mapping[int, Mapping[int, Ints]],
    settings: MissedSettings,
) -> bool:
    """Return whether another chunk looked at a group in the frames that they share, and found nothing like it."""
    s, seen = settings, set[int]()
    for chunk_id, local_id in group:
        if other not in beside.get(chunk_id, {}):
            continue
        shapes = chunks[chunk_id]
        mine = shapes.samples[shapes.sample_owner == int(np.searchsorted(shapes.local_id, local_id))]
        frames, at, area = np.unique(mine >> PIXEL_BITS, return_inverse=True, return_counts=True)
        known = _among(mine, chunks[other].samples)
        well = np.bincount(at, known, minlength=len(frames)) >= s.least_share * area
        well &= (area >= s.least_area * area.max(initial=0)) & _among(frames, beside[chunk_id][other])
        if _mask_iou(mine[known & well[at]], frames[well], chunks[other]) >= s.same_iou:
            return False
        seen.update(frames[well].tolist())
    return math.lcm(SAMPLED_FRAMES, chunks[other].stands_for) * len(seen) >= s.least_frames


def _mask_iou(mine: Ints, frames: Ints, other: ChunkShapes) -> float:
    """Return the best IoU of some pixels with those of one local instance of another chunk, over some frames."""
    owners = other.sample_owner[np.searchsorted(other.samples, mine)]
    if not (owners >= 0).any():
        return 0.0
    shared = np.bincount(owners[owners >= 0])
    theirs = other.sample_owner[_among(other.samples >> PIXEL_BITS, frames)]
    area = np.bincount(theirs[theirs >= 0], minlength=len(shared))[: len(shared)]
    return float((shared / np.maximum(len(mine) + area - shared, 1)).max())


def _among(values: Ints, ascending: Ints) -> NDArray[np.bool_]:
    """Return which values are among ascending ones: what `np.isin` tells, which takes ten times as long. Shape (N,)."""
    if not len(ascending):
        return np.zeros(len(values), bool)
    at = np.minimum(np.searchsorted(ascending, values), len(ascending) - 1)
    return np.asarray(ascending[at] == values)


def pictures_confirm(
    inner: Key,
    outer: Key,
    chunks: Mapping[int, ChunkShapes],
    beside: Mapping[int, Mapping[int, Ints]],
    least_share: float,
) -> bool:
    """Return whether pixels agree that a local instance is part of one of another chunk of computed depth: in the
    frames that both saw, at least `least_share` of its pixels are the other's. True where they saw none together.

    Surfaces that meet do not tell: what computed depth makes too wide reaches over what stands beside it.
    """
    shared = beside.get(inner[0], {}).get(outer[0])
    if shared is None:
        return True
    a, b = chunks[inner[0]], chunks[outer[0]]
    mine = a.samples[a.sample_owner == int(np.searchsorted(a.local_id, inner[1]))]
    mine = mine[_among(mine >> PIXEL_BITS, shared)]
    theirs = b.samples[b.sample_owner == int(np.searchsorted(b.local_id, outer[1]))]
    return len(mine) == 0 or float(_among(mine, theirs).mean()) >= least_share
