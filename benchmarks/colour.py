"""Simulated walks given as colour pictures alone: trajectory, depth, instances and relations against the truth.

    python benchmarks/colour.py --seeds 31,32,33 --keep FOLDER --json benchmarks/results/colour.json
    PYTHONPATH=. python benchmarks/colour.py --rooms --seeds 6201,6202 --json benchmarks/results/colour-rooms.json

Each walk (two furnished rooms, 640x480, filmed at 12 frames a second) becomes a folder of its colour pictures, and
`list3r build FOLDER --reconstruction sfm --intrinsics ...` a memory. `blank` is the share of 7 px windows, at 320 px
width, with a deviation below 2.5 grey levels: 0.20 in redkitchen. Objects are matched one to one, by masks in every
tenth frame and by boxes after Sim(3) alignment of the cameras; `false_on_...` classifies objects without a match by the
surface they are on. `things_scale` is the scale of the world by the centres of objects matched at IoU 0.5, over that by
the cameras. Relations are those among objects matched by masks. Walks and reconstructions in `--keep` are reused, and
the time is that of the rest. With `--rooms` the walks are 300 frames of left-out rooms of `training/worlds`, with a
camera that turns on the spot; their relations are not known. With `--step METRES` they are those of `wide_walks.py`,
with its figures.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from kept import read_kept
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray
from wide_walks import compare_walks

from list3r.api import open as open_memory
from list3r.evaluation.instances import match_boxes
from list3r.evaluation.scene import evaluate_scene, read_scene, relations_of_matches, scene_boxes
from list3r.evaluation.trajectory import Trajectory, align, position_errors, read_tum, write_tum
from list3r.memory.core.geometry import Sim3, umeyama
from list3r.memory.core.masks import decode_mask
from list3r.memory.store.store import Store
from list3r.simulation.dataset import DEPTH_UNITS_PER_M, WalkSettings, write_walk

SIZE = (640, 480)
EVERY = 10
"""Frames between two frames with compared masks."""
STEP = 4
"""Every so many pixels of a mask are compared."""
ROOM_FRAMES = 300
"""Frames of a walk through a left-out room."""
LEAST_PX = 150
"""True objects that never cover so many pixels count neither way."""

Masks = dict[int, dict[int, NDArray[np.bool_]]]
"""By frame and id, thinned by `STEP`."""


@dataclass(frozen=True)
class Overlaps:
    """How the masks of T true and E found instances overlap over all compared frames, px of the thinned masks."""

    true_ids: list[int]
    ids: list[int]
    shared: NDArray[np.int64]
    """Shape (T, E)."""
    true_px: NDArray[np.int64]
    """Shape (T,)."""
    px: NDArray[np.int64]
    """Shape (E,)."""

    def iou(self) -> NDArray[np.float64]:
        """Shape (T, E)."""
        union = self.true_px[:, None] + self.px[None] - self.shared
        return np.asarray(self.shared / np.maximum(union, 1), np.float64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="31,32,33")
    parser.add_argument("--rooms", action="store_true", help="left-out rooms of training/worlds")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--discovery", default="", help="such as learned,sam2; without it the default")
    parser.add_argument("--keep", type=Path, help="folder in which walks, reconstructions and memories are kept")
    parser.add_argument("--step", type=float, help="walks in steps so wide, metres, compared with plain pycolmap")
    parser.add_argument("--hard", action="store_true", help="... with wider turns, and through door frames")
    parser.add_argument("--frames", type=int, help="of each walk; without it 150 of such walks, else all")
    parser.add_argument("--real", type=Path, help="... and of every eighth frame of this folder with poses")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.step is not None:
        args.frames = args.frames or 150
        compare_walks(args)
        return
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        root = args.keep or Path(scratch)
        for seed, method in ((int(w), m) for w in args.seeds.split(",") for m in args.discovery.split(",")):
            folder = root / f"{'room' if args.rooms else 'seed'}-{seed}"
            figures = measured(folder, seed, args.workers, method, args.frames, rooms=args.rooms)
            rows.append({"seed": seed, "discovery": method or "default", **figures})
            print("  ".join(f"{k} {v}" for k, v in rows[-1].items()), flush=True)
            write_json(args.json, {"mean": means_of(rows), "seeds": rows})
    print(machine())
    for key, value in means_of(rows).items():
        print(f"{key:24} {value}")


def means_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Over the walks; by discoverer where there are several."""
    methods = dict.fromkeys(r["discovery"] for r in rows)
    each = {m: means([r for r in rows if r["discovery"] == m]) for m in methods}
    return each if len(each) > 1 else means(rows)


def means(rows: list[dict[str, Any]]) -> dict[str, float | None]:
    """Over the walks that have a figure."""
    known = {k: [r[k] for r in rows if r[k] is not None] for k in rows[0] if k not in ("seed", "discovery")}
    return {k: round(statistics.fmean(values), 4) if values else None for k, values in known.items()}


def measured(
    folder: Path, seed: int, workers: int, discovery: str = "", frames: int | None = None, *, rooms: bool = False
) -> dict[str, Any]:
    """The figures of one walk, which is filmed, built and compared in `folder`; of its first `frames` alone."""
    settings = WalkSettings(seed=seed, size=SIZE, write_ids=True, frames=frames)
    walk = folder / "walk"
    if not (walk / "truth.json").exists():
        if rooms:
            film_room(walk, seed, frames or ROOM_FRAMES)
        else:
            write_walk(walk, settings, workers)
    colour = colour_only(folder / "colour", walk)
    camera = settings.camera()
    intrinsics = ",".join(f"{v:g}" for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    if rooms:
        intrinsics = ",".join((walk / "calibration.txt").read_text().split())
    memory, depths = folder / f"memory{discovery}.l3r", folder / "reconstructions"
    words = ["build", str(colour), "-m", str(memory), "--force", "--reconstruction", "sfm", "--intrinsics", intrinsics]
    words += ["--discovery", discovery] if discovery else []
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    report, usage = run_list3r(*words, "--workers", str(workers), kept=depths)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    row = {"frames": report["frames"], "posed": report["posed"], **usage, "cpu_s": round(spent, 1)}
    row["blank"] = blank_share(colour)
    row |= depth_errors(depths, walk) | scene_errors(memory, walk)
    return {k: v for k, v in row.items() if not (rooms and k.startswith(("on_", "in_", "next_to_")))}


def film_room(walk: Path, seed: int, frames: int) -> None:
    """Film a left-out room; every second one has surfaces that are worn and printed, and exposure that changes."""
    from discovery_memory import write_film

    from training.worlds.film import FilmSettings, make_film

    of = FilmSettings(seed, held_out=True, frames=frames, every=1, size=SIZE, sensor="structured", looks=seed % 2 == 0)
    film = make_film(of)
    write_film(walk, film, seed)
    write_tum(walk / "groundtruth.txt", Trajectory(film.time_s, film.T_world_cam))


def colour_only(folder: Path, walk: Path) -> Path:
    """A folder of links to the colour pictures, in order."""
    folder.mkdir(exist_ok=True)
    for path in sorted((walk / "rgb").iterdir()):
        link = folder / path.name
        if not link.exists():
            link.symlink_to(path.resolve())
    return folder


def blank_share(colour: Path) -> float:
    """Share of small windows without texture, over every twentieth picture."""
    shares = []
    for path in sorted(colour.iterdir())[::20]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        gray = cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA).astype(np.float32)
        variance = cv2.blur(gray * gray, (7, 7)) - cv2.blur(gray, (7, 7)) ** 2
        shares.append(float((variance < 2.5**2).mean()))
    return round(float(np.mean(shares)), 3)


def depth_errors(reconstructions: Path, walk: Path) -> dict[str, float]:
    """Share of pixels with depth and errors after one scale for each chunk, on every third pixel."""
    known, ratios = [], []
    for path in sorted(reconstructions.glob("*.npz")):
        for part in read_kept(path):
            rows = np.flatnonzero(part.posed)[::5]
            frames = part.frame_indices[rows].tolist()
            pictures = [cv2.imread(str(walk / "depth" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED) for k in frames]
            truth = np.stack([p for p in pictures if p is not None])[:, 1::3, 1::3] / DEPTH_UNITS_PER_M
            depth = part.depth[rows][:, 1::3, 1::3]
            both = (depth > 0) & (truth > 0)
            known.append((depth > 0).mean(axis=(1, 2)))
            ratio = depth[both] / truth[both]
            ratios.append(np.abs(ratio / np.median(ratio) - 1.0))
    error = np.concatenate(ratios)
    return {
        "depth_coverage": round(float(np.concatenate(known).mean()), 4),
        "depth_median_error": round(float(np.median(error)), 4),
        "depth_above_10_percent": round(float((error > 0.1).mean()), 4),
    }


def scene_errors(memory: Path, walk: Path) -> dict[str, Any]:
    """Trajectory, objects and relations of a memory."""
    true_scene = read_scene(walk / "truth.json")
    exported = memory.with_suffix(".json")
    with open_memory(memory) as opened:
        opened.export("json", str(exported))
    scene = read_scene(exported)
    S_truth_world, ate = _alignment(memory, walk)
    frames = range(0, len(list((walk / "rgb").iterdir())), EVERY)
    overlaps = compare_masks(true_masks(walk, frames), memory_masks(memory, frames))
    boxes = evaluate_scene(scene, true_scene, S_truth_world)
    by_masks, found = _by_masks(overlaps, scene, true_scene)
    out = {"ate_sim3_m": round(ate, 4), "things_scale": _objects_scale(scene, true_scene, found, S_truth_world)}
    out |= by_masks
    for name in ("0.25", "0.50"):
        entry = boxes[f"instances_{name}"]
        out[f"box_recall_{name}"] = round(entry["recall"], 3)
        out[f"box_precision_{name}"] = round(entry["precision"], 3)
    return out


def _alignment(memory: Path, walk: Path) -> tuple[Sim3, float]:
    """From the memory's world to the truth's, and the RMS distance of the cameras, metres."""
    truth = read_tum(walk / "groundtruth.txt")
    with Store.open(memory) as store:
        poses = {f.frame_index: S for f, S in store.trajectory.poses()}
    rows = np.array(sorted(poses))
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    for k, row in enumerate(rows.tolist()):
        T[k, :3, :3], T[k, :3, 3] = poses[row].rotation, poses[row].translation
    true, estimate = truth.at(rows), Trajectory(truth.time_s[rows], T)
    S = align(true, estimate, with_scale=True)
    return S, float(np.sqrt(np.square(position_errors(true, estimate, S)).mean()))


def _objects_scale(
    scene: Mapping[str, Any], truth: Mapping[str, Any], found: list[tuple[int, int, float]], S_truth_world: Sim3
) -> float | None:
    """Scale from the memory's world to the truth's by the middles of objects, over that by the cameras."""
    boxes, true_boxes = scene_boxes(scene), scene_boxes(truth)
    pairs = [(boxes[e].center, true_boxes[t].center) for t, e, iou in found if iou >= 0.5]
    if len(pairs) < 4:
        return None
    ours, theirs = (np.array(side) for side in zip(*pairs, strict=True))
    return round(float(umeyama(ours, theirs, with_scale=True).scale / S_truth_world.scale), 3)


def true_masks(walk: Path, frames: range) -> Masks:
    """True objects and their masks."""
    out: Masks = {}
    for frame in frames:
        ids = cv2.imread(str(walk / "ids" / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert ids is not None
        thin = ids[::STEP, ::STEP]
        out[frame] = {int(k): thin == k for k in np.unique(thin) if k > 0}
    return out


def memory_masks(memory: Path, frames: range) -> Masks:
    """Instances of a memory and their masks, all chunks together."""
    out: Masks = {frame: {} for frame in frames}
    with Store.open(memory) as store:
        present = {i.id for i in store.instances.all()}
        for seen in store.observations.all():
            track = store.local_instances.mask_track(seen.chunk_id, seen.local_id)
            for frame, runs in zip(track.frames.tolist(), track.masks, strict=True):
                if frame in out and seen.instance_id in present:
                    mask = decode_mask(runs, track.image_size)[::STEP, ::STEP]
                    before = out[frame].get(seen.instance_id)
                    out[frame][seen.instance_id] = mask if before is None else before | mask
    return out


def compare_masks(truth: Masks, found: Masks) -> Overlaps:
    """Areas and shared areas over all frames."""
    true_ids = sorted({k for frame in truth.values() for k in frame})
    ids = sorted({k for frame in found.values() for k in frame})
    row, column = ({k: n for n, k in enumerate(each)} for each in (true_ids, ids))
    shared = np.zeros((len(true_ids), len(ids)), np.int64)
    true_px, px = np.zeros(len(true_ids), np.int64), np.zeros(len(ids), np.int64)
    for frame, objects in truth.items():
        for t, mask in objects.items():
            true_px[row[t]] += mask.sum()
        for e, other in found[frame].items():
            px[column[e]] += other.sum()
            for t, mask in objects.items():
                shared[row[t], column[e]] += (mask & other).sum()
    return Overlaps(true_ids, ids, shared, true_px, px)


def _by_masks(
    overlaps: Overlaps, scene: Mapping[str, Any], truth: Mapping[str, Any]
) -> tuple[dict[str, Any], list[tuple[int, int, float]]]:
    """Recall and precision of objects by masks, the surfaces under false ones, relations of the true ones; and the
    pairs (true id, id, IoU) at IoU 0.25.
    """
    wanted = {e["id"] for e in truth["instances"] if not e["structure"] and e["largest_px"] >= LEAST_PX}
    objects = {e["id"] for e in scene["instances"] if not e["structure"] and e.get("state") != "removed"}
    rows = [n for n, k in enumerate(overlaps.true_ids) if k in wanted]
    columns = [n for n, k in enumerate(overlaps.ids) if k in objects and overlaps.px[n] > 0]
    iou = overlaps.iou()[np.ix_(rows, columns)]
    out: dict[str, Any] = {"things": len(columns), "true_things": len(rows)}
    pairs: list[tuple[int, int]] = []
    for threshold in (0.5, 0.25):
        pairs = match_boxes(iou, threshold)
        out[f"mask_recall_{threshold:.2f}"] = round(len(pairs) / max(len(rows), 1), 3)
        out[f"mask_precision_{threshold:.2f}"] = round(len(pairs) / max(len(columns), 1), 3)
    found = [(overlaps.true_ids[rows[r]], overlaps.ids[columns[c]], float(iou[r, c])) for r, c in pairs]
    out |= _false_objects(overlaps, columns, found, truth)
    judged = relations_of_matches(scene, truth, found).by_predicate
    for name, entry in judged.items():
        out[f"{name}_recall"], out[f"{name}_precision"] = (
            None if v is None else round(v, 3) for v in (entry.recall, entry.precision)
        )
    return out, found


def _false_objects(
    overlaps: Overlaps, columns: list[int], found: list[tuple[int, int, float]], truth: Mapping[str, Any]
) -> dict[str, int]:
    """Numbers of unmatched objects mostly on structure, on a found object, and on a missed one."""
    structure = {e["id"] for e in truth["instances"] if e["structure"]}
    matched, known = {e for _, e, _ in found}, {t for t, _, _ in found}
    out = {"false_on_structure": 0, "false_on_found": 0, "false_on_missed": 0}
    for column in columns:
        if overlaps.ids[column] not in matched:
            below = overlaps.true_ids[int(overlaps.shared[:, column].argmax())]
            place = "structure" if below in structure else "found" if below in known else "missed"
            out[f"false_on_{place}"] += 1
    return out


if __name__ == "__main__":
    main()
