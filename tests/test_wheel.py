"""Wheel and sdist: what is in them, what they are called, and that they run where the tree is not."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import list3r
from list3r.memory.core.errors import DISTRIBUTION, EXTRA_OF_PACKAGE, install_hint
from list3r.simulation.dataset import WalkSettings, write_walk
from tests.test_edits import built

ROOT = Path(__file__).resolve().parents[1]
STEM = f"{DISTRIBUTION.replace('-', '_')}-{list3r.__version__}"
PLAIN = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
"""Without the tree: benchmarks/build.py is no package `build`."""


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the sdist, built from the tree, and of the wheel, built from the sdist."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, env=PLAIN)
    assert result.returncode == 0, result.stderr
    return out


@pytest.fixture(scope="module")
def wheel(distributions: Path) -> Path:
    return distributions / f"{STEM}-py3-none-any.whl"


def test_one_version_is_told_everywhere(distributions: Path) -> None:
    """The files' names hold that of pyproject.toml."""
    assert {p.name for p in distributions.iterdir()} == {f"{STEM}.tar.gz", f"{STEM}-py3-none-any.whl"}
    assert f"\nversion: {list3r.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_the_sdist_holds_what_the_wheel_is_made_of(distributions: Path) -> None:
    with tarfile.open(distributions / f"{STEM}.tar.gz") as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    files = [p for p in (ROOT / "list3r").rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    assert {"pyproject.toml", "README.md", "LICENSE", *(p.relative_to(ROOT).as_posix() for p in files)} <= names
    assert not [name for name in names if name.startswith(("memory", "queries", "exporters"))]


@pytest.mark.slow
def test_a_fresh_environment_asks_a_memory_and_names_what_it_lacks(wheel: Path, tmp_path: Path) -> None:
    python = tmp_path / "venv/bin/python"
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True, timeout=300)
    install = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check", str(wheel)]
    installed = subprocess.run(install, capture_output=True, text=True, check=False, timeout=900, env=PLAIN)
    if "No matching distribution found for numpy" in installed.stderr:
        pytest.skip("pip finds no numpy here: no package index can be reached")
    assert installed.returncode == 0, installed.stderr
    built(tmp_path / "m.l3r").close()

    def told(*words: str) -> subprocess.CompletedProcess[str]:
        command = [python.parent / "list3r", *words]
        return subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=120, env=PLAIN, cwd=tmp_path
        )

    assert told("--version").stdout == f"list3r {list3r.__version__}\n"
    assert json.loads(told("list", "m.l3r", "--json").stdout)["matches"]
    refused = told("export", "m.l3r", "--to", "glb", "--out", "m.glb")
    assert refused.returncode == 2 and refused.stderr.count("\n") == 1
    assert refused.stderr.endswith(f"pip install '{DISTRIBUTION}[export]'\n")

    subprocess.run([*install[:-1], f"{wheel}[build,export]"], check=True, capture_output=True, timeout=900, env=PLAIN)
    write_walk(tmp_path / "walk", WalkSettings(frames=30))
    lines = re.findall(r"```python\n(.+?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(lines) == 1
    ran = subprocess.run(
        [python, "-c", lines[0]], capture_output=True, text=True, check=False, timeout=900, env=PLAIN, cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("\n") >= 4 and (tmp_path / "house.glb").read_bytes()[:4] == b"glTF"


def test_a_checkout_is_installed_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert install_hint("models", "timm") == "pip install '.[models]' timm"
    monkeypatch.chdir(tmp_path)
    assert install_hint("export") == f"pip install '.[export]' in the folder {ROOT}"


def test_every_extra_that_is_named_is_there(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        facts = archive.read(f"{STEM}.dist-info/METADATA").decode()
    extras = set(re.findall(r"^Provides-Extra: (\S+)$", facts, re.MULTILINE))
    hints = [m for p in (ROOT / "list3r").rglob("*.py") for m in re.findall(r"install_hint\('(\w+)'\)", p.read_text())]
    assert len(hints) >= 5 and {*hints, *EXTRA_OF_PACKAGE.values()} <= extras
    assert "\nRequires-Dist: list3r" not in facts  # extras that are made of others are written out


def test_nothing_tells_to_install_the_package_of_somebody_else() -> None:
    folders = ("docs", "list3r", "tests", "examples", "scripts", "benchmarks", "training", ".github")
    paths = [p for folder in folders for p in (ROOT / folder).rglob("*")] + [p for p in ROOT.iterdir() if p.is_file()]
    told = re.compile(r"""pip install (-\S+ )*["']?list3r(?!-memory|\w)|(?<![\w-])list3r\[\w""")
    kinds = {".md", ".py", ".sh", ".toml", ".ipynb", ".yml", ".cff", ""}
    texts = [p for p in paths if p.suffix in kinds and p.is_file() and "__pycache__" not in p.parts]
    assert len(texts) > 300
    assert [str(p) for p in texts if told.search(p.read_text(encoding="utf-8"))] == []


def test_only_list3r_is_in_it(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"list3r", f"{STEM}.dist-info"}
    assert {"list3r/exporters/scene.schema.json", "list3r/py.typed"} <= set(names)
    assert not [name for name in names if "test" in name]


def lend_machine_code(site: Path) -> None:
    """Give an installed copy what numba has compiled of the same text in the tree, which takes half a minute anew."""
    for source in (ROOT / "list3r").rglob("*.py"):
        copy = site / source.relative_to(ROOT)
        compiled = [*(source.parent / "__pycache__").glob(f"{source.stem}.*.nb[ci]")]
        if compiled and copy.exists() and copy.read_bytes() == source.read_bytes():
            os.utime(copy, ns=(source.stat().st_atime_ns, source.stat().st_mtime_ns))
            (copy.parent / "__pycache__").mkdir(exist_ok=True)
            for file in compiled:
                shutil.copy(file, copy.parent / "__pycache__")


@pytest.mark.slow
def test_installed_elsewhere_it_runs_the_demo(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(site), str(wheel)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    assert {p.name for p in site.iterdir()} <= {"list3r", f"{STEM}.dist-info", "bin"}
    lend_machine_code(site)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-m", "list3r", "demo", "--out", str(tmp_path / "demo")]
    command += ["--frames", "8", "--workers", "1", "--json"]
    result = subprocess.run(
        command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False, timeout=300
    )
    assert result.returncode == 0, result.stderr
    (report,) = json.loads(result.stdout)["matches"]
    assert report["build"]["posed"] == 8
    assert all(Path(path).stat().st_size > 0 for path in report["exports"].values())
