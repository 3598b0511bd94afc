"""The notebook of the tutorial runs from its first cell to its last."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from list3r.memory.store.store import Store
from tests.conftest import small_picture, write_small_room

NOTEBOOK = Path(__file__).resolve().parents[1] / "examples" / "tutorial.ipynb"


def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "demo").mkdir()
    with Store.create(tmp_path / "demo" / "rooms.l3r") as store, store.transaction():
        write_small_room(store, small_picture())
    monkeypatch.chdir(tmp_path)
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [], "outputs are not kept"
            exec("".join(cell["source"]), names)
    told = capsys.readouterr().out
    assert "(4, 2, 3)" in told and "scene.json" in told and "my thing" in told and "no instance has the word" in told
