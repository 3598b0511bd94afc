"""Relations from a viewpoint and between things, ways through the graph, and what is not known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from list3r.memory.core.errors import OptionError, UnknownIdError
from list3r.memory.core.records import Relation
from list3r.memory.store.store import Store
from list3r.queries.path import path
from list3r.queries.relations import Relations, relations
from list3r.queries.views.viewpoint import Viewpoint, between, viewed
from tests.conftest import instance, write_small_room

FLOOR, TABLE, MUG, TWIN, CHAIR, WALL = range(1, 7)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    with Store.create(tmp_path_factory.mktemp("relations") / "room.l3r") as opened, opened.transaction():
        write_small_room(opened)
        yield opened


def triples(found: Relations) -> list[tuple[int, str, int]]:
    return [(r.subject, r.predicate, r.object) for r in found]


def test_left_and_front_from_a_point(store: Store) -> None:
    """From the origin towards +x: left is +y, in front is smaller x."""
    found = relations(store, MUG, None, TWIN, viewpoint=(0.0, 0.0, 0.8))
    assert {p for _, p, _ in triples(found)} == {"left_of", "in_front_of"}
    assert found.state == "known" and "the point 0, 0, 0.8" in found.reason
    opposite = relations(store, MUG, None, TWIN, viewpoint=(4.0, 0.0, 0.8))
    assert {p for _, p, _ in triples(opposite)} == {"right_of", "behind"}


def test_from_an_instance_and_from_a_camera(store: Store) -> None:
    """The chair stands at y = 1 and looks towards -y: its left is +x."""
    assert triples(relations(store, "mug", "left_of", MUG, viewpoint=CHAIR)) == [(TWIN, "left_of", MUG)]
    assert triples(relations(store, MUG, "left_of", TWIN, viewpoint="camera")) == [(MUG, "left_of", TWIN)]
    assert "frame 3" in relations(store, MUG, "left_of", TWIN, viewpoint="camera:3").reason
    assert relations(store, viewpoint=f"{CHAIR}", subject=CHAIR, predicate="behind") == []


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=9, max_size=9), st.lists(st.floats(0.05, 1.0), min_size=6, max_size=6))
def test_sides_are_inverse_and_turn_with_the_world(places: list[float], sizes: list[float]) -> None:
    a = instance(1, tuple(places[:3]), tuple(sizes[:3]), (1, 1, 1))
    b = instance(2, tuple(places[3:6]), tuple(sizes[3:]), (1, 1, 1))
    viewer = Viewpoint(np.array(places[6:]), UP, "here")
    one, two = viewed(viewer, a, b, 0.015), viewed(viewer, b, a, 0.015)
    assert (one is None) == (two is None)
    if one is None or two is None:
        return
    inverse = {"left_of": "right_of", "right_of": "left_of", "in_front_of": "behind", "behind": "in_front_of"}
    assert {(inverse[r.predicate], r.margin) for r in one} == {(r.predicate, r.margin) for r in two}
    assert all(r.margin > 0 and 0.5 <= r.confidence <= 1 for r in one)
    moved = [instance(n, tuple(i.center + 5), tuple(i.box.size), (1, 1, 1)) for n, i in ((1, a), (2, b))]
    again = viewed(Viewpoint(viewer.place + 5, UP, "there"), *moved, 0.015) or []
    assert {r.predicate for r in again if r.margin > 1e-4} == {r.predicate for r in one if r.margin > 1e-4}


def test_between_two_things(store: Store) -> None:
    with_box = instance(20, (2.0, 0.0, 0.77), (0.06, 0.06, 0.1), (1, 1, 1))
    store.instances.put([with_box])
    try:
        found = relations(store, None, "between", MUG, other=TWIN)
        assert triples(found) == [(20, "between", MUG)] and vars(found[0])["other"] == TWIN
        assert relations(store, TABLE, "between", MUG, other=TWIN) == [], "it is under both"
        assert triples(relations(store, 20, "between", TWIN, other=MUG)) == [(20, "between", TWIN)]
    finally:
        store.instances.drop(20, None)


def test_words_stand_for_things(store: Store) -> None:
    assert triples(relations(store, "mug", "on", "table")) == [(MUG, "on", TABLE), (TWIN, "on", TABLE)]
    assert relations(store, "elephant", "on", "table") == []
    assert triples(relations(store, "#3")) == [(MUG, "on", TABLE)]


def test_what_needs_gravity_is_unknown_without_it(store: Store) -> None:
    held = store.relations.all()
    store.facts.gravity = "unknown"
    store.relations.replace(None, [r for r in held if r.predicate == "next_to"])
    try:
        found = relations(store, predicate="on")
        assert found == [] and found.state == "unknown" and "gravity" in found.reason
        assert relations(store, predicate="next_to").state == "known"
        assert relations(store, MUG, "left_of", TWIN, viewpoint=(0, 0, 1)).state == "unknown"
        assert relations(store, MUG, "left_of", TWIN, viewpoint=CHAIR).state == "unknown"
        assert triples(relations(store, MUG, "left_of", TWIN, viewpoint="camera")) == [(MUG, "left_of", TWIN)]
    finally:
        store.facts.gravity = "estimated"
        store.relations.replace(None, held)


def test_parts_that_are_not_joined_have_no_sides(store: Store) -> None:
    a, b = instance(1, (1, 0, 0), (1, 1, 1), (1, 1, 1)), instance(2, (3, 3, 0), (1, 1, 1), (1, 1, 1), component=2)
    assert viewed(Viewpoint(np.zeros(3), UP, "here"), a, b, 0.01) is None


@pytest.mark.parametrize(
    "arguments",
    [
        {"predicate": "left_of"},
        {"predicate": "on", "viewpoint": (0, 0, 1)},
        {"predicate": "between"},
        {"predicate": "between", "object": 2},
        {"predicate": "on", "other": 3},
        {"other": 3},
        {"predicate": "upon"},
        {"viewpoint": "here"},
        {"viewpoint": "1,2"},
        {"viewpoint": (0.0, float("nan"), 0.0)},
        {"subject": "the"},
        {"min_confidence": 1.5},
    ],
)
def test_nonsense_is_refused(store: Store, arguments: dict[str, object]) -> None:
    with pytest.raises(OptionError) as caught:
        relations(store, **arguments)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_ways_are_the_shortest_and_then_the_surest(store: Store) -> None:
    assert triples(path(store, MUG, CHAIR)) == [(MUG, "on", TABLE), (TABLE, "next_to", CHAIR)]
    assert triples(path(store, MUG, FLOOR)) == [(MUG, "on", TABLE), (TABLE, "on", FLOOR)]
    assert triples(path(store, FLOOR, MUG)) == [(FLOOR, "supports", TABLE), (TABLE, "supports", MUG)]
    assert path(store, MUG, MUG).reason == "both are #3"
    nowhere = path(store, MUG, WALL)
    assert nowhere == [] and "no relations connect them" in nowhere.reason
    with pytest.raises(UnknownIdError):
        path(store, MUG, 77)


def test_ways_need_not_lead_over_the_floor(store: Store) -> None:
    held = store.relations.all()
    store.relations.replace(None, [Relation(TABLE, "on", FLOOR, 0.9, 0.1), Relation(CHAIR, "on", FLOOR, 0.9, 0.1)])
    try:
        assert len(path(store, TABLE, CHAIR)) == 2
        assert path(store, TABLE, CHAIR, structure=False) == []
    finally:
        store.relations.replace(None, held)


def test_a_side_must_be_clear_of_half_of_the_larger_of_the_two() -> None:
    viewer = Viewpoint(np.zeros(3), UP, "here")
    wide, small = (
        instance(1, (2, 0, 0), (0.4, 1.0, 0.4), (1, 1, 1)),
        instance(2, (2, 0.8, 0), (0.1, 0.1, 0.1), (1,) * 3),
    )
    sides = [r for r in viewed(viewer, small, wide, 0.015) or [] if r.predicate == "left_of"]
    assert 0.2 < sides[0].margin < 0.35
    unsure = replace(small, position_sigma_m=1e300)
    assert {r.confidence for r in viewed(viewer, unsure, wide, 0.015) or []} == {0.5}, "nobody knows where it is"
    near = instance(2, (2, 0.4, 0), (0.1, 0.1, 0.1), (1, 1, 1))
    assert not [r for r in viewed(viewer, near, wide, 0.015) or [] if r.predicate in ("left_of", "right_of")]


def test_what_is_between_is_so_by_its_distance_from_all_bounds() -> None:
    a, b = (instance(n, (x, 0, 0), (0.2, 0.6, 0.6), (1, 1, 1)) for n, x in ((1, 0.0), (2, 2.0)))
    for x, margin in ((1.0, 0.4), (0.15, 0.05), (1.8, 0.1)):
        found = between(instance(3, (x, 0, 0), (0.1, 0.2, 0.2), (1, 1, 1)), a, b, 0.01)
        assert found is not None and found.margin == pytest.approx(margin)
    assert between(instance(3, (0.05, 0, 0), (0.1, 0.2, 0.2), (1, 1, 1)), a, b, 0.01) is None


def test_of_ways_equally_long_the_surest_is_taken(tmp_path: Path) -> None:
    with Store.create(tmp_path / "ways.l3r") as made, made.transaction():
        made.instances.put(instance(n, (n, 0, 0), (0.1, 0.1, 0.1), (1, 1, 1)) for n in range(1, 5))
        sure = {(1, 2): 0.6, (2, 4): 0.6, (1, 3): 0.9, (3, 4): 0.9}
        made.relations.replace(None, [Relation(s, "near", o, c, 0.1) for (s, o), c in sure.items()])
        assert [r.object for r in path(made, 1, 4)] == [3, 4]
