"""Rendered walks with depth that see a room again from its other end: does a build join the two parts?

python benchmarks/opposite.py --seeds 201-204 --json FILE

The end of one run and another run of `benchmarks.simulation.returns`, 320 x 240 with a sensor's noise, are one video
with a cut. `list3r build --poses estimate` makes a memory of it: real features, real discovery, metric depth. A part is
joined by frames where an accepted loop across the cut was found by frame similarity, else by instances. The error is
that of the second part after alignment with the truth by the first.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, run_list3r, write_json

from benchmarks.simulation.walks import SeenAgainWalk
from list3r.evaluation.trajectory import Trajectory, align, read_tum
from list3r.memory.store.store import Store
from list3r.simulation.dataset import write_walk


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="201-204", help="first-last")
    parser.add_argument("--preset", default="opposite", choices=("opposite", "halls", "alike"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split("-"))
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(first, last + 1):
            rows.append({"seed": seed, **one_home((args.keep or Path(scratch)) / str(seed), args.preset, seed)})
            print(json.dumps(rows[-1]), flush=True)
            write_json(args.json, {"preset": args.preset, "homes": rows})
    print(machine())


def one_home(root: Path, preset: str, seed: int) -> dict[str, Any]:
    """Film, build, measure."""
    walk, memory = SeenAgainWalk(seed=seed, preset=preset), root / "memory.l3r"
    if not (root / "walk" / "truth.json").exists():
        write_walk(root / "walk", walk)
    memory.unlink(missing_ok=True)
    _, usage = run_list3r("build", str(root / "walk"), "-m", str(memory), "--poses", "estimate", "--workers", "1")
    truth = read_tum(root / "walk" / "groundtruth.txt")
    with Store.open(memory) as store:
        return {**measure(store, truth, walk.cut()), **usage}


def measure(store: Store, truth: Trajectory, cut: int) -> dict[str, Any]:
    """How the two parts were joined, and the error of the second."""
    chunks = {c.chunk_id: c for c in store.chunks.all()}
    across = [
        e for e in store.edges.all() if e.kind == "loop" and chunks[e.u].last_frame < cut <= chunks[e.v].first_frame
    ]
    by_instances = [e for e in across if "things_pairs" in e.scores]
    poses = [(f.frame_index, S) for f, S in store.trajectory.poses()]
    component = {c.component for c in chunks.values()}
    report = {
        "chunks": len(chunks),
        "components": len(component),
        "instances": store.instances.count(),
        "by_frames": sum(e.accepted for e in across if e not in by_instances),
        "by_things": sum(e.accepted for e in by_instances),
        "reasons": [e.reason for e in by_instances],
    }
    rows = np.array([k for k, _ in poses])
    path = np.stack([_rigid(S) for _, S in poses])
    parts = [rows < cut, rows >= cut]
    if len(component) > 1 or not all(p.any() for p in parts):
        return report
    first = rows[parts[0]]
    known = Trajectory(truth.time_s[first], truth.T_world_cam[first])
    S_truth_world = align(known, Trajectory(truth.time_s[first], path[parts[0]]), with_scale=False)
    error = np.linalg.inv(truth.T_world_cam[rows[parts[1]]]) @ _moved(S_truth_world, path[parts[1]])
    turn = np.degrees(np.arccos(np.clip((np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    off = np.linalg.norm(error[:, :3, 3], axis=1)
    return report | {"off_m": round(float(np.median(off)), 4), "off_deg": round(float(np.median(turn)), 3)}


def _rigid(S: Any) -> Any:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = S.rotation, S.translation
    return out


def _moved(S: Any, poses: Any) -> Any:
    out = poses.copy()
    out[:, :3, :3] = S.rotation @ poses[:, :3, :3]
    out[:, :3, 3] = S.apply(poses[:, :3, 3])
    return out


if __name__ == "__main__":
    main()
