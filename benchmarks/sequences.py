"""The paper's real sequences: build, evaluate, and print its tables for data that are on your disk.

    python benchmarks/sequences.py tum --root /data/tum --json tum.json
    python benchmarks/sequences.py 7scenes --root /data/7scenes -- --reconstruction pi3 --device cuda
    python benchmarks/sequences.py nrgbd --root /data/nrgbd --list

docs/sequences.md has the source of each data set and the layout of its folders. Options after `--` go to `list3r
build`; without it depth is used where a sequence has it. Scenes that --root does not have are named and left out;
`--scene` (repeatable) takes other folders under it. ATE is after Sim(3) alignment as in the paper; RTE and RRE are the
relative errors over --delta, after the same scale. Clouds (ETH3D, NRGBD) are aligned with the truth by the camera's
path. Results in the JSON are not repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import STARTED_AT, machine, run_list3r, write_json


@dataclass(frozen=True)
class DataSet:
    """Sequences of one layout."""

    scenes: tuple[str, ...]
    """Scenes of the paper's tables, as patterns of folders under the root."""
    options: tuple[str, ...] = ()
    """Options that `build` needs because the files lack them."""
    clouds: bool = False
    """Whether the paper compares clouds."""


DATA_SETS = {
    "tum": DataSet(
        tuple(
            f"*{name}"
            for name in (
                "freiburg1_floor",
                "freiburg1_room",
                "freiburg1_teddy",
                "freiburg2_360_hemisphere",
                "freiburg2_360_kidnap",
                "freiburg2_desk",
                "freiburg2_desk_with_person",
                "freiburg3_sitting_halfsphere",
                "freiburg3_sitting_xyz",
            )
        )
    ),
    "7scenes": DataSet(
        tuple(
            f"{scene}/seq-{number}"
            for scene, numbers in {
                "chess": ("03",),
                "fire": ("03", "04"),
                "heads": ("01",),
                "office": ("02", "06", "09"),
                "pumpkin": ("01",),
                "redkitchen": ("06", "12"),
                "stairs": ("04",),
            }.items()
            for number in numbers
        )
    ),
    "eth3d": DataSet(("ceiling_1", "desk_changing_1", "kidnap_1", "motion_1", "plant_scene_3"), clouds=True),
    "bonn": DataSet(("rgbd_bonn_*",), ("--intrinsics", "542.822841,542.576870,315.593520,237.756098")),
    "nrgbd": DataSet(("*",), clouds=True),
}
"""Scenes of the paper's tables; for BONN and NRGBD it has no list, so all are taken."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", choices=tuple(DATA_SETS))
    parser.add_argument("--root", type=Path, required=True, help="the folder with the sequences")
    parser.add_argument("--scene", action="append", help="a folder under --root instead of the paper's")
    parser.add_argument("--frames", help="START:STOP of every sequence")
    parser.add_argument("--delta", default="1", help="of RTE and RRE, as `list3r eval trajectory` takes it")
    parser.add_argument("--list", action="store_true", help="print the plan, and do nothing")
    parser.add_argument("--keep", type=Path, help="folder in which memories are kept")
    parser.add_argument("--json", type=Path)
    said = sys.argv[1:]
    cut = said.index("--") if "--" in said else len(said)
    words, build = parser.parse_args(said[:cut]), said[cut + 1 :]
    chosen = DATA_SETS[words.data]
    found = find_scenes(words.root, words.scene or chosen.scenes)
    rows = json.loads(words.json.read_text())["scenes"] if words.json and words.json.exists() else []
    with tempfile.TemporaryDirectory() as scratch:
        for name, folder in found:
            options = [*chosen.options, *(["--frames", words.frames] if words.frames else []), *build]
            if words.list:
                print(f"{name}: list3r build {folder} {' '.join(options)}")
            elif all(row["scene"] != name for row in rows):
                keep = words.keep or Path(scratch)
                row = one_scene(keep / name.replace("/", "-"), words.data, folder, options, words.delta)
                rows.append({"scene": name, "commit": STARTED_AT, **row})
                print(json.dumps(rows[-1]), flush=True)
                write_json(words.json, {"data": words.data, "options": options, "scenes": rows})
    if rows:
        print(machine())
        print(table(rows))


def find_scenes(root: Path, patterns: Sequence[str]) -> list[tuple[str, Path]]:
    """Return names and folders of the sequences that are there, and say which are not."""
    out: list[tuple[str, Path]] = []
    for pattern in patterns:
        here = sorted(p for p in root.glob(pattern) if p.is_dir())
        if not here:
            print(f"{root} has no {pattern}: left out")
        out += [(str(p.relative_to(root)), p) for p in here if all(p != known for _, known in out)]
    return out


def one_scene(root: Path, data: str, folder: Path, options: Sequence[str], delta: str) -> dict[str, Any]:
    """Build a memory of a sequence and compare it with the truth."""
    root.mkdir(parents=True, exist_ok=True)
    source = from_nrgbd(folder, root / "source") if data == "nrgbd" else folder
    memory = root / "memory.l3r"
    report, usage = run_list3r("build", str(source), "-m", str(memory), "--force", "--poses", "estimate", *options)
    errors, _ = run_list3r("eval", "trajectory", str(source), str(memory), "--delta", delta)
    row = {
        "frames": report["frames"],
        "posed": report["posed"],
        "ate_m": errors["ate_sim3_m"]["rmse"],
        "rte_m": errors["rpe_translation_sim3_m"]["rmse"],
        "rre_deg": errors["rpe_rotation_deg"]["rmse"],
        "ate_se3_m": errors["ate_se3_m"]["rmse"],
        "scale": errors["scale"],
        **usage,
    }
    if DATA_SETS[data].clouds:
        cloud, _ = run_list3r("eval", "cloud", str(source), str(memory))
        row |= {"cloud": cloud}
    return row


def from_nrgbd(folder: Path, out: Path) -> Path:
    """Return a folder in the layout of nerfstudio with a scene of Neural RGB-D: poses are OpenGL's, depth millimetres.

    Pictures are linked where the disk allows it, else copied. Frames with a pose that is not finite have none.
    """
    if (out / "transforms.json").exists():
        return out
    focal = float((folder / "focal.txt").read_text().split()[0])
    poses = np.array((folder / "poses.txt").read_text().split(), float).reshape(-1, 4, 4)
    pictures = sorted((folder / "images").glob("img*.png"), key=lambda p: int(p.stem[3:]))
    frames = list(_frames(folder, out, pictures, poses))
    import cv2

    height, width = cv2.imread(str(pictures[0])).shape[:2]
    camera = {"fl_x": focal, "fl_y": focal, "cx": (width - 1) / 2, "cy": (height - 1) / 2, "w": width, "h": height}
    (out / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    return out


def _frames(folder: Path, out: Path, pictures: Sequence[Path], poses: np.ndarray) -> Iterator[dict[str, Any]]:
    for picture, pose in zip(pictures, poses, strict=True):
        depth = folder / "depth" / picture.name.replace("img", "depth")
        for file in (picture, depth):
            target = out / file.parent.name / file.name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.unlink(missing_ok=True)
            try:
                os.link(file, target)
            except OSError:
                shutil.copy(file, target)
        row = {"file_path": f"images/{picture.name}", "depth_file_path": f"depth/{depth.name}"}
        yield row | ({"transform_matrix": pose.tolist()} if np.isfinite(pose).all() else {})


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows and their mean as Markdown."""
    lines = ["| sequence | frames posed | ATE m | RTE m | RRE deg |", "|---|---|---|---|---|"]
    figures = ("ate_m", "rte_m", "rre_deg")
    for row in rows:
        values = " | ".join(f"{row[k]:.3f}" for k in figures)
        lines.append(f"| {row['scene']} | {row['posed']} of {row['frames']} | {values} |")
    means = " | ".join(f"{np.mean([row[k] for row in rows]):.3f}" for k in figures)
    return "\n".join([*lines, f"| mean of {len(rows)} | | {means} |"])


if __name__ == "__main__":
    main()
