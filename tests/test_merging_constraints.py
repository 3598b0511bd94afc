"""Merging under an operator's word: obeyed in any order, the last word wins, and nothing else changes."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from list3r.memory.core.constraints import Constraints, Edit, Key, standing
from list3r.memory.core.geometry import Sim3
from list3r.memory.library.overlap.voxels import chunk_shapes
from tests.memory_scenes import BOX, CHAIR, IMAGE, MUG, TWIN, merge_nodes, node, surface, walk

WALK = walk([MUG, TWIN, BOX], 3, linked=False)
KEYS = sorted(WALK.truth)


def edit(entry: int, kind: str, *parts: list[Key], through: int = 9, target: int | None = None) -> Edit:
    return Edit(entry, "2026-01-01T00:00:00+00:00", "ann", kind, tuple(map(tuple, parts)), through, (), target=target)


def grouped(edits: list[Edit], order: list[int] | None = None) -> list[list[Key]]:
    word = Constraints.of(edits)
    chunks = [WALK.chunks[n] for n in order or range(3)]
    groups, _ = merge_nodes(chunks, WALK.S_world_chunk, [], constraints=word)
    return word.joined(groups, dict.fromkeys(range(1, 4), 1), {})[0]


def of(name: str) -> list[Key]:
    return [k for k in KEYS if WALK.truth[k] == name]


def test_without_a_word_nothing_changes() -> None:
    assert sorted(grouped([])) == sorted(of(n) for n in ("mug", "twin mug", "box"))


def test_a_merge_joins_and_a_split_parts_against_all_overlap() -> None:
    assert sorted(of("mug") + of("twin mug")) in grouped([edit(1, "merge", of("mug")[:1], of("twin mug")[:1])])
    groups = grouped([edit(1, "split", of("box")[:1], of("box")[1:])])
    assert of("box")[:1] in groups and of("box")[1:] in groups


def test_undone_edits_do_not_count_and_an_undone_undo_does_not_either() -> None:
    first = edit(1, "merge", of("mug"), of("box"))
    undo, redo = edit(2, "undo", target=1), edit(3, "undo", target=2)
    assert [e.entry for e in standing([first, undo])] == [2]
    assert [e.entry for e in standing([first, undo, redo])] == [1, 3]
    assert grouped([first, undo]) == grouped([]) and grouped([first, undo, redo]) == grouped([first])


@given(
    st.lists(
        st.tuples(st.sampled_from(["merge", "split"]), st.permutations(KEYS), st.integers(1, 3), st.integers(1, 3)),
        max_size=4,
    ),
    st.permutations(range(3)),
)
@settings(max_examples=40, deadline=None)
def test_the_last_word_holds_wholly_and_the_order_of_chunks_does_not_matter(
    told: list[tuple[str, list[Key], int, int]], order: list[int]
) -> None:
    edits = [edit(n + 1, kind, keys[:a], keys[a : a + b]) for n, (kind, keys, a, b) in enumerate(told)]
    groups = grouped(edits)
    assert groups == grouped(edits, order)
    assert sorted(itertools.chain.from_iterable(groups)) == KEYS
    if edits:
        home = {k: n for n, g in enumerate(groups) for k in g}
        left, right = ({home[k] for k in part} for part in edits[-1].parts)
        assert len(left) == len(right) == 1
        assert (left == right) == (edits[-1].kind == "merge")


def test_what_was_deleted_takes_nothing_with_it_and_attracts_what_is_seen_of_it_later() -> None:
    word = Constraints.of([edit(1, "delete", [k for k in of("mug") if k[0] < 3], through=2)])
    groups, _ = merge_nodes(WALK.chunks, WALK.S_world_chunk, [], constraints=word)
    assert [word.deleted(g) for g in groups] == [g == of("mug") for g in groups]
    alone = Constraints.of([edit(1, "delete", of("mug")[:1], through=9)])
    groups, decisions = merge_nodes(WALK.chunks, WALK.S_world_chunk, [], constraints=alone)
    assert of("mug")[:1] in groups and of("mug")[1:] in groups
    assert any("operator deleted" in d.reason for d in decisions)


def test_whole_groups_that_were_parted_are_forbidden_to_become_one() -> None:
    word = Constraints.of([edit(1, "split", of("mug")[:1], of("box")[:1])])
    assert word.forbids(of("mug"), of("box")) and not word.forbids(of("mug"), of("twin mug"))
    assert not Constraints().forbids(of("mug"), of("box"))


def test_two_masks_of_one_thing_in_one_chunk_are_joined_unless_seen_side_by_side() -> None:
    points = surface(CHAIR, 1, view=0.4)
    half = points[np.random.default_rng(0).random(len(points)) < 0.7]
    both = chunk_shapes([node(1, 0, points), node(1, 1, half)], IMAGE, chunk_id=1)
    placed = {1: Sim3.identity()}
    assert merge_nodes([both], placed, [])[0] == [[(1, 0), (1, 1)]]
    assert merge_nodes([both], placed, [((1, 0), (1, 1))])[0] == [[(1, 0)], [(1, 1)]]
