"""Sessions of one room: who is who, what moved, what went, what came, and what nobody could see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.records import Instance
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.maintenance.history import world_at
from list3r.memory.store.facts import Fact
from list3r.memory.store.store import Store
from list3r.queries.changes import changes
from tests.session_scenes import ROOM, Box, add_session, cameras, place_together

TABLE = (0.0, 0.0, 0.75)
IDS = Fact[dict[str, int]]("test ids", dict[str, int], {})


def _changed() -> dict[str, Box]:
    """The room with blue moved, green taken away, purple put in, and the stool far out of view."""
    room = {k: b for k, b in ROOM.items() if k != "green"}
    room["blue"] = replace(room["blue"], center=(-0.1, 0.25, 0.80))
    room["purple"] = Box((0.55, -0.2, 0.83), (0.13, 0.13, 0.18), (140, 20, 160))
    return room


def _named(instances: list[Instance]) -> dict[str, Instance]:
    """Instances by the box whose colour they have."""
    colors = {k: b.rgb for k, b in {**ROOM, **_changed()}.items()}
    return {min(colors, key=lambda k: float(np.abs(np.subtract(colors[k], i.color_rgb)).sum())): i for i in instances}


@pytest.fixture
def memory(tmp_path: Path) -> Path:
    """Two sessions; the first also looked at the stool."""
    path = tmp_path / "two.l3r"
    with Store.create(path) as store:
        with store.transaction():
            poses = np.concatenate([cameras(TABLE, 0.4), cameras((0.0, 2.4, 0.3), -0.8)])
            add_session(store, ROOM, poses)
            place_together(store)
            consolidate(store)
        ids = {k: i.id for k, i in _named(store.instances.all()).items()}
        with store.transaction():
            add_session(store, _changed(), cameras(TABLE, 1.0))
            place_together(store)
            consolidate(store)
            store.facts[IDS] = ids
    return path


def test_events_name_what_was_done(memory: Path) -> None:
    with Store.open(memory) as store:
        ids, now = store.facts[IDS], _named(store.instances.all())
        kinds = {e.instance_id: e.kind for e in store.events.all(2)}
        assert kinds[ids["red"]] == "seen_again"
        assert kinds[ids["table"]] == "seen_again"
        assert kinds[ids["blue"]] == "moved"
        assert kinds[ids["green"]] == "removed"
        assert kinds[now["purple"].id] == "added"
        assert ids["stool"] not in kinds
        assert {k: i.state for k, i in now.items()} == {
            "table": "present",
            "red": "present",
            "blue": "moved",
            "green": "removed",
            "purple": "added",
            "stool": "unseen",
        }


def test_ids_are_kept_and_a_moved_thing_is_where_it_is_now(memory: Path) -> None:
    with Store.open(memory) as store:
        ids, now = store.facts[IDS], _named(store.instances.all())
        for name in ("table", "red", "blue", "green", "stool"):
            assert now[name].id == ids[name]
        np.testing.assert_allclose(now["blue"].center, [-0.1, 0.25, 0.80], atol=0.02)
        np.testing.assert_allclose(np.sort(now["blue"].box.size), [0.12, 0.12, 0.12], atol=0.03)
        points = store.surfaces.of(ids["blue"]).points
        assert len(points)
        assert np.linalg.norm(points - now["blue"].center, axis=1).max() < 0.2
        assert not [r for r in store.relations.all() if ids["green"] in (r.subject, r.object)]
        assert store.verify() == []


def test_the_world_as_it_was(memory: Path) -> None:
    with Store.open(memory) as store:
        then = _named(world_at(store, 1))
        assert set(then) == {"table", "red", "blue", "green", "stool"}
        assert {i.state for i in then.values()} == {"present"}
        np.testing.assert_allclose(then["blue"].center, [0.5, 0.2, 0.80], atol=0.02)
        now = {i.id: i for i in world_at(store, 2)}
        for instance in store.instances.all():
            assert now[instance.id].state == instance.state
            np.testing.assert_array_equal(now[instance.id].center, instance.center)


def test_the_query_tells_kind_place_and_evidence(memory: Path) -> None:
    with Store.open(memory) as store:
        found = changes(store)
        assert [c.event.kind for c in found] == ["moved", "removed", "added"]
        assert found[0].distance_m == pytest.approx(np.hypot(0.6, 0.05), abs=0.03)
        assert all(c.event.frames and c.reason and 0 < c.score <= 1 for c in found)
        assert all(session == 2 for c in found for session, _ in c.event.frames)
        assert changes(store, since=2) == []


def test_the_same_room_again_shows_no_change(tmp_path: Path) -> None:
    with Store.create(tmp_path / "same.l3r") as store:
        with store.transaction():
            add_session(store, ROOM, cameras(TABLE, 0.4))
            add_session(store, ROOM, cameras(TABLE, 2.2))
            place_together(store)
            consolidate(store)
        assert {e.kind for e in store.events.all()} == {"seen_again"}


def test_a_session_in_a_world_of_its_own_changes_nothing(tmp_path: Path) -> None:
    with Store.create(tmp_path / "apart.l3r") as store:
        with store.transaction():
            add_session(store, ROOM, cameras(TABLE, 0.4))
            add_session(store, _changed(), cameras(TABLE, 2.2))
            consolidate(store)
        assert store.events.all() == []
        assert {i.state for i in store.instances.all()} == {"present"}
        assert len({i.component for i in store.instances.all()}) == 2


def test_what_came_back_is_added_under_its_id(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        ids = store.facts[IDS]
        with store.transaction():
            add_session(store, ROOM, cameras(TABLE, 1.2))
            place_together(store)
            consolidate(store)
        kinds = {e.instance_id: e.kind for e in store.events.all(3)}
        assert kinds[ids["green"]] == "added"
        assert kinds[ids["blue"]] == "moved"
        now = _named(store.instances.all())
        np.testing.assert_allclose(now["blue"].center, [0.5, 0.2, 0.80], atol=0.02)
        assert now["purple"].state == "removed"
        np.testing.assert_allclose(_named(world_at(store, 2))["blue"].center, [-0.1, 0.25, 0.80], atol=0.02)
