"""Well-formed memories with valid checksums that hold nonsense: shown or refused in one line, never a traceback."""

from __future__ import annotations

import importlib
import resource
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from list3r.cli.app import run
from list3r.memory.errors import MemoryFileError
from list3r.memory.maintenance.repair import repair
from list3r.memory.store.checksums import summed_tables
from list3r.memory.store.rows.values import RULES, bad_references, bad_values
from list3r.memory.store.store import Store

Make = Callable[..., Path]
LIES = 15


@pytest.fixture(scope="module")
def hostile() -> Iterator[SimpleNamespace]:
    """`benchmarks/hostile`, which does the same at length."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).resolve().parents[1] / "benchmarks")
        names = ("asking", "lies", "subject")
        yield SimpleNamespace(**{name: importlib.import_module(f"hostile.{name}") for name in names})


@pytest.fixture(scope="module")
def sound(hostile: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A memory with something in every table."""
    return Path(hostile.subject.write_subject(tmp_path_factory.mktemp("hostile") / "sound.l3r"))


@pytest.fixture
def rich(sound: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(sound, tmp_path / "rich.l3r"))


def test_every_table_holds_something_to_lie_about(hostile: SimpleNamespace, sound: Path) -> None:
    held = {table.name for table in hostile.lies._contents(sound)}
    assert held == {*summed_tables(), *hostile.lies.UNSIGNED}


def test_lies_end_in_no_traceback_and_no_hang(
    hostile: SimpleNamespace, sound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asking, path = hostile.asking, sound.with_name("lie.l3r")
    pictures = (c for c in asking.exports(costly=True) if "simready" not in c)  # seconds for each
    commands = (*asking.READS, *asking.exports(), *pictures, *asking.EDITS)
    monkeypatch.setattr(asking, "MOST_MB", asking.MOST_MB + resident_mb())  # other tests of this process hold theirs

    @settings(
        max_examples=LIES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(hostile.lies.lies(sound), st.lists(st.sampled_from(commands), min_size=4, max_size=4, unique=True))
    def tell(lie: Any, asked: list[str]) -> None:
        hostile.lies.write_lie(sound, path, lie)
        for command in ("verify", *asked):
            outcome = asking.ask(asking.command_on(path, command, path.parent))
            assert outcome.fine, (command, outcome)

    tell()


def resident_mb() -> int:
    """Return what this process holds now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 2**20


SOME = {
    "instances 3: confidence": "UPDATE instances SET confidence = 7 WHERE id = 3",
    "instances 3: geometry": "UPDATE instances SET geometry = zeroblob(192) WHERE id = 3",
    "instances 3: label": "UPDATE instances SET label = CAST(x'ff41' AS TEXT) WHERE id = 3",
    "instances 5: label": "UPDATE instances SET label = CAST(zeroblob(2097152) AS TEXT) WHERE id = 5",
    "instances 5: component": "UPDATE instances SET component = -1 WHERE id = 5",
    "placements 1: S_world_chunk": "UPDATE placements SET S_world_chunk = zeroblob(104)",
    "frames 1:3: T_chunk_cam": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 3",
    "relations: object 77 is not in instances": "UPDATE relations SET object = 77 WHERE subject = 3",
    "overlaps 2:2: scores": "UPDATE overlaps SET scores = scores || x'00' WHERE u = 2 AND v = 2",
    "bends 2: twists": "UPDATE bends SET twists = CAST(x'000000000000f87f' || zeroblob(length(twists) - 8) AS BLOB)",
    "bends 2: frames": "UPDATE bends SET frames = CAST(x'000000000000f07f' || zeroblob(length(frames) - 8) AS BLOB)",
    "aliases": "UPDATE aliases SET instance = id",
    "memory gravity: value": "UPDATE memory SET value = '\"sideways\"' WHERE key = 'gravity'",
    "edges 1:2:loop:0:3: scores": "UPDATE edges SET scores = '{\"s_det\": {}}'",
    "local_instances 1:5: feature": "UPDATE local_instances SET feature = zeroblob(20) WHERE local_id = 5",
}


@pytest.mark.parametrize("message", SOME)
def test_a_lie_is_one_line_that_names_table_and_row(
    message: str, hostile: SimpleNamespace, rich: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(rich) as database:
        assert database.execute(SOME[message]).rowcount > 0
        hostile.lies.sign(database)
    assert run(["verify", str(rich)]) == 1
    assert message in capsys.readouterr().out
    with pytest.raises(MemoryFileError, match="repair"), Store.open(rich) as store:
        store.instances.all()
        store.relations.all()
        store.chunks.all()
        store.frames.all()
        store.ids.aliases()
        assert store.facts.gravity
        store.edges.all()
        store.local_instances.nodes()
        store.library.overlaps.all([2])
        store.bends.all()


def test_an_edit_refuses_overlaps_of_local_instances_that_are_gone(
    hostile: SimpleNamespace, rich: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(rich) as database:
        database.execute("DELETE FROM local_instances WHERE chunk_id = 2 AND local_id = 3")
        hostile.lies.sign(database)
    assert run(["verify", str(rich)]) == 1
    assert "chunk_id, local_id 2, 3 is not in local_instances" in capsys.readouterr().out
    assert run(["merge", str(rich), "2", "5"]) == 2
    assert "local" in capsys.readouterr().err


def test_a_lie_about_what_is_not_listed_is_one_line(
    hostile: SimpleNamespace, rich: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Store.open(rich, writable=True) as store, store.transaction():
        held = store.library.members.of([c.chunk_id for c in store.chunks.all()])
        hidden = held[max(held)].first
        store.library.members.put([replace(m, shown=False) for m in held.values() if m.first == hidden])
    assert run(["list", str(rich), "--min-confidence", "0"]) == 0
    with sqlite3.connect(rich) as database:
        database.execute("UPDATE overlaps SET v = '' WHERE u = 1 AND v = 2")
        hostile.lies.sign(database)
    capsys.readouterr()
    assert run(["list", str(rich), "--min-confidence", "0"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1


def test_an_edit_refuses_overlaps_of_a_chunk_that_is_redundant(
    hostile: SimpleNamespace, rich: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sqlite3.connect(rich) as database:
        database.execute("DELETE FROM members")
        hostile.lies.sign(database)
    assert run(["merge", str(rich), "2", "5"]) == 2
    assert "chunk 2" in capsys.readouterr().err
    assert run(["verify", str(rich)]) == 1
    assert "overlaps: chunk 2 is redundant" in capsys.readouterr().out
    repair(rich)
    assert run(["merge", str(rich), "2", "5"]) == 0


def test_a_label_that_is_no_text_is_mended(hostile: SimpleNamespace, rich: Path) -> None:
    with sqlite3.connect(rich) as database:
        database.execute(SOME["instances 3: label"])
        hostile.lies.sign(database)
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
