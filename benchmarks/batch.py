"""Many short videos: local processes and Ray make the same files; nothing is lost or built twice while processes die.

python benchmarks/batch.py --engines local ray --json benchmarks/results/batch.json

Processor seconds are those of the command and its children, sampled twice a second: time of a process after its last
sample is not counted.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
from machine import descendants, two_ray_nodes, write_json

from list3r.batch.sealing import file_hash
from list3r.simulation.dataset import WalkSettings, write_walk


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--folder", type=Path, default=Path("batch-benchmark"), help="Videos, memories, result.")
    words.add_argument("--videos", type=int, default=200)
    words.add_argument("--distinct", type=int, default=60, help="So many are made; the others are copies of these.")
    words.add_argument("--frames", type=int, default=6)
    words.add_argument("--size", type=int, nargs=2, default=(160, 120))
    words.add_argument("--engines", nargs="+", default=["local"], choices=["local", "ray"])
    words.add_argument("--runs", nargs="+", help="Only these, in addition to the runs in --json; one-process first.")
    words.add_argument("--worker-kills", type=int, default=20)
    words.add_argument("--driver-kills", type=int, default=2)
    words.add_argument("--seed", type=int, default=1)
    words.add_argument("--json", type=Path, help="Where the result is written; default: in the folder.")
    asked = words.parse_args()
    videos = _videos(asked.folder / "videos", asked)
    runs: dict[str, object] = {}
    result: dict[str, object] = {
        "videos": asked.videos,
        "distinct": min(asked.distinct, asked.videos),
        "frames": asked.frames,
    }
    result |= {"size": list(asked.size), "runs": runs}
    report = asked.json or asked.folder / "batch.json"
    if asked.runs and report.exists():
        runs |= json.loads(report.read_text())["runs"]
    print(f"{asked.videos} videos of {asked.frames} frames and one file that is no video")
    reference: dict[str, str] | None = None
    for name, engine, jobs in _runs(asked.engines):
        out = asked.folder / f"out-{name}"
        if asked.runs and name not in asked.runs:
            reference = reference or _hashes(out)
            continue
        kills = (asked.worker_kills, asked.driver_kills) if name.endswith("killed") else (0, 0)
        with two_ray_nodes() if engine == "ray" else contextlib.nullcontext("") as address:
            command = [sys.executable, "-m", "list3r", "batch", str(videos), "--out", str(out), "--retries", "100"]
            command += ["--engine", engine, *(["--address", address] if address else []), *jobs]
            found = _run(command, out, kills, random.Random(asked.seed))
        hashes = _hashes(out)
        reference = reference or hashes
        found |= {"files": len(hashes), "equal": hashes == reference, **_report(out)}
        runs[name] = found
        print(name, json.dumps(found), flush=True)
        write_json(report, result)


def _runs(engines: list[str]) -> Iterator[tuple[str, str, list[str]]]:
    """Yield name, engine and further options of each run; the first is the reference."""
    yield "one-process", "local", ["--jobs", "1"]
    for engine in engines:
        yield engine, engine, []
        yield f"{engine}-killed", engine, []


def _videos(folder: Path, asked: argparse.Namespace) -> Path:
    for k in range(asked.videos):
        video, first = folder / f"v{k:04d}", folder / f"v{k % asked.distinct:04d}"
        if video.exists():
            continue
        if k < asked.distinct:
            write_walk(video, WalkSettings(seed=k, frames=asked.frames, size=tuple(asked.size)))
        else:
            shutil.copytree(first, video)
    (folder / "poisoned.mp4").write_bytes(b"not a video")
    return folder


def _run(command: list[str], out: Path, kills: tuple[int, int], chance: random.Random) -> dict[str, object]:
    """Run the command until it finishes, killing its workers and itself at random meanwhile."""
    workers_left, drivers_left = kills
    began, runs, first_seen, rewritten = time.monotonic(), 0, dict[str, int](), set[str]()
    before, spent = _spent(), dict[int, float]()
    while True:
        driver = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        runs += 1
        started, due = time.monotonic(), time.monotonic() + chance.uniform(1, 6)
        looked = 0.0
        while driver.poll() is None:
            time.sleep(0.05)
            if time.monotonic() > looked + 0.5:
                looked = time.monotonic()
                spent |= _spent()
            for path in out.glob("*.l3r"):
                with contextlib.suppress(FileNotFoundError):
                    if first_seen.setdefault(path.name, path.stat().st_ino) != path.stat().st_ino:
                        rewritten.add(path.name)
            if time.monotonic() < due:
                continue
            due = time.monotonic() + chance.uniform(0.5, 5)
            if drivers_left and time.monotonic() - started > 15:
                drivers_left -= 1
                driver.kill()
            elif workers_left and (busy := _workers(driver.pid, command)):
                workers_left -= 1
                with contextlib.suppress(ProcessLookupError):
                    os.kill(chance.choice(busy), signal.SIGKILL)
        if driver.wait() >= 0:
            seconds, cpu = time.monotonic() - began, sum(spent.values()) - sum(before.values())
            killed = {"worker_kills": kills[0] - workers_left, "driver_kills": kills[1] - drivers_left}
            return {"status": driver.returncode, "seconds": round(seconds, 1), "cpu_s": round(cpu, 1), "runs": runs} | {
                **killed,
                "rewritten": sorted(rewritten),
            }


def _spent() -> dict[int, float]:
    """Processor seconds of each process that this one has started, and of theirs."""
    found = {}
    for pid in descendants(os.getpid()):
        with contextlib.suppress(psutil.Error):
            times = psutil.Process(pid).cpu_times()
            found[pid] = times.user + times.system
    return found


def _workers(driver: int, command: list[str]) -> list[int]:
    """Processes that work on a task now."""
    found = []
    with contextlib.suppress(psutil.Error):
        if "ray" not in command:
            found = [p.pid for p in psutil.Process(driver).children()]
        else:
            everyone = psutil.Process().children(recursive=True)
            found = [p.pid for p in everyone if "ray::run_task" in " ".join(p.cmdline())]
    return found


def _hashes(out: Path) -> dict[str, str]:
    return {p.name: file_hash(p) for p in sorted(out.glob("*.l3r"))}


def _report(out: Path) -> dict[str, object]:
    """The manifest: tasks by state, and how often any was built."""
    with contextlib.closing(sqlite3.connect(out / "batch.sqlite")) as database:
        states = dict(database.execute("SELECT state, count(*) FROM tasks GROUP BY state").fetchall())
        attempts = dict(database.execute("SELECT outcome, count(*) FROM attempts GROUP BY outcome").fetchall())
        twice = database.execute("SELECT memory FROM attempts WHERE built GROUP BY memory HAVING count(*) > 1")
        failed = dict(database.execute("SELECT memory, reason FROM tasks WHERE state = 'failed'").fetchall())
        return {"states": states, "attempts": attempts, "built_twice": [n for (n,) in twice]} | {
            "failed": {name: reason.replace(f"{out.parent.resolve()}/", "") for name, reason in failed.items()}
        }


if __name__ == "__main__":
    main()
