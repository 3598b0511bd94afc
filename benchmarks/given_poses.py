"""A phone's walk through a simulated home, built with its poses as given, as a prior, without them, and with the true
ones (the upper bound).

python benchmarks/given_poses.py --seeds 1,2,3,4,5 --json benchmarks/results/given_poses.json
python benchmarks/given_poses.py --blind --modes given,prior,estimate --json benchmarks/results/given_poses_blind.json
python benchmarks/given_poses.py --rooms --frames 300 --seeds 72,73,74,75,76 --modes given,prior,estimate --keep F

The recording is like Record3D's: depth of 256 x 192 with a LiDAR's noise and confidence, ARKit's poses with a drift of
1 % and a jump (`simulation/phone.py`). ATE after a rigid alignment; tilt is the angle between the memory's vertical and
the true one; instances by boxes of the truth at an overlap of 0.25 and 0.5. `center_cm` is the mean distance between
the centres of pairs at 0.25 after the one rigid alignment, `nearest_cm` the median distance from each true object to
the nearest centre of an instance, paired or not. With `--keep` existing memories are not built again.

With `--blind` the walk has stretches where the camera cannot be tracked visually (`simulation/blind.py`). `posed` is
how many frames have a pose in the memory, of `frames`; ATE and tilt are over these frames. `posed_blind` and `blind_cm`
(root mean square) are of the blind stretches alone, `components` the parts of the memory.

With `--rooms` the walk goes once through five or six rooms and a corridor and comes back to the first, and the phone is
lowered at doors (`simulation/lowered.py`). A memory may have several parts. Instances are then scored twice: `recall`
and the like align each part with the truth by its own cameras, which a user of the memory cannot do, so that separate
parts cost only duplicates; `main_recall` and `main_precision` are of the largest part alone. `twice` counts true
objects that are nearest to two or more instances, by centres within 0.3 m. ATE is of the largest part, `part_ate_cm` of
all, each aligned by itself. `near_recall` and the like align every instance with the truth by the cameras of its time:
recall without the deformation of the whole map (which ATE measures); `near_duplicates` counts duplicates.
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
from benchmarks.simulation.blind import WALKED, BlindSettings, BlindWalk, blind_walk
from benchmarks.simulation.lowered import LoweredSettings, lowered_walk
from benchmarks.simulation.phone import LidarSettings, write_phone_walk
from benchmarks.simulation.walks import PresetWalk
from list3r.evaluation.scene import alignment_of, evaluate_scene, read_scene, scene_boxes
from list3r.evaluation.trajectory import Trajectory, associate, evaluate_trajectory, read_tum
from list3r.exporters.components import read_components
from list3r.frames.recordings.axes import arkit_of_pose
from list3r.memory.core.geometry import Sim3, quat_wxyz_from_rotation, rotation_from_quat_wxyz
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.walk import PathSettings

PACE = PathSettings(fps=10.0, speed_m_s=1.0, turn_deg_s=70.0)
"""A brisk walk, with every third picture of a phone."""
MODES = ("given", "prior", "estimate", "true")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--modes", default=",".join(MODES))
    parser.add_argument("--frames", type=int, help="pictures of each walk; else 64 of about 115, or all of the rooms")
    parser.add_argument("--unsure", type=float, default=1.0, help="so many times larger errors where depth is not sure")
    parser.add_argument("--blind", action="store_true", help="with a bare wall, quick turns and a second of dark")
    parser.add_argument("--rooms", action="store_true", help="through all rooms of a home, the phone lowered at doors")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    words = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in map(int, words.seeds.split(",")):
            folder = (words.keep or Path(scratch)) / f"seed-{seed}"
            if not (folder / "truth.json").exists():
                walk, way = filmed(seed, words)
                write_phone_walk(folder, walk, LidarSettings(unsure_times=words.unsure), way=way)
            for mode in words.modes.split(","):
                rows.append({"seed": seed, "poses": mode, **measured(folder, mode)})
                print("  ".join(f"{k} {v}" for k, v in rows[-1].items()), flush=True)
    mean = {mode: average([r for r in rows if r["poses"] == mode]) for mode in words.modes.split(",")}
    print(machine())
    print(json.dumps(mean, indent=1))
    write_json(words.json, {"mean": mean, "rows": rows})


def filmed(seed: int, words: argparse.Namespace) -> tuple[WalkSettings, BlindWalk | None]:
    """Return the walk of a seed, and its way where that has stretches in which the camera cannot be followed."""
    if words.rooms:
        lowered = LoweredSettings()
        frames = None if words.frames is None else lowered.every * words.frames
        rooms = PresetWalk(seed=seed, preset="loop", frames=frames, path=PathSettings(fps=12.5 / lowered.every))
        return rooms, lowered_walk(rooms, lowered)
    walk = WalkSettings(seed=seed, frames=words.frames or 64, path=PACE)
    return walk, blind_walk(walk, BlindSettings()) if words.blind else None


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
        parts = paths_of_parts(scene)
        component_of = {i.id: i.component for i in scene.store.instances.all()}
        seen_s = {i.id: (i.first_seen_s, i.last_seen_s) for i in scene.store.instances.all()}
    truth, estimate = read_tum(folder / "groundtruth.txt"), read_tum(folder / f"{mode}.txt")
    errors = evaluate_trajectory(truth, estimate)
    S_truth_scene = alignment_of(truth, estimate, with_scale=False)
    scene_json, truth_json = read_scene(folder / f"{mode}.json"), read_scene(folder / "truth.json")
    scores = evaluate_scene(scene_json, truth_json, S_truth_scene)
    extra: dict[str, Any] = in_their_places(scene_json, truth_json, truth, parts, (component_of, seen_s))
    if len(parts) > 1:
        figures, scene_json = in_parts(scene_json, truth_json, truth, parts, component_of)
        extra |= figures
        scores, S_truth_scene_json = evaluate_scene(scene_json, truth_json), Sim3.identity()
    else:
        S_truth_scene_json = S_truth_scene
    tilt = np.degrees(np.arccos(np.clip(S_truth_scene.rotation[2, 2], -1.0, 1.0)))
    row = {"ate_cm": round(100 * errors.ate_se3_m.rmse, 2), "posed": errors.pairs, "tilt_deg": round(float(tilt), 2)}
    row |= {"frames": len(truth.time_s), "components": len(parts)} | blind_errors(
        folder, truth, estimate, S_truth_scene
    )
    for overlap in ("0.25", "0.50"):
        found = scores[f"instances_{overlap}"]
        row |= {f"recall_{overlap}": found["recall"], f"precision_{overlap}": found["precision"]}
    row["duplicates"] = scores["instances_0.25"]["duplicates"]
    row["center_cm"] = round(100 * scores["instances_0.25"]["mean_center_error_m"], 2)
    row["nearest_cm"] = round(100 * nearest_m(scene_json, truth_json, scores, S_truth_scene_json), 2)
    row["twice"] = found_twice(scene_json, truth_json, S_truth_scene_json)
    for name in ("recall", "precision"):
        row |= {f"main_{name}_0.25": row[f"{name}_0.25"], f"main_{name}_0.50": row[f"{name}_0.50"]}
    row |= {"part_ate_cm": row["ate_cm"], "posed_all": row["posed"]} | extra
    return row | ({} if wall_s is None else {"wall_s": wall_s})


def paths_of_parts(scene: list3r.SceneMemory) -> dict[int, Trajectory]:
    """Return the camera's path in each part that has a frame of reference of its own, the longest first."""
    paths = {}
    for part in read_components(scene.store):
        poses = sorted(((frame.time_s, S) for frame, S in part.poses), key=lambda row: row[0])
        T = np.tile(np.eye(4), (len(poses), 1, 1))
        for k, (_, S) in enumerate(poses):
            T[k, :3, :3], T[k, :3, 3] = S.rotation, S.translation
        paths[part.id] = Trajectory(np.array([t for t, _ in poses]), T)
    return paths


def in_parts(
    scene: Mapping[str, Any],
    truth_json: Mapping[str, Any],
    truth: Trajectory,
    parts: Mapping[int, Trajectory],
    component_of: Mapping[int, int],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Align each part with the truth by its own cameras. Return figures of the largest and of all, and the aligned
    scene. Parts of fewer than three poses cannot be aligned and are left out.
    """
    laid, off, main = [], [], None
    for number, path in parts.items():
        here = [row for row in scene["instances"] if component_of[int(row["id"])] == number]
        if main is None:
            S = alignment_of(truth, path, with_scale=False)
            main = evaluate_scene({**scene, "instances": here}, truth_json, S)
        if len(path.time_s) < 3:
            continue
        S = alignment_of(truth, path, with_scale=False)
        laid += [moved(row, S) for row in here]
        at, k = associate(truth.time_s, path.time_s)
        off.append(S.apply(path.positions()[k]) - truth.positions()[at])
    assert main is not None
    figures: dict[str, Any] = {}
    for overlap in ("0.25", "0.50"):
        found = main[f"instances_{overlap}"]
        figures |= {f"main_recall_{overlap}": found["recall"], f"main_precision_{overlap}": found["precision"]}
    squares = np.sum(np.concatenate(off) ** 2, axis=1)
    figures |= {"part_ate_cm": round(100 * float(np.sqrt(squares.mean())), 2), "posed_all": len(squares)}
    return figures, {**scene, "instances": laid}


def in_their_places(
    scene: Mapping[str, Any],
    truth_json: Mapping[str, Any],
    truth: Trajectory,
    parts: Mapping[int, Trajectory],
    known: tuple[Mapping[int, int], Mapping[int, tuple[float, float]]],
) -> dict[str, Any]:
    """Score instances, each aligned with the truth by the cameras of its time.

    `known`: the part, and the first and last second of each instance. At least 20 poses align one.
    """
    (component_of, seen_s), laid = known, []
    for row in scene["instances"]:
        number = int(row["id"])
        path, (first_s, last_s) = parts[component_of[number]], seen_s[number]
        away = np.maximum(first_s - path.time_s, path.time_s - last_s)
        near = np.flatnonzero((away <= 0) | (away <= np.sort(away)[min(20, len(away)) - 1]))
        if len(near) >= 3:
            laid.append(moved(row, alignment_of(truth, path.at(near), with_scale=False)))
    found = evaluate_scene({**scene, "instances": laid}, truth_json)
    figures = {"near_duplicates": found["instances_0.25"]["duplicates"]}
    for overlap in ("0.25", "0.50"):
        score = found[f"instances_{overlap}"]
        figures |= {f"near_recall_{overlap}": score["recall"], f"near_precision_{overlap}": score["precision"]}
    return figures


def moved(row: Mapping[str, Any], S_truth_scene: Sim3) -> dict[str, Any]:
    """Return an instance of a scene with its box moved."""
    box = row["box"]
    turned = S_truth_scene.rotation @ rotation_from_quat_wxyz(np.array(box["quat_wxyz"], dtype=np.float64))
    center = S_truth_scene.apply(np.array([box["center"]], dtype=np.float64))[0]
    quat = quat_wxyz_from_rotation(turned[None])[0]
    return {**row, "box": {**box, "center": center.tolist(), "quat_wxyz": quat.tolist()}}


def found_twice(scene: Mapping[str, Any], truth: Mapping[str, Any], S_truth_scene: Sim3, reach_m: float = 0.3) -> int:
    """Return how many true objects are the nearest one, within reach, of the centres of two or more instances."""
    true = np.array([box.center for box in scene_boxes(truth).values()])
    found = np.array([box.center for box in scene_boxes(scene, S_truth_scene).values()]).reshape(-1, 3)
    away = np.linalg.norm(found[:, None] - true[None], axis=2)
    nearest = away.argmin(axis=1)[away.min(axis=1) < reach_m]
    return int((np.bincount(nearest, minlength=len(true)) > 1).sum())


def blind_errors(folder: Path, truth: Trajectory, estimate: Trajectory, S_truth_scene: Sim3) -> dict[str, Any]:
    """Return how many frames of the blind stretches have a pose, and their error."""
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
    """Median distance from the centre of a true object that was seen to the nearest one of an instance, metres."""
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
