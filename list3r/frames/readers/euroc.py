"""A recording in EuRoC's layout: `mav0/cam0/data.csv`, `data/`, `sensor.yaml`, and the body's poses as ground truth.

Burri et al., "The EuRoC micro aerial vehicle datasets", 2016. One camera of a stereo pair is read: `cam0`. Times are
nanoseconds; `sensor.yaml` states the camera and its place on the body; ground truth is the body's pose, with wxyz.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import (
    FolderLayout,
    Optics,
    inside,
    pose_matrix,
    read_lines,
    read_numbers,
    read_text,
)
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import Intrinsics, SourceOptions, check_distortion, check_intrinsics
from list3r.frames.readers.tum import poses_at
from list3r.memory.core.errors import OptionError, SourceError

_TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0", "leica0", "gt")
_POSE_COLUMNS = 8


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None without `cam0/data.csv`. Raises `SourceError` for files that cannot be read."""
    base = next((f for f in (root / "mav0", root) if (f / "cam0" / "data.csv").is_file()), None)
    if base is None:
        return None
    listing = base / "cam0" / "data.csv"
    rows = [line.split(",") for line in read_lines(listing) if line.strip() and not line.startswith("#")]
    try:
        named = sorted((int(row[0]), row[1].strip()) for row in rows)
    except (ValueError, IndexError):
        raise SourceError(f"{listing} has lines that are not `nanoseconds,filename`; fix them") from None
    if not named:
        raise SourceError(f"{listing} names no picture; is the copy complete?")
    intrinsics, distortion, size, T_body_cam = _sensor(base / "cam0" / "sensor.yaml")
    times_s = 1e-9 * np.array([time for time, _ in named], np.float64)
    truth = next((p for name in _TRUTHS if (p := base / name / "data.csv").is_file()), None)
    poses = [None] * len(named) if truth is None else _poses(truth, times_s, T_body_cam)
    files = FrameFiles(
        FrameFile(inside(base / "cam0" / "data", name, listing), T_source_camera=pose, time_s=float(time))
        for (_, name), time, pose in zip(named, times_s, poses, strict=True)
    )
    notes = ["cam0, its camera and place of sensor.yaml"]
    if truth is not None:
        notes.append(f"poses of {truth.parent.name}")
    optics = Optics(options.intrinsics or intrinsics, distortion, intrinsics_size=size)
    if options.intrinsics is not None:
        optics = Optics(options.intrinsics, options.distortion or ())
    return FolderLayout("euroc", files, optics, "color", intrinsics, tuple(notes), upright_tags=False)


def _sensor(path: Path) -> tuple[Intrinsics, tuple[float, ...], tuple[int, int] | None, NDArray[np.float64]]:
    """The camera, its lens, (height, width), and T_body_cam. Raises `SourceError`."""
    text = read_text(path) if path.is_file() else ""
    model = re.search(r"^distortion_model:\s*(\S+)", text, re.MULTILINE)
    if model and model[1] not in ("radial-tangential", "radtan", "plumb_bob", "none"):
        raise SourceError(f"{path} states a {model[1]} lens; undistort the pictures first")
    resolution = _list(text, "resolution")
    T = pose_matrix(_list(text, "data"))
    try:
        intrinsics = check_intrinsics(_list(text, "intrinsics"))
        distortion = check_distortion(_list(text, "distortion_coefficients"))
    except OptionError as error:
        raise SourceError(f"{path}: {error}") from None
    size = (int(resolution[1]), int(resolution[0])) if len(resolution) == 2 else None
    return intrinsics, distortion, size, np.eye(4) if T is None else T


def _list(text: str, name: str) -> list[float]:
    """The numbers of a list of a YAML file that has one of that name; none where it has not."""
    found = re.search(rf"^\s*{name}:\s*\[([^\]]*)\]", text, re.MULTILINE)
    try:
        return [float(word) for word in found[1].replace("\n", " ").split(",")] if found else []
    except ValueError:
        return []


def _poses(
    path: Path, times_s: NDArray[np.float64], T_body_cam: NDArray[np.float64]
) -> list[NDArray[np.float64] | None]:
    """Poses of the camera at the pictures' times, from the body's."""
    rows = np.array([r[:_POSE_COLUMNS] for r in read_numbers(path) if len(r) >= _POSE_COLUMNS and np.isfinite(r).all()])
    if not len(rows):
        return [None] * len(times_s)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    bodies = poses_at(times_s, 1e-9 * rows[:, 0], rows[:, [1, 2, 3, 5, 6, 7, 4]])
    return [None if T is None else T @ T_body_cam for T in bodies]
