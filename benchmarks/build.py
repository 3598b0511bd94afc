"""The main job on a real sequence: frames a second, peak memory, file size, trajectory error.

    python benchmarks/build.py --source ../shared/data/redkitchen --json benchmarks/results/redkitchen.json

The wall time is that of the whole program, from its start to its end. Peak memory is the sum over all its processes.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from machine import machine, run_list3r, write_json


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", required=True)
    parser.add_argument("--poses", default="estimate")
    parser.add_argument("--frames", help="START:STOP, to see how memory grows with the length")
    parser.add_argument("--intrinsics")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    options = ["--poses", args.poses]
    for name in ("frames", "intrinsics"):
        if getattr(args, name):
            options += [f"--{name}", getattr(args, name)]
    with tempfile.TemporaryDirectory() as folder:
        memory = str(Path(folder) / "memory.l3r")
        report, usage = run_list3r("build", args.source, "-m", memory, *options)
        errors, _ = run_list3r("eval", "trajectory", args.source, memory)
        size_mb = Path(memory).stat().st_size / 1e6
    result = {
        "source": Path(args.source).name,
        "options": options,
        "frames": report["frames"],
        "posed": report["posed"],
        "frames_per_second": round(report["frames"] / usage["wall_s"], 2),
        **usage,
        "file_mb": round(size_mb, 1),
        "ate_se3_m": errors["ate_se3_m"]["rmse"],
        "ate_sim3_m": errors["ate_sim3_m"]["rmse"],
        "scale": errors["scale"],
        "instances": report["instances"],
        "loops": report["loops"],
        "stage_cpu_seconds": report["stage_seconds"],
    }
    print(machine())
    for key, value in result.items():
        print(f"{key:20} {value}")
    write_json(args.json, result)


if __name__ == "__main__":
    main()
