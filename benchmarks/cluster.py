"""One long video with its chunks processed in parallel: in one process, in two, and on two Ray nodes, where a worker
and the command itself are killed once. The files must be identical, and are scored against the walk's truth.

python benchmarks/cluster.py --frames 280 --json benchmarks/results/cluster.json

Besides the wall time, the processor time of the command alone is given, which does the sequential part: it bounds the
speed-up by more machines. In one process it is all of the work.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
from machine import two_ray_nodes, write_json

from list3r.batch.sealing import seal
from list3r.simulation.dataset import WalkSettings, write_walk


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--folder", type=Path, default=Path("cluster-benchmark"), help="The walk and the memories.")
    words.add_argument("--frames", type=int, default=280)
    words.add_argument("--seed", type=int, default=7)
    words.add_argument("--runs", nargs="+", default=["one process", "two processes", "ray", "ray, ended"])
    words.add_argument("--json", type=Path)
    asked = words.parse_args()
    walk = asked.folder / f"walk-{asked.seed}-{asked.frames}"
    if not walk.exists():
        write_walk(walk, WalkSettings(seed=asked.seed, frames=asked.frames))
    runs: dict[str, Any] = {}
    for name in asked.runs:
        memory = asked.folder / f"{name.replace(', ', '-').replace(' ', '-')}.l3r"
        runs[name] = _run(walk, memory, name)
        runs[name]["equal"] = runs[name]["sha256"] == next(iter(runs.values()))["sha256"]
        print(name, json.dumps(runs[name]), flush=True)
        write_json(asked.json, {"frames": asked.frames, "seed": asked.seed, "size": [320, 240], "runs": runs})


def _run(walk: Path, memory: Path, name: str) -> dict[str, Any]:
    """Build a walk in one way; returns cost and result."""
    memory.unlink(missing_ok=True)
    command = [sys.executable, "-m", "list3r", "build", str(walk), "-m", str(memory), "--poses", "estimate", "--json"]
    with two_ray_nodes() if name.startswith("ray") else contextlib.nullcontext("") as address:
        if address:
            command += ["--engine", "ray", "--address", address]
        else:
            command += ["--workers", "0" if name == "one process" else "2"]
        began = time.monotonic()
        kills = {"workers": 0, "commands": 0}
        if name.endswith("ended"):
            kills = _ended(command, memory)
            command.append("--resume")
        report, own_s = _built(command)
        wall_s = time.monotonic() - began
    errors = _answer("eval", "trajectory", str(walk), str(memory))
    found = _answer("eval", "instances", str(walk / "truth.json"), str(memory))
    sha256 = seal(memory, memory.with_suffix(".sealed"), ("benchmark",), "walk")
    figures = {"chunks": report["chunks"], "instances": report["instances"], "ate_m": errors["ate_se3_m"]["rmse"]}
    scores = {k: found["instances_0.25"][k] for k in ("matched", "true_count", "precision", "recall")}
    return {"wall_s": round(wall_s, 1), "command_cpu_s": round(own_s, 1), "ended": kills, **figures, **scores} | {
        "sha256": sha256
    }


def _ended(command: list[str], memory: Path) -> dict[str, int]:
    """Begin the work; end a worker that is busy, and then, when chunks are in the memory, the command itself."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    workers = 0
    while process.poll() is None:
        time.sleep(0.05)
        busy = [p.pid for p in psutil.Process().children(recursive=True) if "ray::_called" in _words(p)]
        if busy and not workers:
            time.sleep(0.5)
            with contextlib.suppress(ProcessLookupError):
                os.kill(busy[0], signal.SIGKILL)
                workers += 1
        if workers and memory.exists() and _chunks(memory) >= 2:
            process.kill()
            process.wait()
            return {"workers": workers, "commands": 1}
    return {"workers": workers, "commands": 0}


def _words(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def _chunks(memory: Path) -> int:
    from list3r.memory.store.store import Store

    with Store.open(memory) as store:
        return len(store.chunks.all())


def _built(command: list[str]) -> tuple[dict[str, Any], float]:
    """Run the command; its report, and processor seconds of its own process."""
    own_s = 0.0
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    watched = psutil.Process(process.pid)
    while process.poll() is None:
        with contextlib.suppress(psutil.Error):
            times = watched.cpu_times()
            own_s = max(own_s, times.user + times.system)
        time.sleep(0.05)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with status {process.returncode}")
    (report,) = json.loads(process.stdout.read() if process.stdout else "")["matches"]
    return report, own_s


def _answer(*words: str) -> dict[str, Any]:
    done = subprocess.run([sys.executable, "-m", "list3r", *words, "--json"], stdout=subprocess.PIPE, check=True)
    found: dict[str, Any] = json.loads(done.stdout)["matches"][0]
    return found


if __name__ == "__main__":
    main()
