"""The world as it was, asked by every query; what is gone does not answer unless asked for."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Room
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.maintenance.as_of import store_at
from list3r.memory.store.store import Store
from list3r.queries.nearest import nearest
from list3r.queries.within import within
from tests.session_scenes import ROOM, Box, add_session, cameras, place_together

TABLE = (0.0, 0.0, 0.75)
EVERYWHERE = {"lower": (-9, -9, -9), "upper": (9, 9, 9)}


def _changed() -> dict[str, Box]:
    """The room with blue moved, green taken away, purple put in."""
    room = {k: b for k, b in ROOM.items() if k != "green"}
    room["blue"] = Box((-0.1, 0.25, 0.80), ROOM["blue"].size, ROOM["blue"].rgb)
    room["purple"] = Box((0.55, -0.2, 0.83), (0.13, 0.13, 0.18), (140, 20, 160))
    return room


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("past") / "two.l3r"
    with Store.create(path) as store:
        for room, start in ((ROOM, 0.4), (_changed(), 1.0)):
            with store.transaction():
                add_session(store, room, cameras(TABLE, start))
                place_together(store)
                store.facts.gravity = "known"
                consolidate(store)
    return path


@pytest.fixture
def ids(memory: Path) -> dict[str, int]:
    rooms = {**ROOM, **_changed()}
    with Store.open(memory) as store:
        return {
            min(rooms, key=lambda k: float(np.abs(np.subtract(rooms[k].rgb, i.color_rgb)).sum())): i.id
            for i in store.instances.all()
        }


def test_rooms_are_those_of_today_and_a_past_memory_says_so(memory: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(memory, tmp_path / "rooms.l3r"))
    with Store.open(path, writable=True) as store, store.transaction():
        inside = tuple(i.id for i in store.instances.all(structure=False))
        corners = np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]])
        store.rooms.replace([Room(1, 0, 0.0, corners, 36.0, "", inside)], [])
    with list3r.open(path) as today, list3r.open(path, at=1) as then:
        assert len(today.rooms()) == 1 and today.find("box in room 1").exact
        assert then.rooms() == [] and then.doorways() == []
        assert "as it is today" in " ".join(then.find("box in room 1").notes)


@pytest.fixture
def past(memory: Path) -> Iterator[Store]:
    with Store.open(memory) as store, store_at(store, 1) as then:
        yield then


def test_what_is_gone_does_not_answer_unless_asked_for(memory: Path, ids: dict[str, int]) -> None:
    with Store.open(memory) as store:
        found = {m.instance.id for m in within(store, **EVERYWHERE)}
        assert ids["green"] not in found
        assert ids["blue"] in found
        assert {m.instance.id for m in within(store, **EVERYWHERE, state="removed")} == {ids["green"]}
        assert ids["green"] in {m.instance.id for m in within(store, **EVERYWHERE, state="any")}
        assert ids["green"] not in {m.instance.id for m in nearest(store, point=ROOM["green"].center, k=9)}


def test_every_question_can_be_about_the_world_as_it_was(past: Store, ids: dict[str, int]) -> None:
    there = {m.instance.id for m in within(past, **EVERYWHERE)}
    assert ids["green"] in there
    assert ids["purple"] not in there
    first = nearest(past, point=ROOM["blue"].center, k=1)[0]
    assert first.instance.id == ids["blue"]
    assert first.distance_m is not None
    assert first.distance_m < 0.1
    np.testing.assert_allclose(past.surfaces.of(ids["blue"]).points.mean(axis=0), ROOM["blue"].center, atol=0.06)
    assert [s.session_id for s in past.sessions.all()] == [1]
    assert {o.chunk_id for o in past.observations.all()} == {1}
    assert past.events.all() == []
    assert past.instances.bounds() is not None


def test_relations_then_are_those_of_then(memory: Path, past: Store, ids: dict[str, int]) -> None:
    assert [r for r in past.relations.all(ids["green"], "on", ids["table"])]
    assert [r for r in past.relations.all(ids["blue"], "on", ids["table"])]
    assert not [r for r in past.relations.all() if ids["purple"] in (r.subject, r.object)]
    with Store.open(memory) as store:
        assert not [r for r in store.relations.all() if ids["green"] in (r.subject, r.object)]


def test_the_past_cannot_be_written_and_the_file_stays_as_it_is(memory: Path, ids: dict[str, int]) -> None:
    before = memory.read_bytes()
    with Store.open(memory) as store:
        with store_at(store, 1) as then, pytest.raises(Exception, match="read"), then.transaction():
            then.facts.created_by = "x"
        assert store.verify() == []
        with pytest.raises(OptionError, match="no session 7"):
            store_at(store, 7)
    assert memory.read_bytes() == before
    with pytest.raises(OptionError, match="only be read"):
        list3r.open(memory, writable=True, at=1)


def test_the_last_session_is_the_world_of_today(memory: Path) -> None:
    with Store.open(memory) as store, store_at(store, 2) as now:
        assert [i.id for i in now.instances.all()] == [i.id for i in store.instances.all()]
        assert now.relations.all() == store.relations.all()
        assert len(now.events.all()) == len(store.events.all())


@pytest.mark.parametrize(
    "question",
    [
        ["nearest", "--point", "0,0,0.8"],
        ["within", "--point", "0,0,0.8", "--radius", "3"],
        ["find", "box"],
        ["relations"],
        ["changes"],
    ],
)
def test_the_program_takes_at_on_every_query(
    memory: Path, question: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    name, *rest = question
    words = [rest[0]] if name == "find" else []
    options = rest[1:] if name == "find" else rest
    assert run([name, str(memory), *words, *options, "--at", "1", "--json"]) == 0
    capsys.readouterr()
    assert run([name, str(memory), *words, *options, "--at", "9"]) == 2
    assert "no session 9" in capsys.readouterr().err
