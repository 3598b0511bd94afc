"""Damage is found by `verify`, and `repair` saves what is sound and names the rest."""

from __future__ import annotations

import contextlib
import importlib
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from list3r.cli.app import run
from list3r.exporters.scene_json import scene_dict
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.core.records import Instance
from list3r.memory.library.maintenance.repair import repair
from list3r.memory.store.file import PAGE_BYTES, connected
from list3r.memory.store.store import Store
from tests.conftest import SMALL_ROOM, write_small_room

Make = Callable[..., Path]


def spoil(path: Path, *statements: str) -> None:
    """Change rows behind the back of the program."""
    with sqlite3.connect(path) as database:
        for statement in statements:
            assert database.execute(statement).rowcount > 0


ROWS = {
    "a place of a chunk": "UPDATE placements SET S_world_chunk = zeroblob(104)",
    "an edge": "UPDATE edges SET S_v_u = zeroblob(104)",
    "a pose": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 4",
    "a time": "UPDATE frames SET time_s = 3.5 WHERE frame_index = 4",
    "a geometry": "UPDATE instances SET geometry = zeroblob(144) WHERE id = 3",
    "a label": "UPDATE instances SET label = 'cup' WHERE id = 3",
    "a vector": "UPDATE embeddings SET vector = zeroblob(64) WHERE instance = 2",
    "a relation": "UPDATE relations SET object = 5 WHERE subject = 3",
    "an observation": "UPDATE observations SET instance = 5 WHERE local_id = 3",
    "a value": "UPDATE memory SET value = '\"known\"' WHERE key = 'gravity'",
    "an alias": "UPDATE aliases SET instance = 2",
    "an edit": "UPDATE edits SET author = 'somebody else'",
    "a flag": "UPDATE local_instances SET dynamic = 1 WHERE local_id = 0",
    "sums": "UPDATE pages SET sums = zeroblob(4100) WHERE first = 0",
    "the state": "UPDATE pages SET sums = zeroblob(8) WHERE first = -1",
    "a lost frame": "DELETE FROM frames WHERE frame_index = 5",
    "a lost relation": "DELETE FROM relations WHERE subject = 5",
    "a box": "UPDATE instance_boxes SET max_x = max_x + 1 WHERE id = 3",
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A memory with something in every table, of two chunks; not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).resolve().parents[1] / "benchmarks")
        yield importlib.import_module("hostile.subject").write_subject(tmp_path_factory.mktemp("sound") / "sound.l3r")


@pytest.fixture
def rich(sound: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(sound, tmp_path / "rich.l3r"))


def pages_of(path: Path, table: str, kind: str) -> list[int]:
    """Numbers of the pages of a table that are a leaf, or overflow."""
    with contextlib.closing(connected(path, "ro")) as database:
        query = "SELECT pageno FROM dbstat WHERE name = ? AND pagetype = ? ORDER BY path"
        return [n for (n,) in database.execute(query, (table, kind))]


def zero(path: Path, page: int) -> None:
    """Let a page be zeros, as a copy that was broken off leaves it."""
    data = bytearray(path.read_bytes())
    data[(page - 1) * PAGE_BYTES : page * PAGE_BYTES] = bytes(PAGE_BYTES)
    path.write_bytes(data)


@pytest.mark.parametrize("case", ROWS)
def test_verify_finds_any_row_that_is_not_as_it_was_written(case: str, rich: Path) -> None:
    with Store.open(rich, writable=True) as store:
        assert store.verify() == []
    spoil(rich, ROWS[case])
    with Store.open(rich) as store:
        assert store.verify() != []


def test_what_is_not_as_it_was_written_is_not_answered_with(make_memory: Make) -> None:
    path = make_memory()
    spoil(path, "UPDATE instances SET confidence = 0.123 WHERE id = 3")
    for ask in (
        lambda store: store.instances.all(),
        lambda store: store.instances.get(3),
        lambda store: store.instances.of([2, 3]),
    ):
        with Store.open(path) as store:
            for _ in range(2):
                with pytest.raises(MemoryFileError, match=r"page \d+ is not as it was written.*repair"):
                    ask(store)
    with Store.open(path) as store:
        assert any("instances: page" in text for text in store.verify()), "what is damaged can be looked at"


@pytest.mark.parametrize(
    ("statement", "ask"),
    [
        ("UPDATE relations SET object = 5 WHERE subject = 3", lambda store: store.relations.all(3)),
        (
            "UPDATE instance_boxes SET max_x = max_x + 1 WHERE id = 3",
            lambda store: store.instances.ids_in_box([0] * 3, [1] * 3),
        ),
        (
            "UPDATE embeddings SET vector = zeroblob(64) WHERE instance = 2",
            lambda store: store.embeddings.all("test@1/16"),
        ),
        ("UPDATE memory SET value = '\"known\"' WHERE key = 'gravity'", lambda store: store.facts.gravity),
        (
            "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id = 4",
            lambda store: store.surfaces.of(5),
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
    spoil(path, "UPDATE instances SET geometry = zeroblob(144) WHERE id = 3", "DELETE FROM relations WHERE subject = 3")
    report = repair(path)
    assert report.rebuilt and report.lost == {} and len(report.damage) >= 2
    with Store.open(path) as store:
        assert store.verify() == []
        mug: Instance = store.instances.get(3)
        assert np.allclose(mug.center, SMALL_ROOM[2][1], atol=0.02)
    assert report.original.name == "room.l3r.damaged"
    with Store.open(report.original) as store:
        assert store.verify() != []


@pytest.fixture
def dense(tmp_path: Path) -> Path:
    """A memory whose surfaces take more than a page each."""
    with Store.create(tmp_path / "dense.l3r") as store, store.transaction():
        write_small_room(store, points=4000)
    return tmp_path / "dense.l3r"


def test_what_was_measured_and_is_damaged_is_named(dense: Path) -> None:
    path = dense
    with Store.open(path) as store:
        frames = len(store.frames.all())
    zero(path, pages_of(path, "supports", "overflow")[3 * 4 + 1])
    report = repair(path)
    assert report.lost == {"supports": ["1:4"], "instances": ["5"]}
    with Store.open(path) as store:
        assert store.verify() == []
        assert {i.id for i in store.instances.all()} == {1, 2, 3, 4, 6}
        assert len(store.frames.all()) == frames


def test_of_a_large_table_only_the_rows_on_a_damaged_page_are_lost(make_memory: Make) -> None:
    path = make_memory()
    count = 9000
    with Store.open(path, writable=True) as store, store.transaction():
        store.ids.add_aliases({n: 2 for n in range(1000, 1000 + count)})
    leaves = pages_of(path, "aliases", "leaf")
    assert len(leaves) > 2
    zero(path, leaves[1])
    assert repair(path).lost["aliases"] == ["rows on damaged pages"]
    with Store.open(path) as store:
        kept = sorted(store.ids.aliases())
        assert kept[0] == 1000 and kept[-1] == 999 + count
        assert count - 1.5 * count / len(leaves) < len(kept) < count


def test_a_lost_chunk_takes_along_what_hung_on_it(rich: Path, tmp_path: Path) -> None:
    with Store.open(rich, writable=True) as store, store.transaction():
        store.connection.execute("UPDATE chunks SET overlap = zeroblob(40000) WHERE chunk_id = 2")
    zero(rich, pages_of(rich, "chunks", "overflow")[-1])
    report = repair(rich, tmp_path / "sound.l3r")
    assert report.lost["chunks"] == ["2"] and report.lost["edges"] and report.chunks == 1
    with Store.open(tmp_path / "sound.l3r") as store:
        assert store.verify() == [] and [c.chunk_id for c in store.chunks.all()] == [1]


def test_a_chunk_whose_place_is_lost_is_placed_by_its_relations(rich: Path, tmp_path: Path) -> None:
    with Store.open(rich, writable=True) as store:
        (edge,) = [e for e in store.edges.all() if e.accepted]
        with store.transaction():
            store.connection.execute("DELETE FROM placements WHERE chunk_id = 2")
    with Store.open(rich) as store:
        assert any("chunks: a row points to one of placements" in text for text in store.verify())
    report = repair(rich, tmp_path / "sound.l3r")
    assert report.lost["placements"] == ["2"] and report.rebuilt and (edge.u, edge.v) == (1, 2)
    with Store.open(tmp_path / "sound.l3r") as store:
        assert store.verify() == []
        S_v_u = store.chunks.get(2).S_world_chunk.inverse() @ store.chunks.get(1).S_world_chunk
        assert np.allclose(S_v_u.as_matrix(), edge.S_v_u.as_matrix())


@pytest.mark.parametrize("first", [-1, 0])
def test_pages_are_taken_as_they_are_where_their_sums_are_damaged(first: int, make_memory: Make) -> None:
    path = make_memory()
    spoil(path, f"UPDATE pages SET sums = zeroblob(length(sums)) WHERE first = {first}")
    report = repair(path)
    assert report.damage and report.lost == {} and report.instances == len(SMALL_ROOM)
    with Store.open(path) as store:
        assert store.verify() == [] and len(store.frames.all()) == 20


def test_a_broken_page_costs_only_what_lay_on_it(make_memory: Make) -> None:
    path = make_memory()
    zero(path, pages_of(path, "relations", "leaf")[0])
    report = repair(path)
    assert report.rebuilt and not report.lost and report.instances == len(SMALL_ROOM)
    with Store.open(path) as store:
        assert store.verify() == []


def test_a_lost_session_is_stood_in_for(make_memory: Make) -> None:
    path = make_memory()
    spoil(path, "UPDATE sessions SET source = 'elsewhere'")
    assert repair(path).lost["sessions"] == ["1"]
    with Store.open(path) as store:
        assert store.sessions.all()[0].source == "unknown" and len(store.instances.all()) == len(SMALL_ROOM)


def test_the_command_says_what_is_lost(dense: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = dense
    assert run(["repair", str(path)]) == 0
    zero(path, pages_of(path, "supports", "overflow")[13])
    assert run(["verify", str(path)]) == 1
    assert run(["repair", str(path)]) == 0
    assert run(["verify", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "nothing was changed" in shown and "lost instances: 5" in shown and "dense.l3r.damaged" in shown
    (path.parent / "note").write_text("no memory")
    assert run(["repair", str(path.parent / "note")]) == 2


def test_what_cannot_be_understood_is_said_to_be_damage(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store, store.transaction():
        store.connection.execute("UPDATE sessions SET settings = '{'")
    with pytest.raises(MemoryFileError, match="verify"), Store.open(path) as store:
        store.sessions.all()
