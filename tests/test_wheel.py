"""The wheel: what is in it, and that it runs where the tree is not."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel built from the tree."""
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    plain = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}  # benchmarks/build.py is no package `build`
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, env=plain)
    assert result.returncode == 0, result.stderr
    return next(out.glob("*.whl"))


def test_only_list3r_is_in_it(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"list3r", "list3r-0.1.0.dist-info"}
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


def test_installed_elsewhere_it_runs_the_demo(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(site), str(wheel)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    assert {p.name for p in site.iterdir()} <= {"list3r", "list3r-0.1.0.dist-info", "bin"}
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
