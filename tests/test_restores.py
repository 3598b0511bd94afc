"""A file that takes the name of a memory whose writer was killed is what is opened; no log but its own is applied."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from list3r.catalog.reading import read_content
from list3r.memory.core.errors import MemoryFileError, MemoryFileWarning
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
from tests.conftest import write_small_room
from tests.program import in_process as run

Make = Callable[..., Path]

WRITER = """
import os, sys
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
store = Store.open(sys.argv[1], writable=True)
for label in sys.argv[3:]:
    edits.label(store, 2, label)
if int(sys.argv[2]):
    store.connection._database.execute("PRAGMA wal_checkpoint").fetchall()
os.kill(os.getpid(), 9)
"""


def edit_and_be_killed(path: Path, *labels: str, checkpoint: bool = False) -> None:
    command = [sys.executable, "-c", WRITER, str(path), str(int(checkpoint)), *labels]
    assert subprocess.run(command, check=False).returncode == -9
    assert log_of(path).stat().st_size > 0


def log_of(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def labelled(path: Path) -> str | None:
    with Store.open(path) as store:
        assert store.verify() == []
        return store.instances.get(2).label


def test_random_restores_are_opened_as_what_was_put_there(make_memory: Make, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    from benchmarks.restores import LEFT, PUT_THERE, restores

    kinds = len(PUT_THERE) + len(LEFT)
    assert restores(make_memory(), make_memory("other.l3r"), tmp_path, kinds)["problems"] == []


def test_a_restored_backup_is_shown_and_edited_without_the_log_of_a_killed_writer(
    make_memory: Make, tmp_path: Path
) -> None:
    path, backup = make_memory(), tmp_path / "backup.l3r"
    with Store.open(path, writable=True) as store:
        edits.label(store, 2, "saved")
    shutil.copy(path, backup)
    edit_and_be_killed(path, "later", "last")
    log, saved = log_of(path).read_bytes(), backup.read_bytes()
    backup.rename(path)

    for command in ("info", "list", "verify"):
        shown = run(command, path)
        assert shown.returncode == 0 and "is the log of another file" in shown.stderr, shown
        assert shown.stderr.count("\n") == 1
    assert path.read_bytes() == saved and log_of(path).read_bytes() == log
    with pytest.warns(MemoryFileWarning, match="the log of another file"):
        assert read_content(str(path)).instances[1].label == "saved"

    changed = run("edit", "label", path, "3", "new")
    assert changed.returncode == 0 and f"{path.name}-wal.foreign-1" in changed.stderr
    assert Path(f"{path}-wal.foreign-1").read_bytes() == log
    assert labelled(path) == "saved"
    with Store.open(path) as store:
        assert [e.entry for e in store.edits.all()] == [1, 2]
    assert run("info", path).stderr == ""


def test_repair_puts_the_log_of_another_file_aside(make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    shutil.copy(path, tmp_path / "backup.l3r")
    edit_and_be_killed(path, "later")
    shutil.copy(tmp_path / "backup.l3r", path)
    Path(f"{path}-wal.foreign-1").write_text("mine")
    result = run("repair", path)
    assert result.returncode == 0 and "nothing was changed" in result.stdout and "foreign-2" in result.stderr
    assert not log_of(path).exists() and Path(f"{path}-wal.foreign-1").read_text() == "mine"
    assert labelled(path) is None


def test_a_killed_writer_is_followed_by_its_log_wherever_both_files_go(make_memory: Make, tmp_path: Path) -> None:
    path, there = make_memory(), tmp_path / "there" / "other name.l3r"
    edit_and_be_killed(path, "first", "last")
    there.parent.mkdir()
    for file, to in ((path, there), (log_of(path), log_of(there))):
        shutil.copy(file, to)
    for file in (path, there):
        assert labelled(file) == "last"
        with Store.open(file, writable=True) as store:
            edits.label(store, 3, "next")
        assert labelled(file) == "last" and not log_of(file).exists()


def test_a_checkpoint_that_was_killed_is_done_again(make_memory: Make) -> None:
    path = make_memory()
    size = path.stat().st_size
    edit_and_be_killed(path, *(f"{k:0200}" for k in range(80)), checkpoint=True)
    assert path.stat().st_size > size
    os.truncate(path, size)  # the head of the file tells of pages that only the log has
    assert labelled(path) == f"{79:0200}"
    assert run("edit", "label", path, "2", "last").returncode == 0
    assert labelled(path) == "last"


def test_a_copy_made_while_it_was_written_gets_no_log_that_was_begun_later(make_memory: Make, tmp_path: Path) -> None:
    path, copy = make_memory(), tmp_path / "copy.l3r"
    writer = Store.open(path, writable=True)
    shutil.copy(path, copy)
    for label in ("one", "two"):
        edits.label(writer, 2, label)
        writer.connection._database.execute("PRAGMA wal_checkpoint").fetchall()
    edits.label(writer, 3, "three")
    shutil.copy(log_of(path), log_of(copy))
    with pytest.warns(MemoryFileWarning, match="the log of another file"):
        assert labelled(copy) is None
    shutil.copy(path, copy)
    assert labelled(copy) == "two"
    writer.close()


def test_a_copy_by_vacuum_is_another_file_and_of_another_program(make_memory: Make, tmp_path: Path) -> None:
    path, copy = make_memory(), tmp_path / "copy.l3r"
    with Store.open(path, writable=True) as writer:
        edits.label(writer, 2, "one")
        with sqlite3.connect(path) as database:
            database.execute("VACUUM INTO ?", (str(copy),))
        edits.label(writer, 2, "two")
        shutil.copy(log_of(path), log_of(copy))
    before = copy.read_bytes(), log_of(copy).read_bytes()
    with pytest.warns(MemoryFileWarning, match="the log of another file"), Store.open(copy) as store:
        assert store.verify(), "its pages have no sums"
    assert (copy.read_bytes(), log_of(copy).read_bytes()) == before


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_half_a_copy_is_refused_and_left(share: float, tmp_path: Path) -> None:
    path = tmp_path / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store, points=20_000)
    edit_and_be_killed(path, "one", "two")
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    before = {p.name: p.read_bytes() for p in path.parent.iterdir() if not p.name.endswith("-writer")}
    for writable in (False, True):
        with pytest.raises(MemoryFileError, match="is cut off" if share > 0.9 else "malformed"):
            Store.open(path, writable=writable)
    assert {p.name: p.read_bytes() for p in path.parent.iterdir() if not p.name.endswith("-writer")} == before


def test_a_file_that_cannot_be_opened_keeps_what_lies_beside_it(make_memory: Make) -> None:
    path = make_memory()
    data = path.read_bytes()
    edit_and_be_killed(path, "later")
    path.write_bytes(data[: len(data) // 2])
    before = {p.name: p.read_bytes() for p in path.parent.iterdir() if not p.name.endswith("-writer")}
    assert run("edit", "label", path, "2", "x").returncode == 2
    assert {p.name: p.read_bytes() for p in path.parent.iterdir() if not p.name.endswith("-writer")} == before


def test_a_new_memory_does_not_take_up_the_log_of_one_that_was_moved_away(make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    edit_and_be_killed(path, "later")
    path.rename(tmp_path / "moved.l3r")
    with pytest.warns(MemoryFileWarning, match="foreign-1"), Store.create(path) as store:
        assert store.instances.all() == []
    with Store.open(path) as store:
        assert store.verify() == [] and store.instances.all() == []
