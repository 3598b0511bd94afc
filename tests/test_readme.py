"""README.md: its tables show the committed results. The threat model: the tests it names are there."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "readme_tables.py"


def test_tables_show_the_committed_results() -> None:
    said = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr


def test_a_figure_that_differs_is_found(tmp_path: Path) -> None:
    (tmp_path / "benchmarks/results").mkdir(parents=True)
    shutil.copytree(SCRIPT.parent, tmp_path / "scripts")
    for path in (SCRIPT.parents[1] / "benchmarks/results").glob("*.json"):
        (tmp_path / "benchmarks/results" / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    for page in ("README.md", "docs/measured.md", "docs/prompt.md", "docs/commands.md", "docs/usd.md"):
        (tmp_path / page).parent.mkdir(exist_ok=True)
        text = (SCRIPT.parents[1] / page).read_text(encoding="utf-8")
        (tmp_path / page).write_text(text.replace("| 1,000 | 1,000 |", "| 1,000 | 1,001 |", 1), encoding="utf-8")
    said = subprocess.run([sys.executable, str(tmp_path / "scripts/readme_tables.py"), "--check"], capture_output=True)
    assert said.returncode == 1 and b"docs/measured.md" in said.stderr


def test_every_promise_of_the_threat_model_names_tests_that_are_there() -> None:
    page = (SCRIPT.parents[1] / "docs/threat-model.md").read_text(encoding="utf-8")
    promises = [line for line in page.splitlines() if line.startswith("| ") and line != "| promise | test |"]
    assert len(promises) > 25
    for line in promises:
        named = re.findall(r"`(test_\w+\.py)?::(test_\w+)`", line.rpartition(" | ")[2])
        assert named and named[0][0], line
        source = ""
        for name, test in named:
            source = (Path(__file__).parent / name).read_text(encoding="utf-8") if name else source
            assert re.search(rf"^def {test}\(", source, re.MULTILINE), (name, test)
