"""A memory is read where nothing is installed but the program's own needs, and where the system has no file locks.

Runs without the other tests' helpers: `python -m pytest --noconftest tests/test_reading.py`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.geometry import OrientedBox
from list3r.memory.core.records import Instance, Relation
from list3r.memory.store.store import Store


def run(memory: Path, *words: str, before: str = "") -> subprocess.CompletedProcess[str]:
    arguments = [word.format(memory) for word in words]
    program = f"import sys; {before}\nfrom list3r.cli.app import run; sys.exit(run({arguments!r}))"
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, encoding="utf-8"
    )


@pytest.fixture
def memory(tmp_path: Path) -> Path:
    box = OrientedBox(np.zeros(3), np.ones(3), np.eye(3))
    with Store.create(tmp_path / "m.l3r") as store, store.transaction():
        store.facts.scale_kind, store.facts.gravity = "metric", "known"
        store.instances.put(
            Instance(
                n, label, f"small red box, {n} cm", box.center, np.array([[-0.5] * 3, [0.5] * 3]), box, 0.9, 3,
                0.0, 1.0, "present", None, (200, 30, 30), "red", 1, None,
            )
            for n, label in ((1, "mug"), (2, "table"))
        )  # fmt: skip
        store.relations.replace(None, [Relation(1, "on", 2, 0.9, 0.1)])
    return tmp_path / "m.l3r"


QUESTIONS = [
    ("info", "{}"),
    ("list", "{}"),
    ("nearest", "{}", "--point", "0,0,1"),
    ("relations", "{}"),
    ("verify", "{}"),
]


@pytest.mark.slow
@pytest.mark.parametrize("words", QUESTIONS)
def test_a_question_is_answered_without_file_locks(words: tuple[str, ...], memory: Path) -> None:
    said = run(memory, *words, "--json", before="sys.modules['fcntl'] = None")
    assert said.returncode == 0 and said.stderr == "", said.stderr
    assert json.loads(said.stdout)["schema"] == "list3r/answer/1"


def test_without_file_locks_nothing_is_written(memory: Path) -> None:
    before = memory.read_bytes()
    said = run(memory, "edit", "label", "{}", "1", "mug", before="sys.modules['fcntl'] = None")
    assert said.returncode == 2 and "can only be read on this system" in said.stderr and said.stderr.count("\n") == 1
    assert memory.read_bytes() == before and [p.name for p in memory.parent.iterdir()] == ["m.l3r"]


def test_a_file_is_exported(memory: Path, tmp_path: Path) -> None:
    said = run(memory, "export", "{}", "--to", "json", "--out", str(tmp_path / "s.json"))
    assert said.returncode == 0, said.stderr
    assert json.loads((tmp_path / "s.json").read_text(encoding="utf-8"))["format"] == "list3r-scene-graph"
