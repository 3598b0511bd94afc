"""Facts of the machine and of a measured process, for the benchmarks."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Processor, cores in use, memory, Python."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    cores = len(os.sched_getaffinity(0))
    return {"processor": model, "cores": cores, "python": platform.python_version(), "system": platform.platform()}


def run_list3r(*arguments: str, kept: Path | None = None) -> tuple[dict[str, Any], dict[str, float]]:
    """Run the program with --json; its report, its wall seconds and the peak memory of all its processes.

    `kept` is a folder for reconstructions, see `kept.py`.
    """
    started = time.monotonic()
    program = ["-m", "list3r"] if kept is None else [str(Path(__file__).with_name("kept.py"))]
    environment = os.environ if kept is None else os.environ | {"LIST3R_KEPT": str(kept)}
    process = subprocess.Popen(
        [sys.executable, *program, *arguments, "--json"],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=_end_with_starter,
    )
    peak = _watch(process)
    out = process.stdout.read() if process.stdout else ""
    if process.wait() != 0:
        raise SystemExit(f"list3r {' '.join(arguments)} ended with status {process.returncode}")
    (report,) = json.loads(out)["matches"]
    return report, {"wall_s": round(time.monotonic() - started, 2), "peak_mb": round(peak / 1e6, 1)}


def _end_with_starter() -> None:
    """Let this process end with its parent, however that ends; on Linux."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG of <sys/prctl.h>


def _watch(process: subprocess.Popen[str]) -> float:
    """Peak of the summed set sizes of a process and its descendants, bytes.

    A sample walks through all their pages: ten a second took an eighth of two processors during a build of 2.5 GB. So
    there are ten a second at most, and fewer where they would take more than 3 % of a processor's time.
    """
    peak, spent = 0.0, time.process_time()
    while True:
        peak = max(peak, sum(_resident(pid) for pid in [process.pid, *descendants(process.pid)]))
        before, spent = spent, time.process_time()
        try:
            process.wait(max(0.1, 32.0 * (spent - before)))
            return peak
        except subprocess.TimeoutExpired:
            continue


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and theirs."""
    found: list[int] = []
    try:
        texts = [(task / "children").read_text() for task in Path(f"/proc/{pid}/task").iterdir()]
    except OSError:  # it has ended meanwhile
        return found
    for child in (int(word) for text in texts for word in text.split()):
        found += [child, *descendants(child)]
    return found


def _resident(pid: int) -> float:
    """Proportional set size, bytes: pages shared by several processes count once over all of them."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(float(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))


@contextlib.contextmanager
def two_ray_nodes() -> Iterator[str]:
    """Two Ray nodes of one core each on this machine; the address of the first."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    try:
        yield cluster.address
    finally:
        cluster.shutdown()


def commit() -> str:
    """Return the commit of the code that runs, with "+" where files differ from it; "unknown" outside a checkout."""
    here = Path(__file__).parent
    try:
        said = [
            subprocess.run(["git", "-C", str(here), *words], capture_output=True, text=True, check=True).stdout.strip()
            for words in (("rev-parse", "--short=10", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        ]
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return said[0] + ("+" if said[1] else "")


def end_with_parent() -> None:
    """Let this process end soon after the one that started it, however that ends."""
    threading.Thread(target=_follow, args=(os.getppid(),), daemon=True).start()


def _follow(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.3)
    os._exit(1)


STARTED_AT = commit()
"""The code may change while a long benchmark runs; the loaded code is that of the start."""


def write_json(path: Path | None, result: dict[str, Any]) -> None:
    """Write a result next to the machine and the commit that it was measured on; temporary folders are not named."""
    if path is not None:
        written = json.dumps({"machine": machine(), "commit": STARTED_AT, **result}, indent=2)
        path.write_text(re.sub(rf"{re.escape(tempfile.gettempdir())}/\w+", "...", written) + "\n", encoding="utf-8")
