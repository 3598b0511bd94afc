"""The benchmarks are measured by hand; here only that every one starts and says how it is used."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_workers import alive, until

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


WORKER = """
from concurrent.futures import ProcessPoolExecutor
import multiprocessing, os, time
from machine import end_with_parent
if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=end_with_parent) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 60).result()
"""
PROGRAM = """
import machine
machine._watch = lambda process: print(process.pid, flush=True) or process.wait()
machine.run_list3r("demo", "--out", sys.argv[1])
"""


@pytest.mark.parametrize(
    "text",
    [
        WORKER,
        pytest.param(PROGRAM, marks=pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's prctl")),
    ],
    ids=["worker", "program"],
)
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_what_a_benchmark_starts_ends_with_it(text: str, how: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(f"import sys\nsys.path[:0] = [{str(FOLDER)!r}, {str(FOLDER.parent)!r}]\n{text}")
    process = subprocess.Popen([sys.executable, str(script), str(tmp_path / "demo")], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    started = int(process.stdout.readline())
    process.send_signal(how)
    process.communicate(timeout=60)
    assert until(lambda: not alive(started))
