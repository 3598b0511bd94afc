"""Second sessions after heavy change: is the later session placed in the home of the earlier one?

python benchmarks/changed_homes.py --seeds 401-420 --keep FOLDER --json benchmarks/results/changed-homes.json

A room of a home is filmed with a sensor's depth, 320 x 240 (`HomeSessionWalk`). Then half of the objects on its floor
and furniture are moved within the room, the light changes (`EVENING`), and the room is filmed again from near the same
places. `list3r build` makes a memory of the first walk, `list3r update` adds the second. A session counts as placed
where all its chunks are in the world of the first and its cameras are off by at most 0.1 m and 3 degrees (medians)
after alignment of the world with the truth by the cameras of the first session alone, with their mean rotation. With
--reconstruction sfm both memories are made from colour alone, and the cameras of the first session give the scale as
well. Results in the JSON are not repeated, and walks and memories in --keep are reused. With
--other-homes the second session of each next home is added to the memory of a home in --keep, where it must not be
placed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from machine import STARTED_AT, machine, run_list3r, write_json
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.simulation.walks import HomeSessionWalk
from list3r.evaluation.trajectory import Trajectory, associate, read_tum
from list3r.memory.core.geometry import Sim3
from list3r.memory.store.store import Store
from list3r.simulation.dataset import write_walk
from list3r.simulation.rendering.shading import EVENING

Array = NDArray[np.float64]
MOST_M, MOST_DEG = 0.1, 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="401-420", help="first-last")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    parser.add_argument("--reconstruction", choices=("rgbd", "sfm"), default="rgbd")
    parser.add_argument("--other-homes", action="store_true", help="add sessions to memories of other homes in --keep")
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split("-"))
    if args.other_homes:
        write_json(args.json, other_homes(args.keep, range(first, last + 1)))
        return
    rows = json.loads(args.json.read_text())["homes"] if args.json and args.json.exists() else []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(first, last + 1):
            if any(row["seed"] == seed for row in rows):
                continue
            root = (args.keep or Path(scratch)) / str(seed)
            rows.append({"seed": seed, "commit": STARTED_AT, **one_home(root, seed, args.reconstruction)})
            print(json.dumps(rows[-1]), flush=True)
            write_json(args.json, {"homes": rows, "total": total(rows)})
    print(machine())
    print(json.dumps(total(rows), indent=1))


def one_home(root: Path, seed: int, model: str) -> dict[str, Any]:
    """Film twice, build, update, measure."""
    walks = {
        "first": HomeSessionWalk(seed=seed, walk_seed=seed),
        "second": HomeSessionWalk(seed=seed, walk_seed=seed + 1000, second=True, lighting=EVENING),
    }
    for name, walk in walks.items():
        if not (root / name / "truth.json").exists():
            shutil.rmtree(root / name, ignore_errors=True)
            write_walk(root / name, walk)
    kind = "" if model == "rgbd" else f"-{model}"
    one, two = root / f"one{kind}.l3r", root / f"two{kind}.l3r"
    common = ("--poses", "estimate", "--reconstruction", model, "--workers", "1")
    usage: dict[str, dict[str, float]] = {}
    part = root / "part.l3r"
    if not one.exists():
        _, usage["build"] = run_list3r("build", str(root / "first"), "-m", str(part), "--force", *common)
        part.rename(one)
    if not two.exists():
        shutil.copy(one, part)
        _, usage["update"] = run_list3r("update", str(part), str(root / "second"), *common)
        part.rename(two)
    with Store.open(two) as store:
        chunks = store.chunks.all()
        later = [c.component for c in chunks if c.session_id == 2]
        placed = sum(k == chunks[0].component for k in later)
        row = {"chunks": len(later), "in_world": placed, "loops": _between_sessions(store), "usage": usage}
        if placed:
            truth = [read_tum(root / name / "groundtruth.txt") for name in ("first", "second")]
            pairs = (_pairs(store, k + 1, t) for k, t in enumerate(truth))
            off_m, off_deg = offset(*pairs, with_scale=model == "sfm")
            row |= {"off_m": round(off_m, 4), "off_deg": round(off_deg, 3)}
    near = row.get("off_m", np.inf) <= MOST_M and row.get("off_deg", np.inf) <= MOST_DEG
    return row | {"placed": near and placed == len(later)}


def _pairs(store: Store, session: int, truth: Trajectory) -> tuple[Array, Array]:
    """Poses of a session in the world of the first chunk and in truth. Shapes (F, 4, 4)."""
    chunks = store.chunks.all()
    world = {c.chunk_id for c in chunks if c.component == chunks[0].component}
    poses = [(f, S) for f, S in store.trajectory.poses(session) if f.chunk_id in world]
    T = np.array([Sim3(1.0, S.rotation, S.translation).as_matrix() for _, S in poses])
    rows, at = associate(truth.time_s, np.array([f.time_s for f, _ in poses]), 0.01)
    return T[at], truth.T_world_cam[rows]


def offset(first: tuple[Array, Array], second: tuple[Array, Array], *, with_scale: bool) -> tuple[float, float]:
    """Return the median errors of the second session's cameras, metres and degrees. Rotations of the first session
    align the world with the truth: short paths leave a rotation about themselves uncertain.
    """
    R = Rotation.from_matrix([t[:3, :3] @ w[:3, :3].T for w, t in zip(*first, strict=True)]).mean().as_matrix()
    spread = [np.linalg.norm(np.std(T[:, :3, 3], axis=0)) for T in first]
    s = spread[1] / spread[0] if with_scale else 1.0
    shift = np.mean([t[:3, 3] - s * R @ w[:3, 3] for w, t in zip(*first, strict=True)], axis=0)
    world, truth = second
    off_m = np.linalg.norm(s * world[:, :3, 3] @ R.T + shift - truth[:, :3, 3], axis=1)
    turned = Rotation.from_matrix(R @ world[:, :3, :3]).inv() * Rotation.from_matrix(truth[:, :3, :3])
    return float(np.median(off_m)), float(np.degrees(np.median(turned.magnitude())))


def other_homes(keep: Path, seeds: Sequence[int]) -> dict[str, Any]:
    """Add the second session of each next home to the memory of a home, where it must stay apart."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for home, other in itertools.pairwise(seeds):
            memory = Path(scratch) / f"{home}-{other}.l3r"
            shutil.copy(keep / str(home) / "one.l3r", memory)
            run_list3r(
                "update", str(memory), str(keep / str(other) / "second"), "--poses", "estimate", "--workers", "1"
            )
            with Store.open(memory) as store:
                chunks = store.chunks.all()
                placed = sum(c.component == chunks[0].component for c in chunks if c.session_id == 2)
                rows.append({"home": home, "session_of": other, "in_world": placed, "loops": _between_sessions(store)})
            print(json.dumps(rows[-1]), flush=True)
    return {"sessions": len(rows), "placed": sum(r["in_world"] > 0 for r in rows), "of": rows}


def _between_sessions(store: Store) -> list[dict[str, Any]]:
    """The candidate relations between the two sessions: support and outcome."""
    session = {c.chunk_id: c.session_id for c in store.chunks.all()}
    found = [e for e in store.edges.all() if session[e.u] != session[e.v]]
    return [{"accepted": e.accepted, "reason": e.reason[:160]} for e in found]


def total(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Numbers of correctly and wrongly placed sessions, including partial placements."""
    said = [r for r in rows if r["in_world"]]
    off = [r["off_m"] for r in said]
    return {
        "homes": len(rows),
        "placed": sum(r["placed"] for r in rows),
        "wrong": sum(r["off_m"] > MOST_M or r["off_deg"] > MOST_DEG for r in said),
        "median_off_m": float(np.median(off)) if off else None,
        "worst_off_m": max(off, default=None),
    }


if __name__ == "__main__":
    main()
