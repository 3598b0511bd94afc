"""A scan of ARKitScenes: `lowres_wide/`, `lowres_depth/`, `lowres_wide_intrinsics/*.pincam`, `lowres_wide.traj`.

Layout as documented in apple/ARKitScenes (DATA.md): depth in millimetres, one `width height fx fy cx cy` a picture, and
a trajectory of `time, rotation vector, translation` **from the world to the camera**. The world has z up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.layout import FolderLayout, read_numbers
from list3r.frames.listing import FrameFile
from list3r.frames.options import SourceOptions, check_intrinsics
from list3r.frames.readers.phones.scan import scan_layout, there
from list3r.frames.readers.tum import poses_at
from list3r.frames.recordings.stamps import nearest_rows
from list3r.memory.core.errors import OptionError, SourceError


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None without `lowres_wide`. Raises `SourceError` for files that cannot be read."""
    if not (root / "lowres_wide").is_dir():
        return None
    colors = sorted((root / "lowres_wide").glob("*.png"), key=_time_s)
    times_s, traj = np.array([_time_s(p) for p in colors]), root / "lowres_wide.traj"
    if not len(colors) or np.isnan(times_s).any():
        raise SourceError(f"{root / 'lowres_wide'} holds no pictures named SCAN_SECONDS.png; is the copy complete?")
    files = [
        FrameFile(
            color,
            there(root / "lowres_depth" / color.name),
            T_source_camera=pose,
            time_s=float(time),
            confidence=there(root / "confidence" / color.name),
        )
        for color, time, pose in zip(colors, times_s, _poses(traj, times_s), strict=True)
    ]
    poses = "poses of lowres_wide.traj" if traj.is_file() else "no lowres_wide.traj"
    note = f"cameras of lowres_wide_intrinsics, {poses}"
    cameras = root / "lowres_wide_intrinsics"
    return scan_layout("arkitscenes", files, _pincams(cameras, times_s), cameras, options, note)


def _time_s(path: Path) -> float:
    try:
        return float(path.stem.rsplit("_", 1)[-1])
    except ValueError:
        return float("nan")


def _pincams(folder: Path, times_s: NDArray[np.float64]) -> list[list[float] | None]:
    """Return the camera of each picture, of the file nearest in time; None without any."""
    known = sorted((time, path) for path in folder.glob("*.pincam") if np.isfinite(time := _time_s(path)))
    if not known:
        return [None] * len(times_s)
    stated = [_pincam(path) for _, path in known]
    return [stated[k] for k in nearest_rows(np.array([time for time, _ in known]), times_s)]


def _pincam(path: Path) -> list[float]:
    """Return fx, fy, cx, cy, width, height. Raises `SourceError`."""
    rows = read_numbers(path)
    if not rows or len(rows[0]) != 6:
        raise SourceError(f"{path} is not `width height fx fy cx cy`; fix or remove it")
    try:
        check_intrinsics(rows[0][2:])
    except OptionError as error:
        raise SourceError(f"{path}: {error}") from None
    return [*rows[0][2:], *rows[0][:2]]


def _poses(path: Path, times_s: NDArray[np.float64]) -> list[NDArray[np.float64] | None]:
    """Poses at the pictures' times, interpolated; the file has them from the world to the camera."""
    rows = [r for r in read_numbers(path) if len(r) == 7 and np.isfinite(r).all()] if path.is_file() else []
    if not rows:
        return [None] * len(times_s)
    table = np.array(sorted(rows))
    rotation = Rotation.from_rotvec(table[:, 1:4]).inv()
    centers = -rotation.apply(table[:, 4:7])
    return poses_at(times_s, table[:, 0], np.concatenate([centers, rotation.as_quat()], axis=1))
