"""README.md: its tables show the committed results."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "readme_tables.py"


def test_tables_show_the_committed_results() -> None:
    said = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr


def test_a_figure_that_differs_is_found(tmp_path: Path) -> None:
    for folder in ("scripts", "benchmarks/results"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "scripts/readme_tables.py").write_text(SCRIPT.read_text(encoding="utf-8"), encoding="utf-8")
    for path in (SCRIPT.parents[1] / "benchmarks/results").glob("*.json"):
        (tmp_path / "benchmarks/results" / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    readme = (SCRIPT.parents[1] / "README.md").read_text(encoding="utf-8")
    (tmp_path / "README.md").write_text(readme.replace("| 1.5 |", "| 0.1 |", 1), encoding="utf-8")
    said = subprocess.run([sys.executable, str(tmp_path / "scripts/readme_tables.py"), "--check"], capture_output=True)
    assert said.returncode == 1
