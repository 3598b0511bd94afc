"""A build by two versions of the program, in turns on one machine: ratio of speed, and quality.

    git worktree add --detach ../before 3aa3245
    PYTHONPATH=. python benchmarks/build_pair.py --before ../before --source ../shared/data/redkitchen --json FILE
    PYTHONPATH=. python benchmarks/build_pair.py --before ../before --source ../shared/data/redkitchen \\
        --colour-only --intrinsics 525,525,320,240 --json FILE

Each version builds the same pictures with two workers, once on a few frames for warm-up, then `--rounds` times, and
exports its own memory. Times are of the whole program, from its start to its end. Frames per second of different
machines cannot be compared; the ratio of two versions in one run can, and on a busy machine that of their processor
time (`by_processor_time`).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import machine, write_json
from sfm import colour_only, read_truth

from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory, read_tum

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
        for name, root in roots.items():
            few = Path(scratch) / f"few-{name}.l3r"
            run_from(root, colour or args.source.resolve(), few, [*options, "--frames", FEW])
        for _ in range(args.rounds):
            for name, root in roots.items():
                memory = Path(scratch) / f"{name}.l3r"
                spent = run_from(root, colour or args.source.resolve(), memory, options)
                rows[name].append(spent | _figures(root, memory, truth, args.colour_only))
                print(name, rows[name][-1], flush=True)
    best, cpu = ({name: min(r[k] for r in of) for name, of in rows.items()} for k in ("wall_s", "cpu_s"))
    result = {
        "source": args.source.name,
        "options": options,
        "before_commit": _commit(args.before),
        **rows,
        "times_as_fast": round(best["before"] / best["now"], 2),
        "by_processor_time": round(cpu["before"] / cpu["now"], 2),
    }
    print(machine(), result["times_as_fast"], result["by_processor_time"])
    write_json(args.json, result)


def _options(args: argparse.Namespace) -> list[str]:
    options = ["--reconstruction", "sfm"] if args.colour_only else ["--poses", "estimate"]
    options += ["--intrinsics", args.intrinsics] if args.intrinsics else []
    return options + (["--every", str(args.every)] if args.every else [])


def run_from(root: Path, source: Path, memory: Path, options: list[str]) -> dict[str, float]:
    """Build a memory with the program of a checkout; wall and processor seconds."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    _run(root, "build", str(source), "-m", str(memory), *options)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": round(time.monotonic() - started, 1), "cpu_s": round(cpu, 1)}


def _run(root: Path, *arguments: str) -> None:
    """Run the program of a checkout."""
    words, environment = [sys.executable, "-m", "list3r", *arguments], os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(words, cwd=root, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        said = f"ended with status {done.returncode}: {done.stderr[-500:]}"
        raise SystemExit(f"{root.name}: list3r {arguments[0]} {said}")


def _figures(root: Path, memory: Path, truth: Trajectory, colour: bool) -> dict[str, Any]:
    """Posed frames, error of the path (after Sim(3) by colour alone, else after SE(3)) and listed instances.

    Exported by the version that wrote the memory: another may not read it.
    """
    for kind in ("json", "tum"):
        _run(root, "export", str(memory), "--to", kind, "--out", str(memory.with_suffix(f".{kind}")))
    scene = json.loads(memory.with_suffix(".json").read_text(encoding="utf-8"))
    errors = evaluate_trajectory(truth, read_tum(memory.with_suffix(".tum")))
    return {
        "frames": len(truth.time_s),
        "posed": sum(c["posed_frames"] for c in scene["components"]),
        "ate_m": round(float((errors.ate_sim3_m if colour else errors.ate_se3_m).rmse), 5),
        "instances": sum(not e["structure"] for e in scene["instances"]),
    }


def _commit(root: Path) -> str:
    words = ["git", "-C", str(root), "rev-parse", "--short=10", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
