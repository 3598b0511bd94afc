"""The ladder of examples runs, each as a user would start it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run(name: str, *arguments: Path) -> str:
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd=arguments[-1].parent)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the first example builds."""
    root = tmp_path_factory.mktemp("examples")
    assert "gravity" in run("01_build.py", root / "walk", root / "rooms.l3r")
    return root / "rooms.l3r"


@pytest.mark.slow
def test_asking(memory: Path) -> None:
    assert "surface to surface" in run("02_ask.py", memory)


def test_graph(memory: Path) -> None:
    assert "relations" in run("03_graph.py", memory)


@pytest.mark.slow
def test_export(memory: Path) -> None:
    written = run("04_export.py", memory, memory.parent / "exports")
    assert all(Path(line).stat().st_size > 0 for line in written.split())


@pytest.mark.slow
def test_own_frames(tmp_path: Path) -> None:
    assert "things" in run("05_own_frames.py", tmp_path / "own")


def test_every_example_is_run() -> None:
    tested = Path(__file__).read_text(encoding="utf-8")
    assert all(path.name in tested for path in (ROOT / "examples").glob("*.py"))
