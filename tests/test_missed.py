"""What computed depth finds in one chunk and not in the next, in the frames that both saw."""

from __future__ import annotations

import dataclasses

import numpy as np

from list3r.memory.library.overlap.missed import MissedSettings, frames_beside, misses
from list3r.memory.library.overlap.voxels import PIXEL_BITS, ChunkShapes, chunk_shapes

FRAMES = range(0, 30, 3)
THING, OTHER = 5, 9


def chunk(chunk_id: int, areas: dict[int, int], owner: np.ndarray, local_id: int) -> ChunkShapes:
    """A chunk with depth at the first pixels of some frames and one local instance, where `owner` is 0."""
    keys = [np.int64(f) << PIXEL_BITS | np.arange(n) for f, n in areas.items()]
    owners = [owner[:n] for n in areas.values()]
    empty = chunk_shapes([], (48, 64), chunk_id=chunk_id)
    return dataclasses.replace(
        empty,
        local_id=np.array([local_id], np.int64),
        samples=np.concatenate(keys).astype(np.int64),
        sample_owner=np.concatenate(owners).astype(np.int32),
    )


def missed(finder: ChunkShapes, other: ChunkShapes) -> bool:
    chunks = {1: finder, 2: other}
    return misses(2, [(1, THING)], chunks, frames_beside(chunks, [(1, 2)]), MissedSettings())


WHOLE = dict.fromkeys(FRAMES, 20)
MINE, NOBODYS = np.zeros(40, np.int32), np.full(40, -1, np.int32)


def test_depth_where_nothing_is_found_is_a_miss_and_no_depth_is_none() -> None:
    assert missed(chunk(1, WHOLE, MINE, THING), chunk(2, WHOLE, NOBODYS, OTHER))
    assert not missed(chunk(1, WHOLE, MINE, THING), chunk(2, dict.fromkeys(FRAMES, 4), NOBODYS, OTHER))


def test_what_covers_the_same_pixels_is_the_thing_itself() -> None:
    assert not missed(chunk(1, WHOLE, MINE, THING), chunk(2, WHOLE, MINE, OTHER))
    half = np.where(np.arange(40) < 16, 0, -1).astype(np.int32)
    assert not missed(chunk(1, WHOLE, MINE, THING), chunk(2, WHOLE, half, OTHER))
    quarter = np.where(np.arange(40) < 5, 0, -1).astype(np.int32)
    assert missed(chunk(1, WHOLE, MINE, THING), chunk(2, WHOLE, quarter, OTHER))


def test_a_surface_far_larger_than_the_thing_is_not_the_thing() -> None:
    assert missed(chunk(1, dict.fromkeys(FRAMES, 10), MINE, THING), chunk(2, dict.fromkeys(FRAMES, 40), MINE, OTHER))


def test_what_was_found_close_by_may_be_missed_from_afar() -> None:
    near = {90: 60}
    mine = np.zeros(60, np.int32)
    assert not missed(chunk(1, WHOLE | near, mine, THING), chunk(2, WHOLE, NOBODYS, OTHER))
    assert missed(chunk(1, WHOLE | {90: 40}, MINE, THING), chunk(2, WHOLE, NOBODYS, OTHER))
