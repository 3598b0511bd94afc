"""Handles that are dropped, forked, closed or kept waiting."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import list3r
from list3r.memory.core.errors import MemoryFileError
from list3r.memory.library.maintenance import edits
from list3r.memory.store.lock import lock_path
from list3r.memory.store.store import Store
from tests.test_safety import program

Make = Callable[..., Path]


def test_a_writer_that_is_dropped_lets_go(make_memory: Make, tmp_path: Path) -> None:
    path = make_memory()
    store: Store | None = Store.open(path, writable=True)
    assert store is not None and lock_path(path).exists()
    del store
    gc.collect()
    Store.open(path, writable=True).close()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_forked_child_neither_uses_nor_ends_what_it_inherits(make_memory: Make) -> None:
    path = make_memory()
    with Store.open(path, writable=True) as store:
        edits.label(store, 2, "mug")
        child = os.fork()
        if child == 0:
            refused = 0
            for use in (lambda: store.instances.all(), lambda: edits.label(store, 3, "plate")):
                try:
                    use()
                except MemoryFileError:
                    refused += 1
            store.close()
            os._exit(refused)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 2
        with pytest.raises(MemoryFileError, match="this process already"):
            Store.open(path, writable=True)
        edits.label(store, 4, "cup")
    with Store.open(path) as store:
        assert (store.instances.get(2).label, store.instances.get(4).label, store.verify()) == ("mug", "cup", [])


def test_what_is_closed_says_so(make_memory: Make) -> None:
    for writable in (False, True):
        with list3r.open(make_memory(f"{writable}.l3r"), writable=writable) as scene:
            store = scene.store
        store.close()
        for use in (
            scene.instances,
            store.verify,
            lambda: scene.label(2, "mug"),
            store.sessions.all,
            scene.store.ids.next,
        ):
            with pytest.raises(MemoryFileError, match=r"closed|for reading"):
                use()


def test_a_reader_that_is_stopped_is_named(make_memory: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("list3r.memory.store.file._READERS_WAIT_S", 0.2)
    path = make_memory()
    text = f"from list3r.memory.store.store import Store; store = Store.open({str(path)!r})"
    reader = program(text + "; held = store.snapshot(); held.__enter__(); store.instances.all()")
    os.kill(reader.pid, signal.SIGSTOP)
    with pytest.raises(MemoryFileError, match=rf"being read by process {reader.pid} \(is it stopped"):
        Store.open(path, writable=True)
    assert not lock_path(path).exists()
    os.kill(reader.pid, signal.SIGCONT)
    reader.communicate("\n", timeout=60)
    Store.open(path, writable=True).close()
