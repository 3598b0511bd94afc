"""Well-formed memories with valid checksums that hold nonsense: shown or refused in one line, never a traceback."""

from __future__ import annotations

import importlib.util
import sqlite3
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

from list3r.cli.app import run
from list3r.memory.errors import MemoryFileError
from list3r.memory.geometry import Sim3
from list3r.memory.maintenance import edits
from list3r.memory.maintenance.repair import repair
from list3r.memory.records import Edge
from list3r.memory.store.rows.values import RULES, bad_references, bad_values
from list3r.memory.store.store import Store
from tests.conftest import write_small_room

Make = Callable[..., Path]
LIES = 8


@pytest.fixture(scope="module")
def lies() -> Iterator[ModuleType]:
    """`benchmarks/lies.py`, which does the same at length."""
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "lies.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(path.parent)
        spec = importlib.util.spec_from_file_location("lies", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        patch.setitem(sys.modules, "lies", module)
        spec.loader.exec_module(module)
        yield module


@pytest.fixture
def rich(tmp_path: Path) -> Path:
    """A memory with something in nearly every table."""
    path = tmp_path / "rich.l3r"
    with Store.create(path) as store:
        with store.transaction():
            write_small_room(store)
            store.edges.add(
                [Edge(1, 1, "loop", Sim3.identity(), 0.5, 0.5, 9, 0.01, True, "seen again", {"s_det": 0.5}, (0, 3))]
            )
        edits.label(store, 2, "mug")
        edits.merge(store, 3, 4)
    return path


def test_lies_end_in_no_traceback_and_no_hang(lies: ModuleType, rich: Path, tmp_path: Path) -> None:
    report = lies.tell_lies(rich, LIES, 5, tmp_path)
    assert report["problems"] == [] and report["commands"] >= 24 * LIES


SOME = {
    "instances 3: confidence": "UPDATE instances SET confidence = 7 WHERE id = 3",
    "instances 3: geometry": "UPDATE instances SET geometry = zeroblob(192) WHERE id = 3",
    "instances 3: label": "UPDATE instances SET label = CAST(x'ff41' AS TEXT) WHERE id = 3",
    "placements 1: S_world_chunk": "UPDATE placements SET S_world_chunk = zeroblob(104)",
    "frames 1:3: T_chunk_cam": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 3",
    "relations: object 77 is not in instances": "UPDATE relations SET object = 77 WHERE subject = 3",
    "aliases": "UPDATE aliases SET instance = id",
    "memory gravity: value": "UPDATE memory SET value = '\"sideways\"' WHERE key = 'gravity'",
    "edges 1:1:loop:0:3: scores": "UPDATE edges SET scores = '{\"s_det\": {}}'",
}


@pytest.mark.parametrize("told", SOME)
def test_a_lie_is_one_line_that_names_table_and_row(
    told: str, lies: ModuleType, rich: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(rich) as database:
        assert database.execute(SOME[told]).rowcount > 0
        lies._sign(database)
    assert run(["verify", str(rich)]) == 1
    assert told in capsys.readouterr().out
    with pytest.raises(MemoryFileError, match="repair"), Store.open(rich) as store:
        store.instances.all()
        store.relations.all()
        store.chunks.all()
        store.frames.all()
        store.ids.aliases()
        assert store.facts.gravity
        store.edges.all()


def test_a_label_that_is_no_text_is_mended(lies: ModuleType, rich: Path) -> None:
    with sqlite3.connect(rich) as database:
        database.execute(SOME["instances 3: label"])
        lies._sign(database)
    assert repair(rich).rebuilt
    with Store.open(rich) as store:
        assert store.verify() == [] and 2 in {i.id for i in store.instances.all()}


def test_there_is_a_rule_for_every_column_of_what_questions_read(rich: Path) -> None:
    with sqlite3.connect(rich) as database:
        for table in RULES:
            columns = {row[1] for row in database.execute(f"PRAGMA table_info({table})")}
            assert RULES[table].keys() <= columns
            left = columns - RULES[table].keys() - {"crc"}
            assert left <= {"u", "v", "chunk_id", "local_id", "instance"}, (table, left)
            assert list(bad_values(database, table)) == [] and list(bad_references(database, table)) == []


def test_many_aliases_are_followed_at_once(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store, store.transaction():
        store.ids.add_aliases({n: n + 1 for n in range(1000, 31_000)} | {31_000: 2})
    with Store.open(path) as store:
        assert len(store.ids.aliases_of(2)) == 30_001
