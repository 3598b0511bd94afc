"""The house: folders at the root are links to the package, and no module imports itself by others."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from scripts import house

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("room", ["memory", "queries", "exporters"])
def test_a_room_has_one_name(room: str) -> None:
    """Imported by the link it would be a second copy, of whose classes no object of ours is an instance."""
    asked = subprocess.run([sys.executable, "-c", f"import {room}"], cwd=ROOT, capture_output=True, text=True)
    assert asked.returncode == 1 and f"ImportError: import list3r.{room}" in asked.stderr
    assert (ROOT / room).resolve() == ROOT / "list3r" / room


def test_no_imports_run_in_circles() -> None:
    package = ROOT / house.PACKAGE
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in package.rglob("*.py")}
    assert house._circles(house._imports(trees, package)) == []


def test_circles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}
    assert house._circles(graph) == [["a", "b", "c"]]
