"""Damage is found by `verify`, and `repair` saves what is sound and names the rest."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from list3r.cli.app import run
from list3r.exporters.scene_json import scene_dict
from list3r.memory.errors import MemoryFileError
from list3r.memory.maintenance.repair import repair
from list3r.memory.records import Instance
from list3r.memory.store.file import PAGE_BYTES
from list3r.memory.store.store import Store
from tests.conftest import SMALL_ROOM

Make = Callable[..., Path]
FIXTURES = Path(__file__).parent / "fixtures"


def spoil(path: Path, *statements: str) -> None:
    """Change rows behind the back of the program."""
    with sqlite3.connect(path) as database:
        for statement in statements:
            assert database.execute(statement).rowcount > 0


ROWS = {
    "a place of a chunk": "UPDATE placements SET S_world_chunk = zeroblob(104)",
    "an edge": "UPDATE edges SET S_v_u = zeroblob(104)",
    "a pose": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 7",
    "a time": "UPDATE frames SET time_s = 3.0 WHERE frame_index = 7",
    "a geometry": "UPDATE instances SET geometry = zeroblob(192) WHERE id = 3",
    "a label": "UPDATE instances SET label = 'cup' WHERE id = 3",
    "a vector": "UPDATE embeddings SET vector = zeroblob(64) WHERE instance = 2",
    "a relation": "UPDATE relations SET object = 5 WHERE subject = 3",
    "an observation": "UPDATE observations SET instance = 2 WHERE local_id = 3",
    "a value": "UPDATE memory SET value = '\"known\"' WHERE key = 'gravity'",
    "an alias": "UPDATE aliases SET instance = 2",
    "a reason": "UPDATE merges SET reason = 'so'",
    "a flag": "UPDATE local_instances SET dynamic = 1 WHERE local_id = 0",
    "a checksum": "UPDATE sums SET crcs = zeroblob(8) WHERE name = 'relations'",
    "a lost frame": "DELETE FROM frames WHERE frame_index = 9",
    "a lost relation": "DELETE FROM relations WHERE subject = 5",
    "a box": "UPDATE instance_boxes SET max_x = max_x + 1 WHERE id = 3",
}


@pytest.mark.parametrize("case", ROWS)
def test_verify_finds_any_row_that_is_not_as_it_was_written(case: str, tmp_path: Path) -> None:
    path = tmp_path / "old.l3r"
    shutil.copy(FIXTURES / "schema2.l3r", path)
    with Store.open(path, writable=True) as store:
        assert store.verify() == []
    spoil(path, ROWS[case])
    with Store.open(path) as store:
        assert store.verify() != []


@pytest.mark.parametrize("whole", [True, False])
def test_what_is_not_as_it_was_written_is_not_answered_with(
    whole: bool, make_memory: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_memory()
    spoil(path, "UPDATE instances SET confidence = 0.123 WHERE id = 3")
    monkeypatch.setattr("list3r.memory.store.connection.WHOLE_BYTES", 2**40 if whole else 0)
    monkeypatch.setattr("list3r.memory.store.read_checks.MOST_ROWS", 0)
    for ask in (
        lambda store: store.instances.all(),
        lambda store: store.instances.get(3),
        lambda store: store.instances.of([2, 3]),
    ):
        with Store.open(path) as store, pytest.raises(MemoryFileError, match=r"instances 3: .*repair"):
            ask(store)
    with Store.open(path) as store:
        assert store.verify() != [], "what is damaged can be looked at"


def test_large_memories_check_the_relations_and_surfaces_that_they_read(
    make_memory: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_memory()
    monkeypatch.setattr("list3r.memory.store.connection.WHOLE_BYTES", 0)
    monkeypatch.setattr("list3r.memory.store.read_checks.MOST_ROWS", 0)
    with Store.open(path) as store:
        assert (
            len(store.relations.all(3)) == 1
            and len(store.surfaces.points(5)) == len(store.surfaces.of(5).points) == 400
        )
    spoil(path, "UPDATE relations SET margin = 0.5 WHERE subject = 3")
    spoil(path, "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id = 4")
    with Store.open(path) as store, pytest.raises(MemoryFileError, match="relations 3: the row is not"):
        store.relations.all(3)
    for ask in (lambda store: store.surfaces.points(5), lambda store: store.surfaces.of(5)):
        with Store.open(path) as store, pytest.raises(MemoryFileError, match="supports 1:4: the checksum"):
            ask(store)
    with Store.open(path) as store:
        assert len(store.relations.all(4)) == 1


@pytest.mark.parametrize(
    ("statement", "ask"),
    [
        ("UPDATE relations SET object = 5 WHERE subject = 3", lambda store: store.relations.all(3)),
        (
            "UPDATE instance_boxes SET max_x = max_x + 1 WHERE id = 3",
            lambda store: store.instances.ids_in_box([0] * 3, [1] * 3),
        ),
        ("UPDATE embeddings SET vector = zeroblob(64) WHERE instance = 2", lambda store: store.embeddings.spaces()),
        ("UPDATE memory SET value = '\"known\"' WHERE key = 'gravity'", lambda store: store.facts.gravity),
        (
            "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id = 4",
            lambda store: store.surfaces.of(2),
        ),
    ],
)
def test_no_table_is_believed_unseen(statement: str, ask: Callable[[Store], object], make_memory: Make) -> None:
    path = make_memory()
    spoil(path, statement)
    with Store.open(path) as store, pytest.raises(MemoryFileError, match="repair"):
        ask(store)


def test_a_sound_memory_is_left_alone_or_copied(make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    before = path.read_bytes()
    assert repair(path).damage == ()
    report = repair(path, tmp_path / "copy.l3r")
    assert path.read_bytes() == before
    assert (report.lost, report.rebuilt) == ({}, False)
    with Store.open(path) as a, Store.open(tmp_path / "copy.l3r") as b:
        assert scene_dict(a) == scene_dict(b)
    with pytest.raises(MemoryFileError, match="already exists"):
        repair(path, tmp_path / "copy.l3r")


def test_what_is_derived_is_derived_anew(make_memory: Make) -> None:
    path = make_memory()
    spoil(path, "UPDATE instances SET geometry = zeroblob(192) WHERE id = 3", "DELETE FROM relations WHERE subject = 3")
    report = repair(path)
    assert report.rebuilt and report.lost == {} and len(report.damage) >= 2
    with Store.open(path) as store:
        assert store.verify() == []
        mug: Instance = store.instances.get(3)
        assert np.allclose(mug.center, SMALL_ROOM[2][1], atol=0.02)
    assert report.original.name == "room.l3r.damaged"
    with Store.open(report.original) as store:
        assert store.verify() != []


def test_what_was_measured_and_is_damaged_is_named(make_memory: Make) -> None:
    path = make_memory()
    spoil(
        path,
        "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id = 4",
        "UPDATE keyframes SET features = zeroblob(9)",
        "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 7",
    )
    report = repair(path)
    assert report.lost["supports"] == ["1:4"] and report.lost["keyframes"] == ["1:0"]
    assert report.lost["frames"] == ["1:7"] and report.lost["instances"] == ["5"]
    with Store.open(path) as store:
        assert store.verify() == []
        assert {i.id for i in store.instances.all()} == {1, 2, 3, 4, 6}
        assert len(store.frames.all()) == 19


def test_a_lost_chunk_takes_along_what_hung_on_it(tmp_path: Path) -> None:
    path = tmp_path / "old.l3r"
    shutil.copy(FIXTURES / "schema2.l3r", path)
    Store.open(path, writable=True).close()
    spoil(path, "UPDATE chunks SET fx = 7 WHERE chunk_id = 2")
    report = repair(path, tmp_path / "sound.l3r")
    assert report.lost["chunks"] == ["2"] and report.lost["edges"] and report.chunks == 1
    with Store.open(tmp_path / "sound.l3r") as store:
        assert store.verify() == [] and [c.chunk_id for c in store.chunks.all()] == [1]


def test_a_chunk_whose_place_is_lost_is_placed_by_its_relations(tmp_path: Path) -> None:
    path = tmp_path / "old.l3r"
    shutil.copy(FIXTURES / "schema2.l3r", path)
    with Store.open(path, writable=True) as store:
        (edge,) = [e for e in store.edges.all() if e.accepted]
    spoil(path, "UPDATE placements SET S_world_chunk = zeroblob(104) WHERE chunk_id = 2")
    report = repair(path, tmp_path / "sound.l3r")
    assert report.lost["placements"] == ["2"] and report.rebuilt and (edge.u, edge.v) == (1, 2)
    with Store.open(tmp_path / "sound.l3r") as store:
        assert store.verify() == []
        S_v_u = store.chunks.get(2).S_world_chunk.inverse() @ store.chunks.get(1).S_world_chunk
        assert np.allclose(S_v_u.as_matrix(), edge.S_v_u.as_matrix())


def test_a_broken_page_costs_only_what_lay_on_it(make_memory: Make) -> None:
    path = make_memory()
    with sqlite3.connect(path) as database:
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'relations'").fetchone()
    data = bytearray(path.read_bytes())
    data[(root - 1) * PAGE_BYTES : root * PAGE_BYTES] = bytes(PAGE_BYTES)
    path.write_bytes(data)
    report = repair(path)
    assert report.rebuilt and not report.lost and report.instances == len(SMALL_ROOM)
    with Store.open(path) as store:
        assert store.verify() == []


def test_a_lost_session_is_stood_in_for(make_memory: Make) -> None:
    path = make_memory()
    spoil(path, "UPDATE sessions SET source = 'elsewhere'")
    assert repair(path).lost == {"sessions": ["1"]}
    with Store.open(path) as store:
        assert store.sessions.all()[0].source == "unknown" and len(store.instances.all()) == len(SMALL_ROOM)


def test_the_command_says_what_is_lost(make_memory: Make, capsys: pytest.CaptureFixture[str]) -> None:
    path = make_memory()
    assert run(["repair", str(path)]) == 0
    spoil(path, "UPDATE supports SET rgb = zeroblob(length(rgb)) WHERE local_id = 4")
    assert run(["verify", str(path)]) == 1
    assert run(["repair", str(path)]) == 0
    assert run(["verify", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "nothing was changed" in shown and "lost instances: 5" in shown and "room.l3r.damaged" in shown
    (path.parent / "note").write_text("no memory")
    assert run(["repair", str(path.parent / "note")]) == 2


def test_what_cannot_be_understood_is_said_to_be_damage(make_memory: Make) -> None:
    path = make_memory()
    spoil(path, "UPDATE sessions SET settings = '{'")
    with pytest.raises(MemoryFileError, match="repair"), Store.open(path) as store:
        store.sessions.all()
