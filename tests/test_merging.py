"""Merging: one thing one group, whatever the order, and never against what was seen."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from list3r.memory.core.geometry import Sim3
from list3r.memory.library.overlap.pair_scores import Key
from list3r.memory.library.overlap.voxels import chunk_shapes, coverage
from tests.memory_scenes import BOX, CHAIR, IMAGE, MUG, ROOM, TABLE, Piece, Walk, merge_nodes, node, surface, walk


def names(w: Walk, groups: list[list[Key]]) -> list[set[str]]:
    return [{w.truth[key] for key in group} for group in groups]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("linked", [True, False])
def test_every_thing_of_a_room_becomes_one_group(seed: int, linked: bool) -> None:
    w = walk(ROOM, 5, seed=seed, linked=linked)
    groups, _ = merge_nodes(w.chunks, w.S_world_chunk, w.cannot_link)
    found = names(w, groups)
    assert all(len(group) == 1 for group in found), "two things in one group"
    assert len(found) == len(ROOM), "a thing in two groups"


def test_twin_mugs_forty_centimetres_apart_stay_two_and_drifting_ones_stay_one() -> None:
    for drift in (0.0, 0.02, 0.03):
        w = walk([MUG, Piece("other", (-0.2, 0.1, 0.77), (0.08, 0.08, 0.1), round=True, points=400)], 6, drift_m=drift)
        groups, _ = merge_nodes(w.chunks, w.S_world_chunk, [])
        assert sorted(len(g) for g in groups) == [6, 6]
        assert all(len(n) == 1 for n in names(w, groups))


@given(st.permutations(range(4)), st.integers(0, 3))
@settings(max_examples=12, deadline=None)
def test_the_partition_does_not_depend_on_the_order_of_chunks_or_links(order: list[int], seed: int) -> None:
    w = walk([TABLE, MUG, BOX, CHAIR], 4, seed=seed)
    rng = np.random.default_rng(seed)
    links = [w.cannot_link[n] for n in rng.permutation(len(w.cannot_link))]
    flipped = [(b, a) if rng.random() < 0.5 else (a, b) for a, b in links]
    before = merge_nodes(w.chunks, w.S_world_chunk, w.cannot_link)
    after = merge_nodes([w.chunks[n] for n in order], w.S_world_chunk, flipped)
    assert before == after


def test_the_partition_does_not_depend_on_the_frame_of_the_world() -> None:
    w = walk(ROOM, 4, seed=2)
    T_other_world = Sim3.exp([3.0, -1.0, 2.0, 0.4, 0.2, -2.0, 0.0])
    moved = {k: T_other_world @ S for k, S in w.S_world_chunk.items()}
    assert merge_nodes(w.chunks, moved, w.cannot_link)[0] == merge_nodes(w.chunks, w.S_world_chunk, w.cannot_link)[0]


@given(st.sets(st.tuples(st.integers(0, 14), st.integers(0, 14)), max_size=12))
@settings(max_examples=20, deadline=None)
def test_a_cannot_link_is_never_violated(pairs: set[tuple[int, int]]) -> None:
    w = walk([TABLE, MUG, BOX], 5, linked=False)
    keys = sorted(w.truth)
    links = [(keys[a], keys[b]) for a, b in pairs if a != b]
    groups, _ = merge_nodes(w.chunks, w.S_world_chunk, links)
    home = {key: n for n, group in enumerate(groups) for key in group}
    assert all(home[a] != home[b] for a, b in links)
    assert sorted(home) == keys


def test_fragments_of_one_thing_are_joined_through_the_whole_unless_seen_apart() -> None:
    table = surface(TABLE, 1, view=0.5)
    left, right = table[table[:, 0] < -0.05], table[table[:, 0] > 0.05]
    cut = (0, 100, 300, 300)
    pieces = chunk_shapes(
        [node(1, 0, left, box=cut, plane=TABLE.plane), node(1, 1, right, box=cut, plane=TABLE.plane)], IMAGE, chunk_id=1
    )
    whole = chunk_shapes([node(2, 0, surface(TABLE, 2, view=1.0), plane=TABLE.plane)], IMAGE, chunk_id=2)
    placed = {1: Sim3.identity(), 2: Sim3.identity()}
    assert merge_nodes([pieces, whole], placed, [])[0] == [[(1, 0), (1, 1), (2, 0)]]
    groups, decisions = merge_nodes([pieces, whole], placed, [((1, 0), (1, 1))])
    assert sorted(len(g) for g in groups) == [1, 2]
    assert [d.kind for d in decisions].count("refuse") == 1


@pytest.mark.parametrize(("apart", "whole"), [(4, 1), (3, 1), (2, 1), (1, 1)])
def test_two_things_that_one_chunk_took_for_one_stay_two_where_far_more_chunks_tell_them_apart(
    apart: int, whole: int
) -> None:
    cut, plane = (0, 100, 300, 300), TABLE.plane
    chunks = []
    for k in range(apart + whole):
        table = surface(TABLE, k, view=0.4 * k)
        left, right = table[table[:, 0] < -0.02], table[table[:, 0] > 0.02]
        parts = [left, right] if k < apart else [table]
        nodes = [node(k, n, points, box=cut, plane=plane) for n, points in enumerate(parts)]
        chunks.append(chunk_shapes(nodes, IMAGE, chunk_id=k))
    groups, decisions = merge_nodes(chunks, {c.chunk_id: Sim3.identity() for c in chunks}, [])
    refused = [d.reason for d in decisions if d.kind == "refuse"]
    assert len(groups) == (2 if apart > 2 * whole else 1)
    told = f"chunks that tell them apart: {apart}, that see them as one: {whole}"
    assert refused == ([told] if apart > 2 * whole else [])


def test_whole_twin_chairs_are_not_chained_by_a_mask_that_covers_both() -> None:
    left, right = surface(CHAIR, 1), surface(CHAIR, 2) + np.float32([0.62, 0, 0])
    one = chunk_shapes([node(1, 0, left)], IMAGE, chunk_id=1)
    two = chunk_shapes([node(2, 0, right)], IMAGE, chunk_id=2)
    both = chunk_shapes([node(3, 0, np.concatenate([left, right])[::2])], IMAGE, chunk_id=3)
    placed = {k: Sim3.identity() for k in (1, 2, 3)}
    groups, _ = merge_nodes([one, two, both], placed, [])
    assert not any({(1, 0), (2, 0)} <= set(group) for group in groups)


def test_a_thing_on_a_table_is_not_swallowed_by_the_table() -> None:
    for thing in (MUG, BOX):
        small = chunk_shapes([node(1, 0, surface(thing, 1))], IMAGE, chunk_id=1)
        large = chunk_shapes([node(2, 0, surface(TABLE, 2), plane=TABLE.plane)], IMAGE, chunk_id=2)
        groups, _ = merge_nodes([small, large], {1: Sim3.identity(), 2: Sim3.identity()}, [])
        assert groups == [[(1, 0)], [(2, 0)]]


def test_masks_in_shared_frames_decide_where_space_is_unsure() -> None:
    shifted = surface(MUG, 2, view=0.0) + np.float32([0.05, 0.0, 0.0])
    frames = np.arange(50, 60)
    placed = {1: Sim3.identity(), 2: Sim3.identity()}
    for box, merged in (((100, 100, 200, 200), True), ((400, 100, 500, 200), False)):
        one = chunk_shapes([node(1, 0, surface(MUG, 1, view=0.0), frames=frames)], IMAGE, chunk_id=1)
        two = chunk_shapes([node(2, 0, shifted, frames=frames, box=box)], IMAGE, chunk_id=2)
        assert (len(merge_nodes([one, two], placed, [])[0]) == 1) == merged


def test_two_walls_of_one_plane_join_where_they_touch_and_a_corner_does_not() -> None:
    wall = Piece("w", (0, 2, 1.2), (2, 0.01, 2.4), points=3000)
    corner = Piece("c", (2.0, 1.0, 1.2), (0.01, 2, 2.4), points=3000)
    nodes = [
        node(1, 0, surface(wall, 1), plane=(0, -1, 0, 2.0), structure=True),
        node(1, 1, surface(wall, 2) + np.float32([2.0, 0, 0]), plane=(0, -1, 0, 2.0), structure=True),
        node(1, 2, surface(corner, 3), plane=(-1, 0, 0, 2.0), structure=True),
    ]
    shapes = chunk_shapes(nodes, IMAGE, chunk_id=1)
    assert merge_nodes([shapes], {1: Sim3.identity()}, [])[0] == [[(1, 0), (1, 1)], [(1, 2)]]


def test_every_union_and_refusal_has_a_reason_that_can_be_read() -> None:
    w = walk(ROOM, 3)
    groups, decisions = merge_nodes(w.chunks, w.S_world_chunk, w.cannot_link)
    unions = [d for d in decisions if d.kind == "merge"]
    assert len(unions) == len(w.truth) - len(groups)
    assert all(d.reason and "score" in d.scores for d in decisions)


def test_coverage_is_full_on_itself_and_nothing_far_away() -> None:
    shapes = chunk_shapes([node(1, 0, surface(BOX, 1)), node(1, 1, surface(CHAIR, 1))], IMAGE, chunk_id=1)
    own = coverage(shapes, shapes, Sim3.identity())
    assert np.allclose(np.diag(own), 1.0) and own[0, 1] == own[1, 0] == 0.0
    assert not coverage(shapes, shapes, Sim3.exp([50.0, 0, 0, 0, 0, 0, 0])).any()


def test_scale_of_a_relative_chunk_does_not_matter() -> None:
    w = walk([TABLE, MUG, BOX, CHAIR], 3, seed=1)
    scaled, placed = [], {}
    for c, factor in zip(w.chunks, (1.0, 7.0, 0.3), strict=True):
        nodes = [
            node(c.chunk_id, int(n), (c.points[c.owner == n] * factor).astype(np.float32)) for n in range(len(c.size))
        ]
        scaled.append(chunk_shapes(nodes, IMAGE, unit=factor, chunk_id=c.chunk_id))
        S = w.S_world_chunk[c.chunk_id]
        placed[c.chunk_id] = S @ Sim3(np.asarray(1.0 / factor), np.eye(3), np.zeros(3))
    groups, _ = merge_nodes(scaled, placed, w.cannot_link)
    assert len(groups) == 4 and all(len(n) == 1 for n in names(w, groups))


def test_nothing_in_nothing_out() -> None:
    assert merge_nodes([], {}, []) == ([], [])
    empty = chunk_shapes([], IMAGE, chunk_id=1)
    assert merge_nodes([empty], {1: Sim3.identity()}, []) == ([], [])
    pairs = list(itertools.chain.from_iterable(merge_nodes([empty, empty], {1: Sim3.identity()}, [])))
    assert pairs == []
