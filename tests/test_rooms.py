"""Rooms: a home of known walls, seen from inside, is cut at its doorways; names, edits, questions and exports."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.exporters.scene_json import scene_dict, scene_schema
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Doorway, Room
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.rooms.derivation import Rooms, _named_as_before, _of_storey
from list3r.memory.library.rooms.naming import named_rooms
from list3r.memory.library.rooms.outline import area_of, encloses, outline
from list3r.memory.library.rooms.space import Grid, Sight
from list3r.memory.store.store import Store
from list3r.queries.finding.grammar import IN_ROOM, parse
from tests.session_scenes import ROOM, add_session, cameras, place_together

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])


def walls(door: float, *, divided: bool = True) -> list[tuple[np.ndarray, np.ndarray]]:
    """Ends of the walls of two rooms of 4 x 4 m side by side, with a doorway in the wall between them."""
    corners = np.array([[0, 0], [8, 0], [8, 4], [0, 4]], float)
    sides = [(a, b) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    inner = [((4, 0), (4, 2 - door / 2)), ((4, 2 + door / 2), (4, 4))] if divided else []
    return sides + [(np.array(a, float), np.array(b, float)) for a, b in inner]


def look_around(x: float, y: float, sides: list[tuple[np.ndarray, np.ndarray]]) -> Sight:
    """What a camera at 1.5 m sees of walls 2.5 m high and of the floor, in all directions."""
    camera, points = np.array([x, y, 1.5]), []
    for yaw in np.linspace(0, 2 * np.pi, 360, endpoint=False):
        d = np.array([np.cos(yaw), np.sin(yaw)])
        reach = np.inf
        for a, b in sides:
            along = b - a
            m = np.array([d, -along]).T
            if abs(np.linalg.det(m)) > 1e-9:
                t, s = np.linalg.solve(m, a - camera[:2])
                reach = min(reach, t) if t > 0 and 0 <= s <= 1 else reach
        for pitch in np.linspace(-0.9, 0.15, 8):
            far = min(reach, 1.5 / np.tan(-pitch)) if pitch < 0 else reach
            if np.isfinite(far):
                points.append([*(camera[:2] + far * d), 1.5 + far * np.tan(pitch)])
    return Sight(camera, np.array(points))


def home(door: float, *, divided: bool = True) -> tuple[list[Room], list[Doorway]]:
    places = [(x, y) for x in (1, 2, 3, 5, 6, 7) for y in (1, 2, 3)]
    return _of_storey(0, 0.0, [look_around(x, y, walls(door, divided=divided)) for x, y in places], {}, 1.0)


def test_two_rooms_are_cut_at_their_doorway() -> None:
    rooms, doorways = home(0.9)
    assert [r.area for r in rooms] == pytest.approx([16, 16], rel=0.1)
    assert not any(r.partial for r in rooms)
    (d,) = doorways
    np.testing.assert_allclose(d.position, [4, 2, 0], atol=0.15)
    assert d.width == pytest.approx(0.9, abs=0.15)


@pytest.mark.parametrize(("door", "divided"), [(2.4, True), (0.9, False)])
def test_a_wide_opening_and_a_hall_without_walls_are_one_room(door: float, divided: bool) -> None:
    rooms, doorways = home(door, divided=divided)
    assert [r.area for r in rooms] == pytest.approx([32], rel=0.1)
    assert doorways == []


def test_what_is_only_seen_through_a_doorway_is_a_partial_room() -> None:
    sights = [look_around(x, y, walls(0.9)) for x in (1, 2, 3) for y in (1, 2, 3)]
    rooms, _ = _of_storey(0, 0.0, sights, {}, 1.0)
    assert [bool(r.partial) for r in rooms] == [False, True]
    assert "other rooms only" in rooms[1].partial


def test_an_outline_goes_round_its_cells() -> None:
    mask = np.zeros((60, 80), bool)
    mask[10:50, 20:60] = True
    mask[10:30, 20:40] = False  # an L
    corners = outline(mask, Grid(np.array([1.0, 2.0]), mask.shape, 0.05))
    assert len(corners) == 6
    assert area_of(corners) == pytest.approx(mask.sum() * 0.05**2)
    inside = encloses(corners, [[1.0 + 30 * 0.05, 2.0 + 40 * 0.05], [1.0 + 30 * 0.05, 2.0 + 20 * 0.05]])
    assert inside.tolist() == [True, False]


def room(n: int, x: float, instances: tuple[int, ...] = ()) -> Room:
    return Room(n, 0, 0.0, SQUARE + np.array([x, 0.0]), 12.0, "", instances)


def test_ids_stay_with_the_ground_that_they_cover_and_are_not_given_again() -> None:
    before = Rooms([room(3, 0.0), room(7, 10.0)], [], last_id=9)
    after = _named_as_before([room(1, 10.3), room(2, 20.0)], [Doorway(1, 2, np.zeros(3), 0.9)], before)
    assert [r.id for r in after.rooms] == [7, 10]
    assert [(d.a, d.b) for d in after.doorways] == [(7, 10)]
    assert after.last_id == 10


@pytest.fixture
def furnished(make_memory) -> Path:
    """The small room's memory, its things in two rooms."""
    path: Path = make_memory()
    with Store.open(path, writable=True) as store, store.transaction():
        ids = [i.id for i in store.instances.all(structure=False)]
        store.instances.set_labels({ids[0]: "bed", ids[1]: "lamp", ids[2]: "lamp"})
        door = Doorway(1, 2, np.array([4.0, 1.0, 0.0]), 0.9)
        store.rooms.replace([room(1, 0.0, (ids[0], ids[1])), room(2, 4.0, (ids[2],))], [door])
    return path


def test_a_room_is_named_by_what_stands_in_it(furnished: Path) -> None:
    with list3r.open(furnished) as memory:
        first, second = memory.rooms()
        assert first.name == "bedroom"
        assert "bed" in first.reason
        assert second.name is None


def test_questions_know_rooms(furnished: Path) -> None:
    with list3r.open(furnished) as memory:
        first, second = memory.rooms()
        lamp = first.instances[1]
        assert [m.instance.id for m in memory.find("lamp in the bedroom")] == [lamp]
        assert [m.instance.id for m in memory.find("lamp in room 2")] == list(second.instances)
        assert [m.instance.id for m in memory.find("lamp not in the bedroom")] == list(second.instances)
        assert any("room 1 (bedroom)" in m.reason for m in memory.find("which room is the lamp in?"))
        assert "no room 'kitchen'" in " ".join(memory.find("lamp in the kitchen").notes)
        assert [m.instance.id for m in memory.nearest("lamp", room="bedroom")] == [lamp]
        with pytest.raises(OptionError, match="room 1 \\(bedroom\\)"):
            memory.nearest("lamp", room="cellar")
        assert [r.id for r in memory.room_path("bedroom", 2).rooms] == [1, 2]


def test_the_grammar_tells_rooms_from_places_and_things() -> None:
    assert parse("sofa in the living room").phrases[0].where[0].predicates == (IN_ROOM,)
    assert parse("mug in the room").phrases[0].where == ()
    assert parse("mug in the box").phrases[0].where[0].predicates[0] == "in"


def test_the_scene_has_floors_with_rooms(furnished: Path) -> None:
    import jsonschema

    with Store.open(furnished) as store:
        scene = json.loads(json.dumps(scene_dict(store)))
    jsonschema.validate(scene, scene_schema())
    (floor,) = scene["floors"]
    assert [(r["id"], r["name"]) for r in floor["rooms"]] == [(1, "bedroom"), (2, None)]
    assert scene["doorways"][0]["rooms"] == [1, 2]


def test_rooms_forget_an_instance_that_is_gone(furnished: Path) -> None:
    with Store.open(furnished, writable=True) as store:
        gone = named_rooms(store)[0].instances[0]
        with store.transaction():
            store.instances.drop(gone, None)
        assert gone not in named_rooms(store)[0].instances
        assert not any("room" in damage for damage in store.verify())


def test_a_doorway_that_is_no_more_is_forgotten(tmp_path: Path) -> None:
    with Store.create(tmp_path / "a.l3r") as store, store.transaction():
        add_session(store, ROOM, cameras((0.0, 0.0, 0.75), 0.4))
        place_together(store)
        store.facts.gravity = "known"
        consolidate(store)
        rooms = store.rooms.all()
        assert rooms and store.rooms.doorways() == []
        n = rooms[0].id
        store.rooms.replace(rooms, [Doorway(n, n + 1, np.zeros(3), 0.9)])
        consolidate(store)
        assert store.rooms.doorways() == [] and [r.id for r in store.rooms.all()] == [r.id for r in rooms]
