"""What a memory survives: kills, readers beside a writer, flipped bytes, files of strangers and of older programs."""

from __future__ import annotations

import importlib.util
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from list3r.memory.core.errors import MemoryFileError
from list3r.memory.store import connection, file, schema
from list3r.memory.store.rows.codec import pack, unpack
from list3r.memory.store.store import Store
from list3r.simulation.dataset import WalkSettings, write_walk

Make = Callable[..., Path]


@pytest.fixture(scope="module")
def safety() -> Iterator[ModuleType]:
    """`benchmarks/safety.py`, which does the same at length."""
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "safety.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(path.parent)
        yield _module(path)


def _module(path: Path) -> ModuleType:
    """A program as a module."""
    spec = importlib.util.spec_from_file_location("safety", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["safety"] = module
    spec.loader.exec_module(module)
    return module


def program(text: str) -> subprocess.Popen[str]:
    """Another process, which prints a line when it is ready and ends when its input does."""
    command = [sys.executable, "-c", text + "\nprint('ready', flush=True); input()"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


# ------------------------------------------------------------------------------------------- kills and readers


@pytest.fixture(scope="module")
def killed_build(safety: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """What is told of a build that was killed once, and the memory of the same walk that was left alone."""
    folder = tmp_path_factory.mktemp("killed")
    walk = write_walk(folder / "walk", WalkSettings(seed=3, frames=20, size=(128, 96)), workers=1)
    return safety.kill_builds(walk, folder, 1), folder / "whole.l3r"


@pytest.mark.slow
def test_a_killed_build_loses_nothing_and_is_completed(killed_build: tuple[dict[str, Any], Path]) -> None:
    report, _ = killed_build
    assert report["problems"] == [] and report["kills"] == 1


@pytest.mark.slow
def test_killed_transactions_are_whole_or_not_there(safety: ModuleType, make_memory: Make) -> None:
    report = safety.kill_writes(make_memory(), 3)
    assert report["problems"] == [] and report["transactions"] >= 3


@pytest.mark.slow
def test_a_killed_update_and_killed_edits_lose_nothing(
    safety: ModuleType, killed_build: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    _, base = killed_build
    second = WalkSettings(seed=3, walk_seed=4, start=2, frames=14, size=(128, 96))
    report = safety.kill_updates(base, write_walk(tmp_path / "second", second, workers=1), tmp_path, 1)
    assert report["problems"] == [] and report["kills"] == 1
    report = safety.kill_edits(tmp_path / "updated.l3r", 1)
    assert report["problems"] == [] and report["edits"] >= 1
    report = safety.kill_commands(tmp_path / "updated.l3r", 1)
    assert report["problems"] == [] and report["kills"] == 1


@pytest.mark.slow
def test_readers_in_other_processes_see_whole_transactions(safety: ModuleType, make_memory: Make) -> None:
    report = safety.write_and_read(make_memory(), 2.0, readers=2)
    assert report["problems"] == []
    assert report["transactions"] > 0 and report["snapshots"] > 0


# ------------------------------------------------------------------------------------------- damage


def test_a_flipped_byte_is_found_or_does_no_harm(safety: ModuleType, make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    original = path.read_bytes()
    with Store.open(path) as store:
        wanted = safety.answers(store)
    seen = set()
    for n in range(60):
        data, what = safety.damaged(original, safety.random.Random(n))
        (tmp_path / "flipped.l3r").write_bytes(data)
        outcome, text = safety.outcome_of(tmp_path / "flipped.l3r", wanted, what)
        assert outcome not in ("silent", "traceback"), text
        seen.add(outcome)
    assert {"detected by verify", "harmless"} <= seen


def test_any_change_of_packed_arrays_is_refused_or_harmless() -> None:
    arrays = {"a": np.arange(40), "b": np.ones((3, 2), np.float32), "c": np.asfortranarray(np.eye(3)[:, :2])}
    blob = pack(arrays)
    rng = np.random.default_rng(0)
    for _ in range(400):
        data = bytearray(blob)
        data[rng.integers(len(data))] ^= int(rng.integers(1, 256))
        try:
            found = unpack(bytes(data), "a row")
        except MemoryFileError:
            continue
        assert {str(a.tolist()) for a in found.values()} <= {str(a.tolist()) for a in arrays.values()}


# ------------------------------------------------------------------------------------------- strangers


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER t AFTER INSERT ON memory BEGIN DELETE FROM instances; END",
        "CREATE VIEW v AS SELECT * FROM memory",
        "CREATE TABLE more (x)",
        "CREATE INDEX i ON instances (label)",
        "DROP TABLE relations",
        "ALTER TABLE memory ADD COLUMN x TEXT",
    ],
)
@pytest.mark.parametrize("writable", [False, True])
def test_what_no_memory_has_is_refused(statement: str, writable: bool, make_memory: Make) -> None:
    path = make_memory()
    with sqlite3.connect(path) as database:
        database.execute(statement)
    with pytest.raises(MemoryFileError, match=r"not opened|damaged or of another program"):
        Store.open(path, writable=writable)


def test_a_view_in_the_place_of_a_table_is_refused(make_memory: Make) -> None:
    path = make_memory()
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE relations")
        database.execute("CREATE VIEW relations AS SELECT randomblob(1000000000)")
    with pytest.raises(MemoryFileError, match="view 'relations'"):
        Store.open(path)


# ------------------------------------------------------------------------------------------- older programs


@pytest.mark.parametrize("writable", [False, True])
def test_an_older_memory_is_migrated_where_it_lies_or_read_from_a_copy(
    writable: bool, make_memory: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_memory()
    before = path.read_bytes()
    second = "UPDATE instances SET label = 'new' WHERE id = 2; CREATE INDEX more ON instances (state)"
    later = (*schema.MIGRATIONS, second)
    for module in (schema, file):
        monkeypatch.setattr(module, "MIGRATIONS", later)
    for module in (schema, file, connection):
        monkeypatch.setattr(module, "SCHEMA_VERSION", len(later))
    schema.expected_schema.cache_clear()
    try:
        with Store.open(path, writable=writable) as store:
            assert store.verify() == [] and store.instances.get(2).label == "new" and store.path == path
            assert len(store.instances.all()) == 6
    finally:
        schema.expected_schema.cache_clear()
    assert (path.read_bytes() == before) == (not writable)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


# ------------------------------------------------------------------------------------------- the lock


def test_the_lock_names_its_holder_and_ends_with_it(make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    text = f"from list3r.memory.store.store import Store; store = Store.open({str(path)!r}, writable=True)"
    holder = program(text)
    with pytest.raises(MemoryFileError, match=rf"process {holder.pid} on .*, since 20.*wait for it to end"):
        Store.open(path, writable=True)
    with Store.open(path) as reader:
        assert len(reader.instances.all()) == 6
    holder.kill()
    holder.communicate()
    with Store.open(path, writable=True) as store:
        assert store.verify() == []
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_reader_keeps_its_snapshot_when_the_same_process_opens_and_closes_the_file(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as writer:
        with Store.open(path) as reader, reader.snapshot():
            count = len(reader.instances.all())
            Store.open(path).close()
            with writer.transaction():
                writer.instances.drop(3, None)
            assert len(reader.instances.all()) == count
            assert 3 in {o.instance_id for o in reader.observations.all()}
        assert len(writer.instances.all()) == count - 1


def test_a_memory_whose_writer_was_killed_amid_a_commit_is_read(make_memory: Make, tmp_path: Path) -> None:
    memory = make_memory()
    left = tmp_path / "left.l3r"
    shutil.copy(memory, left)
    writer = sqlite3.connect(left, isolation_level=None)
    writer.execute("PRAGMA cache_size=1")
    writer.execute("BEGIN")
    writer.execute("UPDATE supports SET rgb = zeroblob(length(rgb))")
    writer.execute("UPDATE chunks SET crc = crc + 1")
    killed = tmp_path / "killed.l3r"
    for end in ("", "-journal"):
        shutil.copy(f"{left}{end}", f"{killed}{end}")
    writer.close()
    with Store.open(killed) as store, Store.open(memory) as before:
        assert store.verify() == [] and len(store.instances.all()) == len(before.instances.all())
