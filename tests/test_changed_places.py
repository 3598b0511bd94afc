"""What went and came without having been found: surfaces that another session sees through become things."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.instances.carving.carved_instances import _Change, add_changed_places
from list3r.instances.carving.carved_surfaces import ChangedPlaceSettings
from list3r.instances.geometric.features import object_feature
from list3r.instances.settings import FEATURE_SPACE
from list3r.memory.core.records import LocalLibrary
from list3r.memory.library.consolidation import consolidate
from list3r.memory.store.store import Store
from tests import session_scenes
from tests.session_scenes import ROOM, Box, cameras, place_together

TABLE = (0.0, 0.0, 0.75)
ELSEWHERE = Box((-0.15, 0.25, 0.82), ROOM["green"].size, ROOM["green"].rgb)


def _add(store: Store, room: dict[str, Box], start: float, overlooked: str | None) -> None:
    """A session whose discovery overlooks one box."""
    poses = np.concatenate([cameras(TABLE, start), cameras(TABLE, start + 0.1)])
    result = session_scenes.simulated_chunk(room, poses)
    found = []
    for instance in result.library.instances:
        box = min(room.values(), key=lambda b: float(np.abs(instance.support.rgb[0].astype(int) - b.rgb).sum()))
        if overlooked is None or box is not room[overlooked]:
            feature = object_feature(instance.support.points, instance.support.rgb, np.array([0.0, 0.0, 1.0]), 1.0)
            found.append(replace(instance, feature=feature))
    library = LocalLibrary(tuple(found), np.zeros((0, 2), np.int32), FEATURE_SPACE)
    session = store.sessions.add("simulated", f"{len(store.sessions.all())}", {}, len(poses))
    store.chunks.add(session, replace(result, library=library))
    place_together(store)


def _two(path: Path, second: dict[str, Box], overlooked_then: str | None, overlooked_now: str | None) -> int:
    with Store.create(path) as store:
        with store.transaction():
            _add(store, dict(ROOM), 0.4, overlooked_then)
            consolidate(store)
        with store.transaction():
            _add(store, second, 1.0, overlooked_now)
            added = add_changed_places(store, 2)
            consolidate(store)
        assert store.verify() == []
        return added


def test_nothing_is_found_where_nothing_has_changed(tmp_path: Path) -> None:
    assert _two(tmp_path / "a.l3r", dict(ROOM), None, None) == 0


def test_what_is_found_already_is_not_found_again(tmp_path: Path) -> None:
    room = {k: b for k, b in ROOM.items() if k != "green"}
    assert _two(tmp_path / "a.l3r", room, None, None) == 0


def test_a_thing_that_was_overlooked_shows_itself_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "a.l3r"
    room = {k: b for k, b in ROOM.items() if k != "green"}
    assert _two(path, room, "green", None) == 1
    with Store.open(path) as store:
        (event,) = [e for e in store.events.all(2) if e.kind != "seen_again"]
        assert event.kind == "removed"
        assert event.from_box is not None
        np.testing.assert_allclose(event.from_box.center, ROOM["green"].center, atol=0.05)
        view = store.instances.get(event.instance_id).best_view
        assert view is not None
        assert view.session_id == 1


def test_and_one_overlooked_where_it_came_to(tmp_path: Path) -> None:
    path = tmp_path / "a.l3r"
    room = {**{k: b for k, b in ROOM.items() if k != "green"}, "green": ELSEWHERE}
    assert _two(path, room, None, "green") == 1
    with Store.open(path) as store:
        kinds = {e.kind: e for e in store.events.all(2) if e.kind != "seen_again"}
        place = (kinds.get("moved") or kinds["added"]).to_box
        assert place is not None
        np.testing.assert_allclose(place.center, ELSEWHERE.center, atol=0.05)


@pytest.mark.parametrize("overlooked", ["red", "blue"])
def test_what_stays_is_never_found_by_this(tmp_path: Path, overlooked: str) -> None:
    """Only change shows what discovery overlooked."""
    assert _two(tmp_path / "a.l3r", dict(ROOM), overlooked, None) == 0


def _plate(x: float, length: float, z: float = 0.0) -> np.ndarray:
    side = np.arange(0.0, length, 0.02)
    return np.array([[x + a, b, z] for a in side for b in np.arange(0.0, 0.12, 0.02)])


def test_an_instance_stands_for_a_change_if_nothing_of_it_stayed() -> None:
    gone, board = _plate(0.0, 0.2), _plate(0.2, 0.4)
    place = _Change(gone, [], np.concatenate([gone, board]), 1.0, ChangedPlaceSettings())
    assert place.explains(gone)
    assert place.explains(gone + 0.01)
    assert not place.explains(np.concatenate([gone, board]))
    assert not place.explains(board + np.array([0.1, 0.0, 0.0]))
    assert not place.explains(np.zeros((0, 3)))


def test_what_another_thing_took_the_place_of_need_not_be_seen_through() -> None:
    """The lower half of what stood there is hidden by what stands there now, whose rim is new."""
    top, bottom, new = _plate(0.0, 0.12), _plate(0.0, 0.3, -0.09), _plate(-0.05, 0.4, -0.1)
    told = np.concatenate([top, bottom])
    alone, replaced = (_Change(top, c, told, 1.0, ChangedPlaceSettings()) for c in ([], [new]))
    assert not alone.explains(told)
    assert replaced.explains(told)


def test_what_no_frame_tells_about_does_not_speak_against_an_instance() -> None:
    gone, hidden = _plate(0.0, 0.1), _plate(0.16, 0.3)
    support = np.concatenate([gone, hidden])
    assert _Change(gone, [], gone, 1.0, ChangedPlaceSettings()).explains(support)
    assert not _Change(gone, [], support, 1.0, ChangedPlaceSettings()).explains(support)
