"""The documentation site: its links lead somewhere, and continuous integration builds it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MADE = {"tutorial.md", "reference/cli.md"}
"""Pages that `scripts/reference_pages.py` writes."""


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as mkdocs makes them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = [re.sub(r"\[([^]]*)\]\([^)]*\)|[`*]", r"\1", title) for title in titles]
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in plain}


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda p: p.stem)
def test_every_link_leads_to_a_page_of_the_site(page: Path) -> None:
    text = re.sub(r"^(    .*|```.*?^```)$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"`[^`\n]*`", "", text)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        if re.match(r"\w+:", link):
            continue
        there = Path(os.path.normpath(page.parent / path)) if path else page
        inside = there.relative_to(ROOT / "docs").as_posix()  # fails for a file that the site does not hold
        assert there.is_file() or inside in MADE, link
        assert not anchor or inside in MADE or anchor in anchors(there), link


def test_continuous_integration_builds_the_site() -> None:
    """Both ways in run the script, which makes its own environment."""
    script = (ROOT / "scripts/docs.sh").read_text(encoding="utf-8")
    assert "make_environment docs\n" in script and "mkdocs build --strict\n" in script
    assert '/docs.sh"\n' in (ROOT / ".ci/run").read_text(encoding="utf-8")
    assert "- run: scripts/docs.sh\n" in (ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8")


@pytest.mark.skipif(find_spec("mkdocs") is None, reason="mkdocs is not installed: pip install '.[docs]'")
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    for name in ("docs", "list3r", "examples", "scripts"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    shutil.copytree(tmp_path / "docs", tmp_path / "out/docs")
    for command in (["scripts/reference_pages.py", "out/docs"], ["-m", "mkdocs", "build", "--strict"]):
        said = subprocess.run([sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert said.returncode == 0, said.stderr
