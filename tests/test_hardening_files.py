"""What lies beside a memory, what an edit writes over, what a refused command leaves: nothing of a user's is lost."""

from __future__ import annotations

import os
import resource
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest

from list3r.cli.app import run
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.library.maintenance import edits
from list3r.memory.store.file import check_beside
from list3r.memory.store.lock import WriterLock, lock_path
from list3r.memory.store.store import Store
from tests.program import as_user

Make = Callable[..., Path]
PRECIOUS = b"my own words, 92 bytes of which an earlier program left; they stay\n" * 40


def spoil(path: Path, *statements: str) -> None:
    """Change rows behind the back of the program."""
    with sqlite3.connect(path) as database:
        for statement in statements:
            assert database.execute(statement).rowcount > 0


def put(kind: str, place: Path, precious: Path) -> None:
    """Lay something in the way of a lock or a journal."""
    if kind == "a symbolic link":
        place.symlink_to(precious)
    elif kind == "a hard link":
        os.link(precious, place)
    elif kind == "a file":
        place.write_bytes(PRECIOUS)
    elif kind == "a pipe":
        os.mkfifo(place)
    else:
        place.mkdir()


@pytest.mark.parametrize("kind", ["a symbolic link", "a hard link", "a file", "a pipe", "a folder"])
@pytest.mark.parametrize("end", ["-writer", "-wal", "-journal", "-shm"])
def test_what_is_in_the_way_of_a_writer_is_neither_followed_nor_written(
    kind: str, end: str, make_memory: Make, tmp_path: Path
) -> None:
    memory, precious = make_memory(), tmp_path / "precious.txt"
    precious.write_bytes(PRECIOUS)
    place = memory.with_name(memory.name + end)
    put(kind, place, precious)
    if (kind, end) != ("a file", "-shm"):  # what readers share holds nothing, and any file is as good
        with pytest.raises(MemoryFileError, match="move it away"):
            Store.open(memory, writable=True)
        assert not place.is_file() or place.read_bytes() == PRECIOUS
    assert precious.read_bytes() == PRECIOUS and os.path.lexists(place)


def test_a_log_that_a_writer_empties_while_it_is_looked_at_is_in_nobodys_way(
    make_memory: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = make_memory()
    log = memory.with_name(memory.name + "-wal")
    log.write_bytes(b"\x37\x7f\x06\x82" + bytes(28))
    opened = Path.open

    def emptied(self: Path, *words: object, **named: object) -> object:
        if self == log:
            os.truncate(log, 0)
        return opened(self, *words, **named)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", emptied)
    check_beside(memory)


def test_an_empty_file_of_the_name_of_the_lock_is_left(make_memory: Make) -> None:
    memory = make_memory()
    lock_path(memory).touch()
    with Store.open(memory, writable=True), pytest.raises(MemoryFileError, match="this process already"):
        Store.open(memory, writable=True)
    assert lock_path(memory).read_bytes() == b""


def test_a_lock_that_was_left_behind_is_taken_over(make_memory: Make, tmp_path: Path) -> None:
    memory = make_memory()
    lock = WriterLock(memory)
    left = lock_path(memory).read_bytes()
    lock.release()
    lock_path(memory).write_bytes(left)
    Store.open(memory, writable=True).close()
    assert [p.name for p in tmp_path.iterdir()] == [memory.name]


@pytest.mark.slow
@pytest.mark.parametrize("most_bytes", [0, 50, 8192])
def test_an_edit_on_a_full_disk_names_the_file_and_leaves_nothing(most_bytes: int, make_memory: Make) -> None:
    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    memory = make_memory()
    before = memory.read_bytes()
    result = as_user("edit", "label", memory, "2", "mug", before=small_files)
    assert result.returncode == 2 and result.stderr.count("\n") == 1, result.stderr
    assert str(memory) in result.stderr and "free some space" in result.stderr
    assert [p.name for p in memory.parent.iterdir()] == [memory.name] and memory.read_bytes() == before
    assert run(["edit", "label", str(memory), "2", "mug"]) == 0


def test_a_new_memory_takes_no_name_but_its_own(tmp_path: Path) -> None:
    own = tmp_path / "m.l3r-new"
    own.write_bytes(PRECIOUS)
    Store.create(tmp_path / "m.l3r").close()
    assert own.read_bytes() == PRECIOUS
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.l3r", "m.l3r-new"]


@pytest.mark.parametrize("logged", [False, True])
def test_reading_changes_nothing_in_the_folder(logged: bool, make_memory: Make, tmp_path: Path) -> None:
    folder = tmp_path / "unpacked"
    folder.mkdir()
    shutil.copy(make_memory(), folder / "m.l3r")
    if logged:
        database = sqlite3.connect(folder / "m.l3r")
        database.execute("PRAGMA journal_mode=WAL")
        database.close()
    (folder / "precious.txt").write_bytes(PRECIOUS)
    (folder / "m.l3r-writer").symlink_to("precious.txt")
    before = {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}
    for command in (["info"], ["list"], ["verify"], ["show", "--json"]):
        assert run([command[0], str(folder / "m.l3r"), *(["2"] if command[0] == "show" else [])]) == 0
    assert {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()} == before


# ------------------------------------------------------------------------------------------- edits of damaged files

DAMAGES = {
    "a row beside it": "UPDATE instances SET confidence = 0.123 WHERE id = 3",
    "its place": "UPDATE instances SET geometry = zeroblob(144) WHERE id = 3",
    "a reason": "UPDATE merges SET reason = 'so'",
    "a place of a chunk": "UPDATE placements SET S_world_chunk = zeroblob(104)",
    "a surface": "UPDATE supports SET points = zeroblob(length(points)) WHERE local_id = 4",
    "a camera": "UPDATE frames SET T_chunk_cam = zeroblob(128) WHERE frame_index = 7",
    "a value": "UPDATE memory SET value = '\"known\"' WHERE key = 'gravity'",
    "sums": "UPDATE pages SET sums = zeroblob(4100) WHERE first = 0",
    "a lost row": "DELETE FROM instances WHERE id = 6",
}
EDITS = {
    "label": lambda store: edits.label(store, 2, "mug"),
    "merge": lambda store: edits.merge(store, 2, 4),
    "delete": lambda store: edits.delete(store, 4),
}


@pytest.mark.slow
@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_no_edit_makes_a_damaged_memory_verify_as_sound(damage: str, edit: str, make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store:
        edits.label(store, 5, "old label")
    spoil(path, DAMAGES[damage])
    refused = False
    try:
        with Store.open(path, writable=True) as store:
            EDITS[edit](store)
    except MemoryFileError as error:
        refused = "repair" in str(error)
    with Store.open(path) as store:
        assert store.verify() != []
        if refused:
            assert len(store.connection._database.execute("SELECT * FROM edits").fetchall()) == 1


@pytest.mark.parametrize("damage", ["a place of a chunk", "a surface"])
@pytest.mark.parametrize("edit", ["merge", "delete"])
def test_an_edit_rests_on_sound_rows_only(damage: str, edit: str, make_memory: Make) -> None:
    path = make_memory()
    spoil(path, DAMAGES[damage])
    with Store.open(path, writable=True) as store, pytest.raises(MemoryFileError, match="repair"):
        EDITS[edit](store)


# ------------------------------------------------------------------------------------------- replacing and the log


def test_a_refused_build_leaves_a_memory_named_replaced(make_memory: Make, tmp_path: Path) -> None:
    from tests.test_cli_errors import write_frames

    memory, walk = make_memory(), write_frames(tmp_path / "walk", count=2)
    own = memory.with_name(f"{memory.name}.replaced")
    shutil.copy(memory, own)
    before = own.read_bytes()
    for more in ([], ["--force"]):
        assert run(["build", str(walk), "-m", str(memory), "--poses", "given", *more]) == 2
        assert own.read_bytes() == before and memory.read_bytes() == before


def test_what_a_reader_kept_in_the_log_is_told_and_folded_in(
    make_memory: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("list3r.memory.store.connection._LAST_WAIT_MS", 10)
    path, copy = make_memory(), tmp_path / "copy" / "room.l3r"
    writer = Store.open(path, writable=True)
    with Store.open(path) as reader, reader.snapshot():
        reader.instances.all()
        edits.label(writer, 2, "mug")
        writer.close()
    copy.parent.mkdir()
    shutil.copy(path, copy)
    for command, memory, message in (("verify", path, "-wal"), ("info", path, "-wal"), ("verify", copy, "missing")):
        assert run([command, str(memory)]) == 0
        assert message in capsys.readouterr().out
    assert run(["repair", str(path)]) == 0
    assert not Path(f"{path}-wal").exists()
    with Store.open(path) as store:
        assert store.instances.get(2).label == "mug" and store.beside() is None
