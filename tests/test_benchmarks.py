"""The benchmarks are measured by hand; here only that every one starts and says how it is used."""

from __future__ import annotations

import importlib.util
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


def test_processes_of_a_benchmark_end_with_it(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys, time\nsys.path[:0] = [{str(FOLDER)!r}, {str(FOLDER.parent)!r}]\n"
        "from concurrent.futures import ProcessPoolExecutor\nimport multiprocessing, os\n"
        "from machine import end_with_parent\n"
        "if __name__ == '__main__':\n"
        "    spawn = multiprocessing.get_context('spawn')\n"
        "    with ProcessPoolExecutor(1, mp_context=spawn, initializer=end_with_parent) as pool:\n"
        "        print(pool.submit(os.getpid).result(), flush=True)\n"
        "        pool.submit(time.sleep, 60).result()\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    process.terminate()
    process.communicate(timeout=60)
    assert until(lambda: not alive(worker))


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel tells it there alone")
def test_the_program_that_a_benchmark_runs_ends_with_it(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys\nsys.path[:0] = [{str(FOLDER)!r}, {str(FOLDER.parent)!r}]\n"
        "import machine\nmachine._watch = lambda process: print(process.pid, flush=True) or process.wait()\n"
        f"machine.run_list3r('demo', '--out', {str(tmp_path / 'demo')!r})\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    program = int(process.stdout.readline())
    process.kill()
    process.communicate(timeout=60)
    assert until(lambda: not alive(program))
