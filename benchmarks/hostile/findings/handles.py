"""Findings 15 and 16: handles in Python, limits of memory, and processes that live too long or not long enough."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from machine import descendants

from hostile.findings.place import Place, first

_AT_WORK_S = 4.0
"""A process that took so long has done more than start."""
_ENOUGH = 600 * 2**20
"""Address space in which the program starts, and no more."""


def dropped_writer(place: Place) -> str:
    opened, memory = importlib.import_module("list3r").open, place.memory()
    scene = opened(memory, writable=True)
    scene.instances()
    del scene
    gc.collect()
    try:
        opened(memory, writable=True).close()
    except Exception as error:
        return str(error).replace(str(place.folder), "")[:100]
    return ""


def forked_child(place: Place) -> str:
    memory = place.memory()
    scene = importlib.import_module("list3r").open(memory, writable=True)
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            scene.close()
        os._exit(0)
    os.waitpid(child, 0)
    other = place.shell("list3r label m.l3r 3 theirs")
    with contextlib.suppress(Exception):
        scene.close()
    return "another process writes during the parent's write" if other.status == 0 else other.bad


def after_close(place: Place) -> str:
    scene = importlib.import_module("list3r").open(place.memory(), writable=True)
    scene.instances()
    scene.close()
    for use in (scene.instances, lambda: scene.support(2), lambda: scene.relations(3), lambda: scene.store.verify()):
        try:
            use()
        except Exception as error:
            if "repair" in str(error) or "sqlite3" in type(error).__module__:
                return f"{type(error).__name__}: {error}".replace(str(place.folder), "")[:100]
    return ""


def _limited(*words: str) -> Callable[[Place], str]:
    def look(place: Place) -> str:
        place.memory(), place.walk(frames=12, size=(160, 120))
        line = f"ulimit -v {_ENOUGH // 1024}; OPENBLAS_NUM_THREADS=1 list3r {' '.join(words)}"
        ended = place.shell(line, 60)
        crashed = f"ends by signal {ended.status - 128}" if ended.status is not None and ended.status > 128 else ""
        return first(crashed, ended.bad)

    return look


def workers_of_an_ended_parent(place: Place) -> str:
    """A benchmark with two busy processes that is ended."""
    return _left_alive(place, place.checkout / "benchmarks/uncertainty.py", "--seeds", "1,2,3,4", "--workers", "2")


def _left_alive(place: Place, *words: object) -> str:
    command = [sys.executable, *map(str, words)]
    process = subprocess.Popen(command, cwd=place.folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 200
    while sum(_spent_s(pid) > _AT_WORK_S for pid in descendants(process.pid)) < 2 and time.monotonic() < end:
        time.sleep(0.1)
    workers = [pid for pid in descendants(process.pid) if _spent_s(pid) > _AT_WORK_S]
    process.send_signal(signal.SIGTERM)
    process.wait()
    end = time.monotonic() + 10
    while (alive := [pid for pid in workers if Path(f"/proc/{pid}").exists()]) and time.monotonic() < end:
        time.sleep(0.2)
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    return f"{len(alive)} of {len(workers)} work on after 10 s" if alive or not workers else ""


def _spent_s(pid: int) -> float:
    """Seconds of a processor that a process has taken."""
    with contextlib.suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def children_of_the_caller(place: Place) -> str:
    """A build with two workers in a program that has a child of its own."""
    place.walk(frames=12, size=(160, 120))
    script = place.folder / "script.py"
    script.write_text(
        "import multiprocessing, time, list3r\n"
        "if __name__ == '__main__':\n"
        "    own = multiprocessing.get_context('spawn').Process(target=time.sleep, args=(200,))\n"
        "    own.start()\n"
        "    try:\n"
        "        list3r.build('walk', 'b.l3r', workers=2)\n"
        "    except Exception as error:\n"
        "        print(error)\n"
        "    print('alive' if own.is_alive() else 'killed')\n"
        "    own.kill()\n"
    )
    ended = place.shell(f'"{sys.executable}" script.py', 240)
    return first(ended.bad, "" if ended.out.strip().endswith("alive") else f"it is {ended.out.strip()[-100:]}")


ROWS: dict[str, Callable[[Place], str]] = {
    "15 a writable handle that is dropped": dropped_writer,
    "15 a forked child closes an inherited writer": forked_child,
    "15 what is asked after close": after_close,
    "15 build in 600 MiB of address space": _limited("build walk -m b.l3r --poses given"),
    "15 export to USD in 600 MiB of address space": _limited("export m.l3r --to usd --out x.usda"),
    "16 workers of a benchmark that got SIGTERM": workers_of_an_ended_parent,
    "16 children of a program that calls build": children_of_the_caller,
}
