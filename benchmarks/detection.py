"""Names from a box detector on redkitchen, compared with its pictures.

    python benchmarks/detection.py --source PATH --detectors A.param B.param [--reconstruction rgbd sfm]
                                   [--memory FILE ...] [--json FILE]

A memory is built of the whole video (or taken from `--memory`) and named by each detector, from the video and from the
kept pictures alone. The truth is hand-drawn boxes in single pictures: an object is named right when the instance with
the best fitting mask has its name. `others` are further objects of these names, `find` asks for "cup on dining table".
No wall may be a chair, as structure is never named.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from machine import run_list3r, write_json

import list3r
from list3r.memory.library.overlap.pair_scores import box_iou
from list3r.memory.store.store import Store

TRUTH: dict[str, tuple[str, int, tuple[int, int, int, int]]] = {
    "white mug": ("cup", 300, (56, 212, 106, 266)),
    "printed mug": ("cup", 300, (478, 282, 526, 336)),
    "table": ("dining table", 300, (2, 234, 594, 456)),
    "chair at the left": ("chair", 99, (384, 152, 582, 456)),
    "chair behind the magazines": ("chair", 312, (114, 160, 272, 218)),
    "chair behind the mug": ("chair", 307, (480, 184, 594, 252)),
    "chair at the right": ("chair", 416, (438, 230, 584, 456)),
    "chair in front": ("chair", 1, (320, 380, 588, 456)),
    "purple magazine": ("book", 300, (186, 304, 328, 410)),
}
"""Its name, the number of a picture, and its box in the depth camera's view there, px."""
NEAR = 2
"""Frames from that picture within which a mask counts: not every frame of colour video has masks."""
LEAST_OVERLAP = 0.3
"""IoU of a box with that of a mask."""


def instances_of(store: Store) -> dict[str, int | None]:
    """The instance that each true object is, None where the memory holds none."""
    home = {(o.chunk_id, o.local_id): o.instance_id for o in store.observations.all()}
    found: dict[str, int | None] = {}
    for name, (_, frame, box) in TRUTH.items():
        boxes: dict[tuple[int, int], np.ndarray] = {}
        for (chunk_id, local_id), instance in home.items():
            track = store.local_instances.mask_track(chunk_id, local_id)
            away = np.where(track.areas_px > 0, np.abs(track.frames - frame), NEAR + 1)
            at = np.flatnonzero(away == away.min(initial=NEAR + 1))
            if len(at) and away[at[0]] <= NEAR:
                one = track.boxes_xyxy[at[0]]
                other = boxes.get((chunk_id, instance), one)
                whole = np.concatenate([np.minimum(one[:2], other[:2]), np.maximum(one[2:], other[2:])])
                boxes[chunk_id, instance] = whole
        fits = {key: float(box_iou(np.array([box]), b[None])[0, 0]) for key, b in boxes.items()}
        best = max(fits, key=lambda key: fits[key], default=None)
        found[name] = best[1] if best is not None and fits[best] >= LEAST_OVERLAP else None
    return found


def judged(path: Path) -> dict[str, Any]:
    """Names of the true objects, and other instances of these names."""
    with Store.open(path) as store:
        home = instances_of(store)
        objects = {i.id: i for i in store.instances.all(structure=None)}
        wanted = {name: TRUTH[name][0] for name in TRUTH}
        said = {name: None if home[name] is None else objects[home[name]].label for name in TRUTH}
        others: dict[str, int] = {}
        for i in objects.values():
            if i.label is not None and i.id not in home.values():
                others[i.label] = others.get(i.label, 0) + 1
        poses = store.facts.poses
        structure = sum(i.label is not None for i in objects.values() if i.structure is not None)
    with list3r.open(path) as memory:
        first = {match.instance.id for match in memory.find("cup on dining table")[:2]}
    mugs = {home["white mug"], home["printed mug"]}
    return {
        "poses": poses,
        "right": sum(said[n] == wanted[n] for n in TRUTH),
        "of": len(TRUTH),
        "chairs": sum(said[n] == "chair" for n in TRUTH if wanted[n] == "chair"),
        "called": said,
        "others": dict(sorted(others.items())),
        "structure_named": structure,
        "find_mugs_first": first == mugs,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", required=True, help="the folder redkitchen")
    parser.add_argument("--detectors", nargs="+", required=True, type=Path)
    parser.add_argument("--reconstruction", nargs="+", default=["rgbd"])
    parser.add_argument("--memory", nargs="*", default=[], type=Path, help="built before, one for each reconstruction")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder) / "work.l3r"
        for k, kind in enumerate(chosen.reconstruction):
            built = chosen.memory[k] if k < len(chosen.memory) else Path(folder) / f"{kind}.l3r"
            if k >= len(chosen.memory):
                run_list3r("build", chosen.source, "-m", str(built), "--reconstruction", kind)
            for detector in chosen.detectors:
                for using in ("video", "pictures"):
                    shutil.copy(built, work)
                    where = ["--source", chosen.source] if using == "video" else []
                    said, _ = run_list3r("detect", str(work), "--detector", str(detector), *where)
                    row = {"reconstruction": kind, "detector": detector.stem, "looks": using, "frames": said["frames"]}
                    rows.append({**row, **judged(work)})
                    print({k: v for k, v in rows[-1].items() if k != "called"}, flush=True)
    if chosen.json:
        write_json(chosen.json, {"rows": rows})


if __name__ == "__main__":
    main()
