"""Whole memories of left-out walks: objects after tracking and merging over chunks.

PYTHONPATH=. python benchmarks/discovery_memory.py --seeds 5101-5103 --keep FOLDER --json FILE
PYTHONPATH=. python benchmarks/discovery_memory.py --house FOLDER/aws-robomaker-small-house-world --seeds 1-3
PYTHONPATH=. python benchmarks/discovery_memory.py --seeds 5121-5126 --frames 450

The worlds and the house are those of `discovery.py`, every frame filmed, so that a walk of 150 frames is two chunks and
one of 450 six; poses are given, with a drift of some millimetres; memory and truth are aligned by all cameras. An
object counts from 150 pixels with depth in a view, and its true box is that of its surface with depth in some view.
`split` and `joined` are measured by masks: pairs of listed instances mostly on one true object, and pairs of true
objects with half of each in one instance, both per true object.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from colour import Overlaps, compare_masks, memory_masks, true_masks
from discovery import MIN_PX, gathered_boxes, seeds_of
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray

from list3r.api import open as open_memory
from list3r.evaluation.instances import match_boxes
from list3r.evaluation.scene import alignment_of, evaluate_scene, read_scene
from list3r.evaluation.trajectory import Trajectory, read_tum, write_tum
from list3r.memory.core.geometry import quat_wxyz_from_rotation
from list3r.memory.store.store import Store
from list3r.simulation.dataset import DEPTH_UNITS_PER_M, frame_name
from training.worlds.film import Film, FilmSettings, make_film, reconstruction_of

EVERY = 5
"""Frames between two frames with compared masks."""
SENSORS = ("structured", "lidar", "tof")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="5101-5103")
    parser.add_argument("--methods", default="learned")
    parser.add_argument("--house", type=Path)
    parser.add_argument("--fitted", action="store_true", help="rooms with built-in parts")
    parser.add_argument("--frames", type=int, default=150, help="of each walk")
    parser.add_argument("--keep", type=Path, help="folder in which walks are kept")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in seeds_of(args.seeds):
            kind = "house" if args.house else "fitted" if args.fitted else "world"
            walk = (args.keep or Path(scratch)) / f"{kind}-{seed}-{args.frames}"
            if not all((walk / name).exists() for name in ("cameras.txt", "truth.json")):
                write_film(walk, film_of(seed, args.house, args.frames, fitted=args.fitted), seed)
            for method in args.methods.split(","):
                rows.append({"method": method, "seed": seed, **measured(walk, method)})
                print(json.dumps(rows[-1]), flush=True)
    table = {m: summary([r for r in rows if r["method"] == m]) for m in dict.fromkeys(r["method"] for r in rows)}
    print(machine())
    for method, entry in table.items():
        print(method, json.dumps(entry))
    write_json(args.json, {"frames": args.frames, "mean": table, "walks": rows})


def film_of(seed: int, house: Path | None, frames: int, *, fitted: bool) -> Film:
    """The walk of a seed, all of its frames."""
    sensor = SENSORS[seed % 3]
    if house is not None:
        from training.worlds.gazebo import film_house

        return film_house(house, seed, sensor, frames, 1)
    return make_film(FilmSettings(seed, held_out=True, fitted=fitted, frames=frames, every=1, sensor=sensor))


def write_film(root: Path, film: Film, seed: int) -> None:
    """Write a film in the layout of `list3r demo`, its given poses off as in `reconstruction_of`."""
    for name in ("rgb", "depth", "ids"):
        (root / name).mkdir(parents=True, exist_ok=True)
    for k in range(len(film.time_s)):
        name = frame_name(k)
        cv2.imwrite(str(root / "rgb" / f"{name}.jpg"), film.color[k][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(str(root / "depth" / f"{name}.png"), np.rint(film.depth[k] * DEPTH_UNITS_PER_M).astype(np.uint16))
        cv2.imwrite(str(root / "ids" / f"{name}.png"), film.ids[k])
    for name, suffix in (("rgb", "jpg"), ("depth", "png")):
        lines = [f"{t:.6f} {name}/{frame_name(k)}.{suffix}" for k, t in enumerate(film.time_s.tolist())]
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
    c = film.camera
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx} {c.cy}\n")
    off = film.T_world_cam[0] @ reconstruction_of(film, seed=seed).T_chunk_cam
    write_tum(root / "groundtruth.txt", Trajectory(film.time_s, off))
    write_tum(root / "cameras.txt", Trajectory(film.time_s, film.T_world_cam))
    boxes, largest = true_boxes(film)
    entries = []
    for obj in film.things:
        entry: dict[str, Any] = {"id": obj.id, "label": obj.label, "structure": obj.structure}
        entry["largest_px"] = largest.get(obj.id, 0)
        if obj.id in boxes:
            box = boxes[obj.id]
            turn = quat_wxyz_from_rotation(box.rotation).tolist()
            entry["box"] = {"center": box.center.tolist(), "size": box.size.tolist(), "quat_wxyz": turn}
            entries.append(entry)
    (root / "truth.json").write_text(json.dumps({"instances": entries, "relations": []}))


def true_boxes(film: Film) -> tuple[dict[int, Any], dict[int, int]]:
    """The boxes by id of the surfaces of objects that have depth, and the pixels with depth of their largest views."""
    from list3r.reconstruction.base import backproject

    points: list[NDArray[np.float32]] = []
    ids: list[NDArray[np.int64]] = []
    largest: dict[int, int] = {}
    for k in range(0, len(film.time_s), 4):
        T, depth = film.T_world_cam[k], film.true_depth[k]
        points.append((backproject(depth, film.camera) @ T[:3, :3].T + T[:3, 3])[::2, ::2].astype(np.float32))
        seen = np.where(film.depth[k] > 0, film.ids[k], 0).astype(np.int64)
        ids.append(seen[::2, ::2] - 1)
        area = np.bincount(seen.ravel())
        for obj in np.flatnonzero(area).tolist():
            largest[obj] = max(largest.get(obj, 0), int(area[obj]))
    return {k + 1: box for k, box in gathered_boxes(points, ids).items()}, largest


def measured(walk: Path, method: str) -> dict[str, Any]:
    """The figures of one method on one walk."""
    memory = walk / f"{method}.l3r"
    words = ["build", str(walk), "-m", str(memory), "--force", "--poses", "given", "--discovery", method]
    _, usage = run_list3r(*words, "--workers", "1")
    exported = memory.with_suffix(".json")
    with open_memory(memory) as opened:
        opened.export("json", str(exported))
    scene, truth = read_scene(exported), read_scene(walk / "truth.json")
    with Store.open(memory) as store:
        poses = store.trajectory.poses()
        T = np.array([S.as_matrix() for _, S in poses])
        path = Trajectory(np.array([f.time_s for f, _ in poses]), T)
    S = alignment_of(read_tum(walk / "cameras.txt"), path, with_scale=False)
    found = evaluate_scene(scene, truth, S, MIN_PX)
    frames = range(0, len(list((walk / "rgb").iterdir())), EVERY)
    overlaps = compare_masks(true_masks(walk, frames), memory_masks(memory, frames))
    out: dict[str, Any] = {"true": found["instances_0.25"]["true_count"], **usage}
    for tag, name in (("0.25", "0.25"), ("0.5", "0.50")):
        entry = found[f"instances_{name}"]
        out |= {f"found_{tag}": entry["matched"], f"listed_{tag}": entry["estimated_count"]}
    out |= {"duplicates": found["instances_0.25"]["duplicates"], "merged": found["instances_0.25"]["merged_pairs"]}
    return out | by_masks(overlaps, scene, truth)


def by_masks(overlaps: Overlaps, scene: dict[str, Any], truth: dict[str, Any]) -> dict[str, int]:
    """Objects found by masks, and splits and joins."""
    free = {e["id"] for e in truth["instances"] if not e["structure"]}
    large = {e["id"] for e in truth["instances"] if not e["structure"] and e["largest_px"] >= MIN_PX}
    listed = {e["id"] for e in scene["instances"] if not e["structure"]}
    columns = [n for n, k in enumerate(overlaps.ids) if k in listed and overlaps.px[n] > 0]
    shared, iou = overlaps.shared[:, columns], overlaps.iou()[:, columns]
    most = shared.argmax(axis=0)
    of = np.array([overlaps.true_ids[r] for r in most.tolist()], np.int64)
    faint = np.array([k in free and k not in large for k in of.tolist()], bool)
    rows = [n for n, k in enumerate(overlaps.true_ids) if k in large]
    out = {}
    for tag, threshold in (("0.25", 0.25), ("0.5", 0.5)):
        out[f"mask_found_{tag}"] = len(match_boxes(iou[np.ix_(rows, np.flatnonzero(~faint))], threshold))
        out[f"mask_listed_{tag}"] = int((~faint).sum())
    counts = np.unique(of[np.isin(of, list(large))], return_counts=True)[1]
    held = shared[rows] > 0.5 * np.maximum(overlaps.true_px[rows], 1)[:, None]
    inside = held.sum(axis=0)
    out |= {"split": int((counts - 1).sum()), "joined": int((inside * (inside - 1) // 2).sum())}
    out["on_structure"] = int((~np.isin(of, list(free))).sum())
    return out


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures over all walks, each object counting the same."""
    total = lambda key: sum(int(r[key]) for r in rows)  # noqa: E731
    objects = max(total("true"), 1)
    out: dict[str, Any] = {"walks": len(rows), "things": total("true")}
    for tag in ("0.25", "0.5"):
        for kind in ("", "mask_"):
            out[f"{kind}recall_{tag}"] = round(total(f"{kind}found_{tag}") / objects, 3)
            out[f"{kind}precision_{tag}"] = round(total(f"{kind}found_{tag}") / max(total(f"{kind}listed_{tag}"), 1), 3)
    for key in ("duplicates", "merged", "split", "joined", "on_structure"):
        out[f"{key}_per_thing"] = round(total(key) / objects, 3)
    return out


if __name__ == "__main__":
    main()
