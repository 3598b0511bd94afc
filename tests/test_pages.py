"""Sums of pages: whatever is written reads back as sound, and whatever is not as it was written is refused."""

from __future__ import annotations

import contextlib
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import apsw
import pytest

from list3r.exporters.scene_json import scene_dict
from list3r.memory.core.errors import MemoryFileError, MemoryFileWarning
from list3r.memory.library.maintenance import edits
from list3r.memory.store import database
from list3r.memory.store.file import PAGE_BYTES, connected, fold_in
from list3r.memory.store.pages import PageDamaged
from list3r.memory.store.store import Store

Make = Callable[..., Path]


def write_some(store: Store, rng: random.Random) -> None:
    """Write rows of all sizes, change and drop some."""
    for _ in range(30):
        n = rng.randrange(10_000, 10_400)
        value = rng.randbytes(rng.choice((10, 300, 5_000, 60_000))).hex()
        store.connection.execute("INSERT OR REPLACE INTO memory VALUES (?, ?)", (f"key {n}", value))
        store.ids.add_aliases({n: 2})
    store.connection.execute("DELETE FROM memory WHERE key LIKE ?", (f"key 10{rng.randrange(4)}%",))
    store.instances.set_labels({rng.randrange(1, 7): f"word{rng.randrange(50)}"})


@pytest.mark.parametrize("seed", range(3))
def test_what_is_written_and_taken_back_is_sound_to_all(
    seed: int, make_memory: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, path = random.Random(seed), make_memory()
    monkeypatch.setattr(database, "_LOG_PAGES", 40)
    with Store.open(path, writable=True) as writer, Store.open(path) as reader:
        writer.connection._database.execute(
            "PRAGMA cache_size=5"
        ).fetchall()  # pages leave the cache amid a transaction
        for k in range(25):
            with contextlib.suppress(ZeroDivisionError), writer.transaction():
                write_some(writer, rng)
                assert len(writer.ids.aliases()) > 0
                1 / (k % 5)
            if k % 4 == 0:
                assert reader.verify() == [] and reader.ids.aliases() == writer.ids.aliases()
    with Store.open(path) as again:
        assert again.verify() == []
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_sums_that_were_not_committed_are_forgotten(make_memory: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    path, rng = make_memory(), random.Random(1)
    run = database.Database.execute

    def full(self: database.Database, statement: str, *more: object) -> apsw.Cursor:
        if statement == "COMMIT":
            raise apsw.FullError("database or disk is full")
        return run(self, statement, *more)  # type: ignore[arg-type]

    def grow(store: Store, count: int) -> None:
        for n in range(count):
            key = f"{rng.random()} {n}"
            store.connection.execute("INSERT INTO memory VALUES (?, ?)", (key, rng.randbytes(400_000).hex()))

    with Store.open(path, writable=True) as store:
        for k in range(3):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(database.Database, "execute", full)
                with pytest.raises(MemoryFileError, match="full"), store.transaction():
                    grow(store, 12)
            with store.transaction():
                store.ids.add_aliases({n: 2 for n in range(1000 * (k + 1), 1000 * (k + 1) + 900)})
                grow(store, 8)
            with Store.open(path) as reader:
                assert reader.verify() == [] and len(reader.ids.aliases()) == 900 * (k + 1)
    with Store.open(path) as again:
        assert again.verify() == []


def test_a_reader_amid_a_snapshot_is_told_of_no_damage_by_what_is_written(
    make_memory: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, rng = make_memory(), random.Random(5)
    monkeypatch.setattr(database, "_LOG_PAGES", 1)
    with Store.open(path, writable=True) as writer, Store.open(path) as reader, reader.snapshot():
        before = scene_dict(reader)
        for _ in range(12):
            with writer.transaction():
                write_some(writer, rng)
        assert scene_dict(reader) == before
        with Store.open(path) as other:
            assert other.verify() == []


@pytest.mark.parametrize("kind", ["flipped", "zeroed", "swapped"])
def test_any_page_that_is_another_is_refused_or_of_no_use(kind: str, make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path) as store:
        wanted = scene_dict(store)
    data, refused = path.read_bytes(), 0
    for page in range(len(data) // PAGE_BYTES):
        changed, at = bytearray(data), page * PAGE_BYTES
        if kind == "flipped":
            changed[at + random.Random(page).randrange(PAGE_BYTES)] ^= 16
        else:
            other = (page + 7) % (len(data) // PAGE_BYTES) * PAGE_BYTES
            changed[at : at + PAGE_BYTES] = bytes(PAGE_BYTES) if kind == "zeroed" else data[other : other + PAGE_BYTES]
        path.write_bytes(changed)
        try:
            with Store.open(path) as store:
                assert scene_dict(store) == wanted
        except MemoryFileError:
            refused += 1
    assert refused > 3


def test_a_page_of_an_earlier_state_is_refused(make_memory: Make) -> None:
    path = make_memory()
    older = path.read_bytes()
    with Store.open(path, writable=True) as store:
        edits.label(store, 2, "plate")
    newer, refused = path.read_bytes(), set()
    with Store.open(path) as store:
        wanted = scene_dict(store)
    pages = [
        k
        for k in range(len(older) // PAGE_BYTES)
        if older[k * PAGE_BYTES :][:PAGE_BYTES] != newer[k * PAGE_BYTES :][:PAGE_BYTES]
    ]
    for page in pages:
        at = page * PAGE_BYTES
        path.write_bytes(newer[:at] + older[at : at + PAGE_BYTES] + newer[at + PAGE_BYTES :])
        with Store.open(path) as store:
            try:
                assert scene_dict(store) == wanted
            except MemoryFileError:
                refused.add(page)
            if page > 0:
                assert store.verify() != []
    assert len(refused) > 1


def test_sums_of_an_earlier_state_are_refused_with_what_they_are_of(make_memory: Make) -> None:
    path = make_memory()
    older = path.read_bytes()
    with Store.open(path, writable=True) as store:
        edits.label(store, 2, "plate")
    newer = path.read_bytes()
    with contextlib.closing(connected(path, "ro")) as read:
        query = "SELECT pageno FROM dbstat WHERE name IN ('pages', 'instances')"
        pages = [n - 1 for (n,) in read.execute(query).fetchall()]
    mixed = bytearray(newer)
    for page in pages:
        mixed[page * PAGE_BYTES : (page + 1) * PAGE_BYTES] = older[page * PAGE_BYTES : (page + 1) * PAGE_BYTES]
    path.write_bytes(mixed)
    with pytest.raises(MemoryFileError, match="first page"), Store.open(path) as store:
        store.instances.all()


def test_a_log_of_another_state_is_left_out(make_memory: Make, tmp_path: Path) -> None:
    path, other = make_memory(), tmp_path / "other.l3r"
    shutil.copy(path, other)
    with Store.open(path, writable=True) as store:
        edits.label(store, 2, "plate")
    with Store.open(other, writable=True) as store:
        edits.label(store, 2, "bowl")
        log = Path(f"{other}-wal").read_bytes()
    Path(f"{path}-wal").write_bytes(log)
    for writable in (False, True):
        with pytest.warns(MemoryFileWarning, match="the log of another file"), Store.open(path, writable=writable) as s:
            assert s.instances.get(2).label == "plate"


def test_a_file_that_sqlite_wrote_is_read_once_it_is_summed(make_memory: Make, tmp_path: Path) -> None:
    path, copy = make_memory(), tmp_path / "copy.l3r"
    with Store.open(path) as store:
        wanted = scene_dict(store)
    with contextlib.closing(connected(path, "ro")) as source:
        source.execute("VACUUM INTO ?", (str(copy),))
    with pytest.raises(MemoryFileError), Store.open(copy) as store:
        store.instances.all()
    with contextlib.closing(connected(copy, "rw")) as made:
        made.execute("PRAGMA journal_mode=WAL").fetchall()
        made.sum_again()
        fold_in(made, 0)
    with Store.open(copy) as store:
        assert store.verify() == [] and scene_dict(store) == wanted


def test_what_no_other_program_may_write_is_refused(make_memory: Make) -> None:
    path = make_memory()
    with contextlib.closing(apsw.Connection(str(path))) as foreign:
        foreign.execute("UPDATE instances SET label = 'cup' WHERE id = 3")
    with contextlib.closing(connected(path, "ro")) as read:
        read.begin()
        with pytest.raises(PageDamaged):
            read.execute("SELECT * FROM instances").fetchall()
