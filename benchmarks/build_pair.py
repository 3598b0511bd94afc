"""A build by two versions of the program, in turns on one machine: ratio of speed, and quality.

    git worktree add --detach ../before 3aa3245
    PYTHONPATH=. python benchmarks/build_pair.py --before ../before --source ../shared/data/redkitchen --json FILE
    PYTHONPATH=. python benchmarks/build_pair.py --before ../before --source ../shared/data/redkitchen \\
        --colour-only --intrinsics 525,525,320,240 --json FILE

Each version builds the same pictures with two workers, once on a few frames for warm-up, then `--rounds` times. Both
memories are opened by this version. Times are of the whole program, from its start to its end. Frames per second of
different machines cannot be compared; the ratio of two versions in one run can.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import machine, run_list3r, write_json
from sfm import colour_only, read_truth, sim3_error

from list3r.api import open as open_memory
from list3r.evaluation.scene import read_scene
from list3r.evaluation.trajectory import Trajectory
from list3r.memory.store.store import Store

FEW = "0:90"
"""Frames that are built to have everything compiled."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, help="checkout of the version to compare with")
    parser.add_argument("--source", type=Path, required=True, help="folder with poses")
    parser.add_argument("--colour-only", action="store_true", help="without depth and poses")
    parser.add_argument("--intrinsics", help="fx,fy,cx,cy")
    parser.add_argument("--every", type=int, help="take every n-th frame")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    here = Path(__file__).resolve().parents[1]
    roots = {"before": args.before.resolve(), "now": here}
    truth, names = read_truth(args.source, None)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in roots}
    with tempfile.TemporaryDirectory() as scratch:
        colour = colour_only(Path(scratch) / "colour", names) if args.colour_only else None
        options = ["--workers", "2", "--force", *_options(args)]
        for root in roots.values():
            run_from(root, colour or args.source.resolve(), Path(scratch) / "few.l3r", [*options, "--frames", FEW])
        for _ in range(args.rounds):
            for name, root in roots.items():
                memory = Path(scratch) / f"{name}.l3r"
                spent = run_from(root, colour or args.source.resolve(), memory, options)
                rows[name].append(spent | _figures(memory, args.source, truth if colour else None, len(names)))
                print(name, rows[name][-1], flush=True)
    best = {name: min(r["wall_s"] for r in of) for name, of in rows.items()}
    result = {
        "source": args.source.name,
        "options": options,
        "before_commit": _commit(args.before),
        **rows,
        "times_as_fast": round(best["before"] / best["now"], 2),
    }
    print(machine(), result["times_as_fast"])
    write_json(args.json, result)


def _options(args: argparse.Namespace) -> list[str]:
    options = ["--reconstruction", "sfm"] if args.colour_only else ["--poses", "estimate"]
    options += ["--intrinsics", args.intrinsics] if args.intrinsics else []
    return options + (["--every", str(args.every)] if args.every else [])


def run_from(root: Path, source: Path, memory: Path, options: list[str]) -> dict[str, float]:
    """Build a memory with the program of a checkout; wall and processor seconds."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    words = [sys.executable, "-m", "list3r", "build", str(source), "-m", str(memory), *options]
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(words, cwd=root, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{root.name}: list3r build ended with status {done.returncode}: {done.stderr[-500:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": round(time.monotonic() - started, 1), "cpu_s": round(cpu, 1)}


def _figures(memory: Path, source: Path, truth: Trajectory | None, count: int) -> dict[str, Any]:
    """Posed frames, error of the path (after Sim(3) by colour alone, else after SE(3)) and listed instances."""
    exported = memory.with_suffix(".json")
    with open_memory(memory) as opened:
        opened.export("json", str(exported))
    objects = [e for e in read_scene(exported)["instances"] if not e["structure"]]
    with Store.open(memory) as store:
        poses = {f.frame_index: (S.rotation, S.translation) for f, S in store.trajectory.poses()}
    if truth is None:
        errors, _ = run_list3r("eval", "trajectory", str(source), str(memory))
        error = errors["ate_se3_m"]["rmse"]
    else:
        error = sim3_error(truth, poses)
    return {"frames": count, "posed": len(poses), "ate_m": round(error, 5), "instances": len(objects)}


def _commit(root: Path) -> str:
    words = ["git", "-C", str(root), "rev-parse", "--short=10", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
