"""A long recording of tiny frames built to its end: memory as it goes on, and after being killed in the middle.

    python benchmarks/long_build.py [--frames 20000] [--kills 1] [--json FILE]

A walk through a simulated room there and back again in the TUM layout, with its depth and poses as given, so that
nothing but the length is hard. The build is killed (SIGKILL) when it is half done, and begun again. Memory is that of
the program alone, work and all: `--workers 0`.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
from machine import machine, write_json
from scipy.spatial.transform import Rotation

import list3r
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.rendering.sensor import sense

DRAWN = 200
SIZE = (64, 48)
REPORT = """
import json, resource, sys, time
from pathlib import Path
from list3r.pipeline.build import build
from list3r.pipeline.request import BuildRequest, RunOptions, Watch
def mb():
    return round(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20)
begun = time.process_time()
def show(done, total):
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(json.dumps({"frames": done, "of": total, "mb": mb(), "peak_mb": peak,
                      "cpu_s": round(time.process_time() - begun, 1)}), flush=True)
source, memory, resume = sys.argv[1:]
build(source, memory, settings=BuildRequest(poses="given"), run=RunOptions(workers=0, resume=resume == "1"),
      watch=Watch(show))
show(-1, -1)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--kills", type=int, default=1, help="so many times, evenly spread")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        source, memory = Path(scratch) / "walk", Path(scratch) / "walk.l3r"
        write_walk(source, args.frames)
        stops = [args.frames * (k + 1) // (args.kills + 1) for k in range(args.kills)]
        runs = [run(source, memory, stop, resume=k > 0) for k, stop in enumerate([*stops, None])]
        checked = subprocess.run([sys.executable, "-m", "list3r", "verify", str(memory)], check=False).returncode
        with list3r.open(memory) as scene:
            held = {
                "frames": len(scene.store.frames.all()),
                "chunks": len(scene.store.chunks.all()),
                "instances": len(scene),
            }
    found = {"frames": args.frames, "runs": runs, "verify": checked, "memory": held}
    print(machine())
    print(json.dumps(found, indent=1))
    write_json(args.json, found)


def write_walk(root: Path, frames: int) -> None:
    """Write lists that name the drawn pictures over and over, in the order of the walk and back."""
    walk = WalkSettings(seed=1, frames=DRAWN, size=SIZE)
    _, poses = walk.poses()
    renderer, camera = Renderer(walk.world(), walk.camera()), walk.camera()
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    for k, T in enumerate(poses):
        seen = sense(renderer.render(T), walk.sensor, walk.seed, k, 0.0)
        cv2.imwrite(str(root / f"rgb/{k}.png"), seen.color[..., ::-1])
        cv2.imwrite(str(root / f"depth/{k}.png"), (5000 * seen.depth).round().astype("uint16"))
    (root / "calibration.txt").write_text(f"{camera.fx} {camera.fy} {camera.cx} {camera.cy}\n")
    period = 2 * len(poses) - 2
    with (root / "rgb.txt").open("w") as rgb, (root / "depth.txt").open("w") as depth:
        with (root / "groundtruth.txt").open("w") as truth:
            for n in range(frames):
                k = n % period if n % period < len(poses) else period - n % period
                T, time_s = poses[k], f"{n / 30:.4f}"
                rgb.write(f"{time_s} rgb/{k}.png\n")
                depth.write(f"{time_s} depth/{k}.png\n")
                words = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
                truth.write(f"{time_s} {' '.join(f'{v:.6f}' for v in words)}\n")


def run(source: Path, memory: Path, stop: int | None, *, resume: bool) -> list[dict[str, Any]]:
    """Build, killed after `stop` frames; the progress at every eighth of the frames and last."""
    command = [sys.executable, "-c", REPORT, str(source), str(memory), str(int(resume))]
    report: list[dict[str, Any]] = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            row = json.loads(line)
            eighth = 8 * row["frames"] // max(1, row["of"])
            if not report or row["frames"] < 0 or eighth > 8 * report[-1]["frames"] // report[-1]["of"]:
                report.append(row)
                print(json.dumps(row), flush=True)
            if stop is not None and row["frames"] >= stop:
                os.kill(process.pid, signal.SIGKILL)
                break
    time.sleep(0.1)
    return report


if __name__ == "__main__":
    main()
