"""The Replica layout of NICE-SLAM: `results/frame*.jpg`, `results/depth*.png`, `traj.txt`, `cam_params.json`."""

from __future__ import annotations

from pathlib import Path

from list3r.frames.layout import (
    IMAGE_ENDINGS,
    FrameFile,
    Layout,
    Optics,
    natural_key,
    pose_matrix,
    read_json,
    read_numbers,
)
from list3r.frames.options import Intrinsics, SourceOptions, check_intrinsics
from list3r.memory.errors import OptionError, SourceError

_NICE_SLAM: Intrinsics = (600.0, 600.0, 599.5, 339.5)
_SCALE = 6553.5


def find(root: Path, options: SourceOptions) -> Layout | None:
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
    poses, notes = _poses(base / "traj.txt", len(colors))
    files = tuple(
        FrameFile(results / name, depths.get(name[len("frame") :].split(".")[0]), None, pose)
        for name, pose in zip(colors, poses, strict=True)
    )
    intrinsics, scale, note = _camera(base, options)
    optics = Optics(intrinsics, depth_scale=scale)
    return Layout("replica", files, optics, "color", intrinsics, (*note, *notes))


def _poses(path: Path, count: int) -> tuple[list, tuple[str, ...]]:  # type: ignore[type-arg]
    if not path.is_file():
        return [None] * count, ()
    poses = [pose_matrix(row) for row in read_numbers(path)]
    short = count - len(poses)
    if short > 0:
        return poses + [None] * short, (f"{path.name} has {len(poses)} poses for {count} frames; the last have none",)
    return poses[:count], ()


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
            raise SourceError(f"{path} has no camera with fx, fy, cx, cy; mend or remove it") from None
    if options.intrinsics is not None:
        return options.intrinsics, _SCALE, ()
    return _NICE_SLAM, _SCALE, ("no cam_params.json: the camera of NICE-SLAM's renders (1200x680) is assumed",)
