"""The Replica layout of NICE-SLAM: `results/frame*.jpg`, `results/depth*.png`, `traj.txt`, `cam_params.json`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import (
    IMAGE_ENDINGS,
    FolderLayout,
    Optics,
    natural_key,
    pose_matrix,
    read_json,
    read_numbers,
)
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import Intrinsics, SourceOptions, check_intrinsics
from list3r.memory.core.errors import OptionError, SourceError

_NICE_SLAM: Intrinsics = (600.0, 600.0, 599.5, 339.5)
_SCALE = 6553.5


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None when the folder has another."""
    base = root.parent if root.name == "results" and (root.parent / "traj.txt").is_file() else root
    results = base / "results"
    if not results.is_dir():
        return None
    names = sorted((p.name for p in results.iterdir()), key=natural_key)
    colors = [n for n in names if n.startswith("frame") and n.lower().endswith(IMAGE_ENDINGS)]
    if not colors:
        return None
    depths = {n[len("depth") :].split(".")[0]: results / n for n in names if n.startswith("depth")}
    poses, notes = _poses(base / "traj.txt", colors)
    files = FrameFiles(
        FrameFile(results / name, depths.get(name[len("frame") :].split(".")[0]), None, pose)
        for name, pose in zip(colors, poses, strict=True)
    )
    intrinsics, scale, note = _camera(base, options)
    optics = Optics(intrinsics, depth_scale=scale)
    return FolderLayout("replica", files, optics, "color", intrinsics, (*note, *notes))


def _poses(path: Path, colors: list[str]) -> tuple[list[NDArray[np.float64] | None], tuple[str, ...]]:
    """A row for every image; where there are more or fewer rows than images, row n belongs to the image numbered n."""
    if not path.is_file():
        return [None] * len(colors), ()
    rows = [pose_matrix(row) for row in read_numbers(path)]
    if len(rows) == len(colors):
        return rows, ()
    numbers = [int(digits) for digits in (_number(name) for name in colors) if digits.isdigit()]
    if len(numbers) < len(colors):
        raise SourceError(f"{path} has {len(rows)} poses for {len(colors)} images without numbers; fix or remove it")
    poses = [rows[n] if n < len(rows) else None for n in numbers]
    known = sum(n < len(rows) for n in numbers)
    note = f"{path.name} has {len(rows)} poses for {len(colors)} frames; {known} frames have the pose of their number"
    return poses, (note,)


def _number(name: str) -> str:
    return name[len("frame") :].split(".")[0].lstrip("_-")


def _camera(base: Path, options: SourceOptions) -> tuple[Intrinsics, float, tuple[str, ...]]:
    """Intrinsics and depth scale of `cam_params.json` in the folder or above it, or those of NICE-SLAM's renders."""
    for path in (base / "cam_params.json", base.parent / "cam_params.json"):
        if not path.is_file():
            continue
        content = read_json(path)
        camera = content.get("camera", content) if isinstance(content, dict) else {}
        try:
            values = [float(camera[name]) for name in ("fx", "fy", "cx", "cy")]
            return check_intrinsics(values), float(camera.get("scale", _SCALE)), (f"camera of {path.name}",)
        except (KeyError, TypeError, ValueError, AttributeError, OptionError):
            raise SourceError(f"{path} has no camera with fx, fy, cx, cy; fix or remove it") from None
    if options.intrinsics is not None:
        return options.intrinsics, _SCALE, ()
    return _NICE_SLAM, _SCALE, ("no cam_params.json: the camera of NICE-SLAM's renders (1200x680) is assumed",)
