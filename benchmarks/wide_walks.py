"""Colour walks in wide steps, as in phones' exports of 2 to 4 frames a second: ours compared with plain pycolmap.

    python benchmarks/colour.py --step 0.08 --seeds 31,32,33,34,35 --real ../shared/data/redkitchen --json FILE

Each simulated walk goes to and fro between two rooms and films them from a new place each time; a frame is kept after
each step: 8 cm or 4 degrees, whichever comes first (`--hard`: 6 degrees, and the camera touches door frames, as in
research/colour-video 0074). The real one is every eighth frame of a folder with poses. Both programs get the same
pictures and focal length (plain pycolmap: `benchmarks/sfm.py`). `cpu_s_a_frame` is that of all processes of the
program; with two idle cores a frame takes half of it or little more. In `--keep` each program's result of a walk is
cached, ours by its commit.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from machine import STARTED_AT, machine, write_json
from sfm import built, colour_only, plain_pycolmap, read_truth

from benchmarks.simulation.wide_steps import WideStepWalk
from list3r.evaluation.trajectory import Trajectory, read_tum
from list3r.simulation.dataset import write_walk

SIZE = (540, 360)
HARD = {"step_deg": 6.0, "clear_m": 0.0}
REAL_EVERY = 8
REAL_INTRINSICS = "525,525,320,240"
"""Of the colour camera of 7-Scenes."""


def compare_walks(args: argparse.Namespace) -> None:
    """Film, build and compare the walks of some seeds, and a real one."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        root = args.keep or Path(scratch)
        for seed in [int(word) for word in args.seeds.split(",") if word]:
            walk = WideStepWalk(
                seed=seed, frames=args.frames, size=SIZE, step_m=args.step, **(HARD if args.hard else {})
            )
            folder = root / f"{'hard' if args.hard else 'wide'}-{seed}-{args.frames}"
            rows.append({"walk": f"seed {seed}", **_simulated(folder, walk, args)})
            _report(rows, args)
        if args.real is not None:
            rows.append({"walk": f"{args.real.name}, every {REAL_EVERY}th", **_real(root / "wide-real", args)})
            _report(rows, args)
    print(machine())


def _report(rows: list[dict[str, Any]], args: argparse.Namespace) -> None:
    print("  ".join(f"{k} {v}" for k, v in rows[-1].items()), flush=True)
    said = {"step_m": args.step, "hard": args.hard, "frames": args.frames, "size": SIZE}
    write_json(args.json, {**said, "walks": rows})


def _simulated(folder: Path, walk: WideStepWalk, args: argparse.Namespace) -> dict[str, Any]:
    if not (folder / "walk" / "truth.json").exists():
        write_walk(folder / "walk", walk, args.workers)
    poses = read_tum(folder / "walk" / "groundtruth.txt").T_world_cam
    camera = walk.camera()
    intrinsics = ",".join(f"{v:g}" for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    return _compared(folder, sorted((folder / "walk" / "rgb").iterdir()), poses, intrinsics, args)


def _real(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    truth, names = read_truth(args.real, None)
    assert len(names) == len(truth.time_s), "every picture needs a pose"
    kept = slice(None, None, REAL_EVERY)
    return _compared(folder, names[kept], truth.T_world_cam[kept], REAL_INTRINSICS, args)


def _compared(
    folder: Path, names: list[Path], T_world_cam: Any, intrinsics: str, args: argparse.Namespace
) -> dict[str, Any]:
    """The figures of both programs on the same pictures, in order, with their true poses (F, 4, 4)."""
    truth = Trajectory(np.arange(len(names)) / 30.0, T_world_cam)
    path_m = float(np.linalg.norm(np.diff(truth.positions(), axis=0), axis=1).sum())
    with tempfile.TemporaryDirectory() as scratch:
        pictures = colour_only(Path(scratch) / "colour", names)
        memory = folder / "memory.l3r"
        folder.mkdir(parents=True, exist_ok=True)
        options = ["--force", "--workers", str(args.workers), "--intrinsics", intrinsics]
        plain = _noted(folder / "plain.json", lambda: plain_pycolmap(pictures, Path(scratch), intrinsics, truth))
        ours = _noted(folder / f"ours-{STARTED_AT}.json", lambda: built(pictures, memory, options, truth))
    ours["cpu_s_a_frame"] = round(ours["cpu_s"] / len(names), 3)
    return {
        "path_m": round(path_m, 2),
        "ate_of_path": round(ours["ate_sim3_m"] / path_m, 5),
        "ate_by_plain": round(ours["ate_sim3_m"] / plain["ate_sim3_m"], 3) if plain["posed"] == len(names) else None,
        "list3r": ours,
        "pycolmap": plain,
    }


def _noted(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the content of a file, or make and write it."""
    if not path.exists():
        path.write_text(json.dumps(make()))
    return dict(json.loads(path.read_text()))
