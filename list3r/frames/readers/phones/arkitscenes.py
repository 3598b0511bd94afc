"""A scan of ARKitScenes: `lowres_wide/`, `lowres_depth/`, `lowres_wide_intrinsics/*.pincam`, `lowres_wide.traj`.

Layout as documented in apple/ARKitScenes (DATA.md): depth in millimetres, one `width height fx fy cx cy` a picture, and
a trajectory of `time, rotation vector, translation` **from the world to the camera**. The world has z up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.layout import VARIES, FolderLayout, Optics, own_camera, read_numbers, there, varies_note
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions, check_intrinsics
from list3r.frames.readers.tum import poses_at
from list3r.memory.core.errors import OptionError, SourceError

LEAST_CONFIDENCE = 1
"""Depth of confidence 0 is unknown (stored 0, 1, 2)."""
_NEAR_S = 0.02
"""Names of a picture and its camera may differ in the last digit of their time."""


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None without `lowres_wide`. Raises `SourceError` for files that cannot be read."""
    if not (root / "lowres_wide").is_dir():
        return None
    colors = sorted((root / "lowres_wide").glob("*.png"), key=_time_s)
    times_s, traj = np.array([_time_s(p) for p in colors]), root / "lowres_wide.traj"
    if not len(colors) or np.isnan(times_s).any():
        raise SourceError(f"{root / 'lowres_wide'} holds no pictures named SCAN_SECONDS.png; is the copy complete?")
    stated, cameras = _pincams(root, times_s)
    width, height, *middle = np.median(np.array(stated), axis=0).tolist() if stated else [0.0] * 6
    spread = float(np.ptp([row[2] for row in stated]) / middle[0]) if stated and options.intrinsics is None else 0.0
    files = FrameFiles(
        FrameFile(
            color,
            there(root / "lowres_depth" / color.name),
            T_source_camera=pose,
            time_s=float(time),
            confidence=there(root / "confidence" / color.name),
            lens=own_camera([*own[2:], *own[:2]], root) if own is not None and spread > VARIES else None,
        )
        for color, time, pose, own in zip(colors, times_s, _poses(traj, times_s), cameras, strict=True)
    )
    if options.intrinsics is None and not stated:
        raise SourceError(f"{root} has no lowres_wide_intrinsics/*.pincam; give --intrinsics fx,fy,cx,cy")
    intrinsics, size = options.intrinsics, None
    if intrinsics is None:
        intrinsics, size = check_intrinsics(middle), (round(height), round(width))
    optics = Optics(intrinsics, depth_scale=1000.0, intrinsics_size=size, shares_view=True)
    poses = "poses of lowres_wide.traj" if traj.is_file() else "no lowres_wide.traj"
    notes = [f"cameras of lowres_wide_intrinsics, {poses}"]
    if spread > VARIES:
        notes.append(varies_note(spread, carried=True))
    return FolderLayout(
        "arkitscenes",
        files,
        optics,
        "color",
        intrinsics,
        tuple(notes),
        LEAST_CONFIDENCE,
        z_up=True,
        upright_tags=False,
    )


def _time_s(path: Path) -> float:
    try:
        return float(path.stem.rsplit("_", 1)[-1])
    except ValueError:
        return float("nan")


def _pincams(root: Path, times_s: NDArray[np.float64]) -> tuple[list[list[float]], list[list[float] | None]]:
    """Return width, height, fx, fy, cx, cy of all files, and of each picture: of the file nearest in time, if near."""
    paths = sorted((root / "lowres_wide_intrinsics").glob("*.pincam"), key=_time_s)
    stated = [_pincam(path) for path in paths]
    if not paths:
        return [], [None] * len(times_s)
    known_s = np.array([_time_s(path) for path in paths])
    nearest = [int(np.nanargmin(np.abs(known_s - t))) if np.isfinite(known_s).any() else 0 for t in times_s]
    near = [bool(abs(known_s[k] - t) < _NEAR_S) for k, t in zip(nearest, times_s, strict=True)]
    return stated, [stated[k] if ok else None for k, ok in zip(nearest, near, strict=True)]


def _pincam(path: Path) -> list[float]:
    rows = read_numbers(path)
    if not rows or len(rows[0]) != 6:
        raise SourceError(f"{path} is not `width height fx fy cx cy`; fix or remove it")
    try:
        check_intrinsics(rows[0][2:])
    except OptionError as error:
        raise SourceError(f"{path}: {error}") from None
    return rows[0]


def _poses(path: Path, times_s: NDArray[np.float64]) -> list[NDArray[np.float64] | None]:
    """Poses at the pictures' times, interpolated; the file has them from the world to the camera."""
    rows = [r for r in read_numbers(path) if len(r) == 7 and np.isfinite(r).all()] if path.is_file() else []
    if not rows:
        return [None] * len(times_s)
    table = np.array(sorted(rows))
    rotation = Rotation.from_rotvec(table[:, 1:4]).inv()
    centers = -rotation.apply(table[:, 4:7])
    return poses_at(times_s, table[:, 0], np.concatenate([centers, rotation.as_quat()], axis=1))
