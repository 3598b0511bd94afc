"""Rooms of simulated homes against the truth: found, doorways, things in the right room, ids over two sessions.

python benchmarks/rooms.py --seeds 901-906 --keep FOLDER --json benchmarks/results/rooms.json

Homes of four to eight rooms (preset `loop`), every fourth frame of the walk, built with given poses. A true room counts
where the camera stood in it. A found room that is not partial is right where it has an area IoU of at least 0.5 with a
true one, each used once. Doorways count between two rooms in both of which the camera stood, and are found within
0.5 m. Things are instances whose middle lies in a true room that was found, in the room or not. `kept` is the share of
rooms found in both sessions, the second of other frames of the way, that have the same id.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, run_list3r, write_json
from numpy.typing import NDArray

import list3r
from benchmarks.simulation.buildings import PlacedRoom
from benchmarks.simulation.presets import make_shot
from benchmarks.simulation.walks import PresetWalk
from list3r.memory.core.records import Room
from list3r.memory.library.rooms.outline import encloses
from list3r.simulation.dataset import write_walk

FOUND_IOU, DOOR_M = 0.5, 0.5


@dataclass(frozen=True)
class EveryNth(PresetWalk):
    """Some frames of a walk."""

    first: int = 0
    step: int = 4

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Seconds (F,) and T_world_cam (F, 4, 4) of the frames to be written."""
        time_s, poses = super().poses()
        return time_s[self.first :: self.step], poses[self.first :: self.step]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="901-906", help="first-last")
    parser.add_argument("--twice", type=int, default=2, help="so many homes have a second session")
    parser.add_argument("--keep", type=Path, help="folder in which walks and memories are kept")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split("-"))
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for n, seed in enumerate(range(first, last + 1)):
            folder = (args.keep or Path(scratch)) / f"home-{seed}"
            rows.append({"seed": seed} | measured(seed, folder, twice=n < args.twice))
            print(json.dumps(rows[-1]), flush=True)
    total = {k: sum(r.get(k, 0) for r in rows) for k in rows[0] if isinstance(rows[0][k], int) and k != "seed"}
    share = {
        "recall": total["matched"] / total["true_rooms"],
        "precision": total["matched"] / total["whole_rooms"],
        "doorways_found": total["doors_found"] / total["true_doors"],
        "things_right": total["things_right"] / total["things"],
        "ids_kept": sum(r.get("kept", 0) for r in rows) / max(sum(r.get("both", 0) for r in rows), 1),
    }
    print(machine(), share)
    write_json(args.json, {"share": share, "total": total, "homes": rows})


def measured(seed: int, folder: Path, *, twice: bool) -> dict[str, Any]:
    """Build the memory of a home where there is none, and hold its rooms against the truth."""
    memory = folder / "one.l3r"
    if not memory.exists():
        write_walk(folder / "walk", EveryNth(seed=seed, preset="loop"))
        run_list3r("build", str(folder / "walk"), "-m", str(memory), "--poses", "given", "--workers", "1")
    with list3r.open(memory) as scene:
        rooms, row = scene.rooms(), against_truth(scene, seed)
    if twice:
        later = folder / "two.l3r"
        if not later.exists():
            later.write_bytes(memory.read_bytes())
            write_walk(folder / "second", EveryNth(seed=seed, preset="loop", walk_seed=seed + 1, first=2, step=8))
            run_list3r("update", str(later), str(folder / "second"), "--poses", "given", "--workers", "1")
        with list3r.open(later) as scene:
            row |= ids_kept(rooms, scene.rooms())
    return row


def against_truth(scene: list3r.SceneMemory, seed: int) -> dict[str, Any]:
    """Return counts of rooms, doorways and things, found and true."""
    shot = make_shot("loop", seed)
    cameras = shot.T_world_cam[:, :2, 3]
    entered = [r for r in shot.building.rooms() if any(r.contains(x, y) for x, y in cameras)]
    rooms, doorways = scene.rooms(), scene.doorways()
    ious = np.array([[iou(r.outline, corners(t)) for t in entered] for r in rooms]).reshape(len(rooms), len(entered))
    pairs = {}
    for k in np.argsort(-ious, axis=None).tolist():
        a, b = divmod(k, len(entered))
        if ious[a, b] >= FOUND_IOU and a not in pairs and b not in pairs.values():
            pairs[a] = b
    true_doors = {
        door for n, r in enumerate(entered) for door in r.doorways for other in entered[n + 1 :] if beside(door, other)
    }
    found = sum(any(np.hypot(*(d.position[:2] - door)) <= DOOR_M for d in doorways) for door in true_doors)
    home = {n: r for r in rooms for n in r.instances}
    right = things = 0
    for i in scene.instances():
        for a, b in pairs.items():
            if entered[b].contains(*i.center[:2]):
                things += 1
                right += i.id in home and home[i.id].id == rooms[a].id
    return {
        "true_rooms": len(entered),
        "whole_rooms": sum(not r.partial or a in pairs for a, r in enumerate(rooms)),
        "partial_rooms": sum(bool(r.partial) and a not in pairs for a, r in enumerate(rooms)),
        "matched": len(pairs),
        "true_doors": len(true_doors),
        "doors_found": found,
        "things": things,
        "things_right": right,
    }


def corners(room: PlacedRoom) -> NDArray[np.float64]:
    """Return the corners of a true room."""
    return np.array([[room.x0, room.y0], [room.x1, room.y0], [room.x1, room.y1], [room.x0, room.y1]])


def beside(door: tuple[float, float], room: PlacedRoom) -> bool:
    """Return whether a doorway leads into a room, too."""
    x, y = door
    return room.x0 - 0.2 <= x <= room.x1 + 0.2 and room.y0 - 0.2 <= y <= room.y1 + 0.2


def iou(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the intersection over union of two polygons, by cells of 5 cm."""
    low, high = np.minimum(a.min(0), b.min(0)), np.maximum(a.max(0), b.max(0))
    axes = [np.arange(lo, hi, 0.05) + 0.025 for lo, hi in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    one, two = encloses(a, places), encloses(b, places)
    return float((one & two).sum() / max((one | two).sum(), 1))


def ids_kept(before: Sequence[Room], after: Sequence[Room]) -> dict[str, int]:
    """Return how many rooms are in both sessions, and of how many of these the id is the same."""
    both = [(a.id, b.id) for a in before for b in after if iou(a.outline, b.outline) >= FOUND_IOU]
    return {"both": len(both), "kept": sum(a == b for a, b in both)}


if __name__ == "__main__":
    main()
