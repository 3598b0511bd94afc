"""A process that is killed while it edits leaves a sound file in which every edit that it told of is kept."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.library.consolidation import consolidate
from list3r.memory.store.store import Store
from tests.test_consolidation import content
from tests.test_edits import built

EDITOR = """
import sys
from list3r.memory.library.maintenance import edits
from list3r.memory.core.constraints import standing
from list3r.memory.store.store import Store

store = Store.open(sys.argv[1], writable=True)
while any(e.kind != "undo" for e in standing(store.edits.all())):
    edits.undo(store)
while True:
    for verb in (
        lambda: edits.label(store, 1, "one"),
        lambda: edits.merge(store, 2, 3),
        lambda: edits.split(store, 4),
        lambda: edits.delete(store, 1),
        lambda: edits.undo(store),
        lambda: edits.undo(store),
        lambda: edits.undo(store),
        lambda: edits.undo(store),
    ):
        print(verb().entry, flush=True)
"""


@pytest.mark.slow
def test_kill_9_during_edits_loses_nothing_that_was_committed(tmp_path: Path) -> None:
    path = tmp_path / "a.l3r"
    built(path, chunks=2).close()
    rng = np.random.default_rng(7)
    for _ in range(3):
        with subprocess.Popen([sys.executable, "-c", EDITOR, str(path)], stdout=subprocess.PIPE, text=True) as editor:
            assert editor.stdout is not None
            told = [int(editor.stdout.readline()) for _ in range(int(rng.integers(2, 9)))]
            time.sleep(float(rng.uniform(0.0, 0.1)))
            editor.kill()
            told += [int(line) for line in editor.stdout if line.endswith("\n")]
        with Store.open(path) as store:
            assert store.verify() == []
            assert set(told) <= {e.entry for e in store.edits.all()}
        with Store.open(path, writable=True) as store:
            before = content(store)
            with store.transaction():
                consolidate(store)
            assert content(store) == before, "what was derived is what the edits come to"
