"""The benchmarks are measured by hand; here only that every one starts and says how it is used."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
PROGRAMS = sorted(p.stem for p in FOLDER.glob("*.py") if "def main(" in p.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", PROGRAMS)
def test_it_says_how_it_is_used(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    if name == "pose_graph":
        pytest.importorskip("gtsam")
    monkeypatch.syspath_prepend(FOLDER)
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        module.main()
    assert ended.value.code == 0
    said = capsys.readouterr().out
    first = (module.__doc__ or "").splitlines()[0]
    assert first[:40] in said.replace("\n", " ") and f"{name}.py" in (module.__doc__ or "")


def test_there_are_benchmarks() -> None:
    assert {"safety", "scale", "association", "pose_graph"} <= set(PROGRAMS)
