"""A thing that another chunk of computed depth gives to a larger one must be that one's in the pictures too."""

from __future__ import annotations

import dataclasses

import numpy as np

from list3r.memory.library.overlap.missed import frames_beside, pictures_confirm
from list3r.memory.library.overlap.voxels import PIXEL_BITS, ChunkShapes, chunk_shapes

FRAMES = range(0, 30, 3)


def chunk(chunk_id: int, owner: np.ndarray, local_id: int, frames: range = FRAMES) -> ChunkShapes:
    """Depth at the first pixels of some frames; pixels whose `owner` is 0 are those of one local instance."""
    keys = [np.int64(f) << PIXEL_BITS | np.arange(len(owner)) for f in frames]
    return dataclasses.replace(
        chunk_shapes([], (48, 64), chunk_id=chunk_id),
        local_id=np.array([local_id], np.int64),
        samples=np.concatenate(keys).astype(np.int64),
        sample_owner=np.tile(owner, len(frames)).astype(np.int32),
    )


def first(count: int) -> np.ndarray:
    return np.where(np.arange(40) < count, 0, -1)


def agreed(part: ChunkShapes, whole: ChunkShapes) -> bool:
    chunks = {1: part, 2: whole}
    return pictures_confirm((1, 5), (2, 9), chunks, frames_beside(chunks, [(1, 2)]), 0.25)


def test_pixels_of_the_larger_one_bear_it_out() -> None:
    assert agreed(chunk(1, first(10), 5), chunk(2, first(40), 9))
    assert agreed(chunk(1, first(20), 5), chunk(2, first(6), 9))


def test_pixels_that_are_not_its_own_deny_it() -> None:
    assert not agreed(chunk(1, first(20), 5), chunk(2, first(4), 9))
    assert not agreed(chunk(1, first(20), 5), chunk(2, first(0), 9))


def test_chunks_that_saw_nothing_together_are_believed() -> None:
    assert agreed(chunk(1, first(20), 5), chunk(2, first(0), 9, range(60, 90, 3)))


def test_depth_of_a_sensor_is_believed() -> None:
    part, whole = (chunk_shapes([], (48, 64), chunk_id=k) for k in (1, 2))
    assert agreed(part, whole)
