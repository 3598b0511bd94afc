"""A phone's walk through a simulated home, built with its poses as given, as a prior, without them, and with the true
ones (which is the most that poses can give).

python benchmarks/given_poses.py --seeds 1,2,3,4,5 --json benchmarks/results/given_poses.json
python benchmarks/given_poses.py --blind --modes given,prior,estimate --json benchmarks/results/given_poses_blind.json

The recording is like Record3D's: depth of 256 x 192 with a LiDAR's noise and confidence, ARKit's poses with a drift of
1 % and a jump (`simulation/phone.py`). ATE after a rigid alignment; tilt is the angle between the memory's vertical
and the true one; instances by boxes of the truth at an overlap of 0.25 and 0.5. `center_cm` is how far the centres of
pairs at 0.25 lie apart (mean) after the one rigid alignment, `nearest_cm` how far from each true thing the centre of
any instance lies (median), whether they make a pair or not. With `--keep` memories that are there are not built again.

With `--blind` the walk has stretches where the camera cannot be followed by what it sees (`simulation/blind.py`).
`posed` is how many frames have a pose in the memory, of `frames`; ATE and tilt are of those alone. `posed_blind` and
`blind_cm` (root mean square) are of the blind stretches alone, `components` the parts that the memory falls into.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, run_list3r, write_json
from scipy.spatial.transform import Rotation

import list3r
from benchmarks.simulation.blind import WALKED, BlindSettings
from benchmarks.simulation.phone import LidarSettings, write_phone_walk
from list3r.evaluation.scene import alignment_of, evaluate_scene, read_scene, scene_boxes
from list3r.evaluation.trajectory import Trajectory, associate, evaluate_trajectory, read_tum
from list3r.frames.recordings.axes import arkit_of_pose
from list3r.memory.geometry import Sim3
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.walk import PathSettings

PACE = PathSettings(fps=10.0, speed_m_s=1.0, turn_deg_s=70.0)
"""A brisk walk, of which every third picture of a phone is kept."""
MODES = ("given", "prior", "estimate", "true")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--modes", default=",".join(MODES))
    parser.add_argument("--frames", type=int, default=64, help="pictures of each walk; the whole round has about 115")
    parser.add_argument("--unsure", type=float, default=1.0, help="so many times larger errors where depth is not sure")
    parser.add_argument("--blind", action="store_true", help="with a bare wall, quick turns and a second of dark")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    words = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in map(int, words.seeds.split(",")):
            folder = (words.keep or Path(scratch)) / f"seed-{seed}"
            if not (folder / "truth.json").exists():
                walk = WalkSettings(seed=seed, frames=words.frames, path=PACE)
                blind = BlindSettings() if words.blind else None
                write_phone_walk(folder, walk, LidarSettings(unsure_times=words.unsure), blind=blind)
            for mode in words.modes.split(","):
                rows.append({"seed": seed, "poses": mode, **measured(folder, mode)})
                print("  ".join(f"{k} {v}" for k, v in rows[-1].items()), flush=True)
    mean = {mode: average([r for r in rows if r["poses"] == mode]) for mode in words.modes.split(",")}
    print(machine())
    print(json.dumps(mean, indent=1))
    write_json(words.json, {"mean": mean, "rows": rows})


def measured(folder: Path, mode: str) -> dict[str, Any]:
    """Build one memory and hold it against the truth."""
    memory = folder / f"{mode}.l3r"
    source = with_true_poses(folder) if mode == "true" else folder / "walk.r3d"
    options = (
        "--poses",
        "given" if mode == "true" else mode,
        "--workers",
        "1",
        "--preset",
        "cpu",
        "--chunk",
        "40",
        "--overlap",
        "12",
    )
    wall_s = None
    if not memory.exists():
        wall_s = run_list3r("build", str(source), "-m", str(memory), *options)[1]["wall_s"]
    with list3r.open(memory) as scene:
        scene.export("json", folder / f"{mode}.json")
        scene.export("tum", folder / f"{mode}.txt")
        components = len({chunk.component for chunk in scene.store.chunks.all()})
    truth, estimate = read_tum(folder / "groundtruth.txt"), read_tum(folder / f"{mode}.txt")
    errors = evaluate_trajectory(truth, estimate)
    S_truth_scene = alignment_of(truth, estimate, with_scale=False)
    scene_json, truth_json = read_scene(folder / f"{mode}.json"), read_scene(folder / "truth.json")
    scores = evaluate_scene(scene_json, truth_json, S_truth_scene)
    tilt = np.degrees(np.arccos(np.clip(S_truth_scene.rotation[2, 2], -1.0, 1.0)))
    row = {"ate_cm": round(100 * errors.ate_se3_m.rmse, 2), "posed": errors.pairs, "tilt_deg": round(float(tilt), 2)}
    row |= {"frames": len(truth.time_s), "components": components} | blind_errors(
        folder, truth, estimate, S_truth_scene
    )
    for overlap in ("0.25", "0.50"):
        found = scores[f"instances_{overlap}"]
        row |= {f"recall_{overlap}": found["recall"], f"precision_{overlap}": found["precision"]}
    row["duplicates"] = scores["instances_0.25"]["duplicates"]
    row["center_cm"] = round(100 * scores["instances_0.25"]["mean_center_error_m"], 2)
    row["nearest_cm"] = round(100 * nearest_m(scene_json, truth_json, scores, S_truth_scene), 2)
    return row | ({} if wall_s is None else {"wall_s": wall_s})


def blind_errors(folder: Path, truth: Trajectory, estimate: Trajectory, S_truth_scene: Sim3) -> dict[str, Any]:
    """Return how many frames of the blind stretches have a pose, and how far those are from the truth."""
    names = folder / "stretches.json"
    stretches = json.loads(names.read_text()) if names.exists() else []
    blind = {k for k, name in enumerate(stretches) if name != WALKED}
    if not blind:
        return {}
    pairs = [(k, j) for k, j in zip(*associate(truth.time_s, estimate.time_s), strict=True) if int(k) in blind]
    rows = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    off = S_truth_scene.apply(estimate.positions()[rows[:, 1]]) - truth.positions()[rows[:, 0]]
    error_cm = 100 * float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) if len(rows) else 0.0
    return {"blind": len(blind), "posed_blind": len(rows), "blind_cm": round(error_cm, 2)}


def nearest_m(
    scene: Mapping[str, Any], truth: Mapping[str, Any], scores: Mapping[str, Any], S_truth_scene: Sim3
) -> float:
    """Median distance from the centre of a true thing that was seen to the nearest one of an instance, metres."""
    seen = {row["id"] for row in scores["missed"]} | {true_id for true_id, _, _ in scores["matched_ids"]}
    true = np.array([box.center for k, box in scene_boxes(truth).items() if k in seen])
    found = np.array([box.center for box in scene_boxes(scene, S_truth_scene).values()])
    return float(np.median(np.linalg.norm(true[:, None] - found[None], axis=2).min(axis=1)))


def with_true_poses(folder: Path) -> Path:
    """Return the recording with the truth in place of its poses."""
    path = folder / "true.r3d"
    with zipfile.ZipFile(folder / "walk.r3d") as given, zipfile.ZipFile(path, "w") as out:
        for name in given.namelist():
            data = given.read(name)
            if name == "metadata":
                poses = [arkit_of_pose(T) for T in read_tum(folder / "groundtruth.txt").T_world_cam]
                rows = [[*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]] for T in poses]
                data = json.dumps({**json.loads(data), "poses": rows}).encode()
            out.writestr(name, data)
    return path


def average(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Means of the figures over walks."""
    return {k: round(statistics.fmean(r[k] for r in rows), 3) for k in rows[0] if k not in ("seed", "poses", "wall_s")}


if __name__ == "__main__":
    main()
