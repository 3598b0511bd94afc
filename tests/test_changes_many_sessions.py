"""What changed between many sessions: what was gone before, what nobody looked at, and places that were left."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.records import ChangeEvent
from list3r.memory.library.maintenance.history import world_at
from list3r.memory.store.store import Store
from tests.session_scenes import Box, metric_store
from tests.test_derived_sessions import APART_M, film, house, moved

AT_FIRST, AT_SECOND, AT_STAND = [(0, 0.4), (0, 1.5)], [(1, 0.9), (1, 2.0)], [(2.6 / APART_M, 3.5)]
EVERYWHERE = AT_FIRST + AT_SECOND + AT_STAND
PAST_STAND = [(0, 3.9), (0, 4.0)]
"""The stand is near, and never in the picture."""
ELSEWHERE = Box((APART_M - 0.25, 0.3, 0.81), (0.12, 0.14, 0.14), (30, 40, 200))
"""The blue thing of the first table on the second one."""
STAND = Box((2.6, -0.6, 0.37), (0.4, 0.4, 0.74), (90, 90, 100))
ON_STAND = Box((2.6, -0.6, 0.81), (0.12, 0.14, 0.14), (210, 120, 20))
ON_TABLE = replace(ON_STAND, center=(-0.25, 0.32, 0.81))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with metric_store(tmp_path / "house.l3r") as opened:
        yield opened


def thing_at(store: Store, box: Box) -> int:
    """The id of the instance whose middle is that of a box."""
    return next(
        i.id
        for i in store.instances.all(structure=False)
        if i.state != "removed" and max(abs(a - b) for a, b in zip(i.box.center, box.center, strict=True)) < 0.05
    )


def told(store: Store, session: int) -> list[ChangeEvent]:
    """What a session changed."""
    return [e for e in store.events.all(session) if e.kind != "seen_again"]


def kinds(store: Store, session: int) -> list[tuple[int, str]]:
    return [(e.instance_id, e.kind) for e in told(store, session)]


def visit(store: Store, changes: Mapping[str, Box | None], where: list[tuple[int, float]]) -> None:
    film(store, house(changes), where)


@pytest.mark.slow
def test_what_was_gone_and_is_found_elsewhere_keeps_its_id(store: Store) -> None:
    visit(store, {}, EVERYWHERE)
    blue = thing_at(store, house()["thing 01"])
    visit(store, {"thing 01": None}, EVERYWHERE)
    visit(store, {"thing 01": ELSEWHERE}, EVERYWHERE)
    assert [kinds(store, 2), kinds(store, 3)] == [[(blue, "removed")], [(blue, "added")]]
    (event,) = told(store, 3)
    assert event.from_box is None and "it was gone, and was found" in event.reason
    assert thing_at(store, ELSEWHERE) == blue
    visit(store, {}, EVERYWHERE)
    assert kinds(store, 4) == [(blue, "moved")] and kinds(store, 3) == [(blue, "added")]
    then = [next(i for i in world_at(store, n) if i.id == blue) for n in (1, 2, 3, 4)]
    assert [i.state for i in then] == ["present", "removed", "added", "moved"]
    first, there = house()["thing 01"].center, ELSEWHERE.center
    for i, center in zip(then, (first, first, there, first), strict=True):
        np.testing.assert_allclose(i.center, center, atol=0.05)


def test_what_came_from_where_nobody_looked_is_told_as_moved(store: Store) -> None:
    visit(store, {"stand": STAND, "mug": ON_STAND}, EVERYWHERE)
    mug = thing_at(store, ON_STAND)
    visit(store, {"stand": STAND, "mug": ON_TABLE}, PAST_STAND)
    (event,) = told(store, 2)
    assert (event.instance_id, event.kind) == (mug, "moved") and "no frame tells of where it was" in event.reason
    assert thing_at(store, ON_TABLE) == mug
    visit(store, {"stand": STAND, "mug": ON_TABLE}, EVERYWHERE)
    assert told(store, 3) == [] and kinds(store, 2) == [(mug, "moved")]


def test_two_alike_are_told_apart_once_both_are_seen(store: Store) -> None:
    visit(store, {"stand": STAND, "mug": ON_STAND}, EVERYWHERE)
    mug = thing_at(store, ON_STAND)
    visit(store, {"stand": STAND, "mug": ON_STAND, "new": ON_TABLE}, PAST_STAND)
    assert kinds(store, 2) == [(mug, "moved")]
    visit(store, {"stand": STAND, "mug": ON_STAND, "new": ON_TABLE}, EVERYWHERE)
    other = thing_at(store, ON_TABLE)
    assert thing_at(store, ON_STAND) != other and mug in (thing_at(store, ON_STAND), other)
    assert kinds(store, 2) == [(other, "added")] and told(store, 3) == []


def test_what_came_from_nowhere_known_is_new(store: Store) -> None:
    visit(store, {}, AT_FIRST)
    visit(store, {"thing 01": ELSEWHERE}, AT_SECOND)
    assert told(store, 2) == []
    assert len({i.id for i in store.instances.all(structure=False)}) == 9


def test_a_place_is_free_that_an_instance_left_for_a_former_one(store: Store) -> None:
    there = moved("thing 01", -0.1, 0.35)
    instead = replace(house()["thing 00"], center=there.center)
    visit(store, {}, AT_FIRST)
    red, blue = (thing_at(store, house()[name]) for name in ("thing 00", "thing 01"))
    visit(store, {"thing 01": there}, AT_FIRST)
    visit(store, {"thing 00": instead}, AT_FIRST)
    assert [kinds(store, 2), kinds(store, 3)] == [[(blue, "moved")], [(red, "moved"), (blue, "moved")]]
    assert (thing_at(store, instead), thing_at(store, house()["thing 01"])) == (red, blue)
