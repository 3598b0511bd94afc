"""The TUM RGB-D layout: `rgb.txt`, `depth.txt`, `groundtruth.txt`, brought together by time.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012. Depth lies on the colour pixels, 5000
units a metre. Cameras as published on the benchmark's page "file formats".
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.layout import (
    MAX_LENGTH_M,
    FolderLayout,
    Optics,
    iter_numbers,
    read_calibration,
    read_lines,
)
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import Intrinsics, SourceOptions, check_distortion
from list3r.frames.recordings.stamps import as_seconds, nearest_rows
from list3r.memory.core.errors import SourceError

MAX_PAIR_GAP_S = 0.02
"""Colour and depth this far apart still make a frame (the benchmark's own tools)."""
MAX_POSE_BRACKET_S = 0.1
"""Poses are interpolated over gaps up to this; over longer ones a hand does not move evenly."""

_AT_A_TIME = 4096
"""Poses that are interpolated together."""

_ROS_DEFAULT: Intrinsics = (525.0, 525.0, 319.5, 239.5)
_PUBLISHED: dict[str, tuple[Intrinsics, tuple[float, ...]]] = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
_FREIBURG = re.compile(r"(?:freiburg|(?<![a-z])fr)([123])(?!\d)", re.IGNORECASE)


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None when the folder has another. Raises `SourceError` for lists that cannot be read."""
    if not (root / "rgb.txt").is_file():
        return None
    color_s, colors = _read_list(root / "rgb.txt")
    notes: list[str] = []
    if (root / "depth.txt").is_file():
        depth_s, depths = _read_list(root / "depth.txt")
        pairs = associate(color_s, depth_s, MAX_PAIR_GAP_S)
        if not len(pairs):
            apart = f"rgb.txt begins at {color_s[0]:.3f} s, depth.txt at {depth_s[0]:.3f} s"
            raise SourceError(
                f"{root}: no colour image has a depth image within {MAX_PAIR_GAP_S:g} s; fix depth.txt ({apart})"
            )
        if len(pairs) < len(colors):
            alone = len(colors) - len(pairs)
            notes.append(f"{alone} of {len(colors)} colour images have no depth image of their time and are left out")
        named: Iterator[Path | None] = (root / depths[d] for d in pairs[:, 1])
        picked = pairs[:, 0]
    else:
        picked, named = np.arange(len(colors)), repeat(None, len(colors))
    times = color_s[picked]
    poses = _poses(root / "groundtruth.txt", times)
    files = FrameFiles(
        FrameFile(root / colors[c], depth, None, pose, float(time))
        for c, depth, pose, time in zip(picked, named, poses, times, strict=True)
    )
    intrinsics, distortion, camera_note = _camera(root, options)
    optics = Optics(intrinsics, distortion, depth_scale=5000.0)
    return FolderLayout("tum", files, optics, "color", intrinsics, (*camera_note, *notes))


def associate(a_s: NDArray[np.float64], b_s: NDArray[np.float64], max_gap_s: float) -> NDArray[np.int64]:
    """Pairs (into a, into b) that are each other's nearest in time within `max_gap_s`, in the order of a.

    Both are ascending seconds, shapes (N,) and (M,). Shape (P, 2).
    """
    if not len(a_s) or not len(b_s):
        return np.zeros((0, 2), dtype=np.int64)
    to_b, to_a = nearest_rows(b_s, a_s), nearest_rows(a_s, b_s)
    mutual = (to_a[to_b] == np.arange(len(a_s))) & (np.abs(b_s[to_b] - a_s) <= max_gap_s)
    return np.stack([np.flatnonzero(mutual), to_b[mutual]], axis=1)


def poses_at(
    times_s: NDArray[np.float64], stamps_s: NDArray[np.float64], poses_xyzw: NDArray[np.float64]
) -> list[NDArray[np.float64] | None]:
    """Poses at the given times, None where none is near enough.

    Between two stamps at most `MAX_POSE_BRACKET_S` apart the translation is interpolated linearly and the rotation
    along the shortest arc; otherwise the nearest stamp within `MAX_PAIR_GAP_S` counts. `stamps_s` (N,) ascend,
    `poses_xyzw` (N, 7) are translations in metres and quaternions.
    """
    after = np.clip(np.searchsorted(stamps_s, times_s), 1, max(1, len(stamps_s) - 1))
    after = np.minimum(after, len(stamps_s) - 1)
    before = np.maximum(after - 1, 0)
    gap = stamps_s[after] - stamps_s[before]
    inside = (times_s >= stamps_s[before]) & (times_s <= stamps_s[after]) & (gap <= MAX_POSE_BRACKET_S)
    near = nearest_rows(stamps_s, times_s)
    known = inside | (np.abs(stamps_s[near] - times_s) <= MAX_PAIR_GAP_S)
    w = np.where(inside & (gap > 0), (times_s - stamps_s[before]) / np.where(gap > 0, gap, 1.0), 0.0)
    first, second = np.where(inside, before, near), np.where(inside, after, near)
    rotations, later = (Rotation.from_quat(poses_xyzw[rows, 3:]) for rows in (first, second))
    turn = (rotations.inv() * later).as_rotvec()
    matrices = np.tile(np.eye(4), (len(times_s), 1, 1))
    matrices[:, :3, :3] = (rotations * Rotation.from_rotvec(w[:, None] * turn)).as_matrix()
    matrices[:, :3, 3] = (1 - w[:, None]) * poses_xyzw[first, :3] + w[:, None] * poses_xyzw[second, :3]
    return [matrix if ok else None for matrix, ok in zip(matrices, known, strict=True)]


def _read_list(path: Path) -> tuple[NDArray[np.float64], list[str]]:
    """Return times, ascending, and names of a list `timestamp filename`. Raises `SourceError`."""
    times_s, names = array("d"), list[str]()
    for number, line in enumerate(read_lines(path), start=1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        words = text.split(maxsplit=1)
        try:
            times_s.append(float(words[0]))
            names.append(words[1].strip().replace("\\", "/"))
        except (ValueError, IndexError):
            raise SourceError(f"{path}: line {number} is not 'timestamp filename'; fix or remove it") from None
    if not times_s:
        raise SourceError(f"{path} names no image; is the copy complete?")
    rows = sorted(zip(as_seconds(np.frombuffer(times_s)).tolist(), names, strict=True))
    return np.array([time for time, _ in rows]), [name for _, name in rows]


def _poses(path: Path, times_s: NDArray[np.float64]) -> Iterator[NDArray[np.float64] | None]:
    """Yield the pose at each time, None where there is none."""
    numbers = array("d")
    for row in iter_numbers(path) if path.is_file() else ():
        if len(row) >= 8 and all(map(math.isfinite, row[:8])) and max(map(abs, row[1:4])) <= MAX_LENGTH_M:
            numbers.extend(row[:8] if sum(v * v for v in row[4:8]) > 0.5 else ())
    table = np.frombuffer(numbers).reshape(-1, 8).copy()
    table[:, 0] = as_seconds(table[:, 0])
    if not len(table):
        yield from repeat(None, len(times_s))
        return
    if np.any(np.diff(table[:, 0]) < 0):
        table = table[np.argsort(table[:, 0], kind="stable")]
    for first in range(0, len(times_s), _AT_A_TIME):
        yield from poses_at(times_s[first : first + _AT_A_TIME], table[:, 0], table[:, 1:])


def _camera(root: Path, options: SourceOptions) -> tuple[Intrinsics, tuple[float, ...], tuple[str, ...]]:
    """Colour camera: from a file, from the folder's name, or the ROS default that the benchmark recommends."""
    if options.intrinsics is not None:
        return options.intrinsics, (), ()
    written = read_calibration(root)
    if written is not None:
        return *written, ("intrinsics of calibration.txt",)
    named = _FREIBURG.search(root.resolve().name)
    if named:
        intrinsics, distortion = _PUBLISHED[named[1]]
        note = f"intrinsics as published for freiburg{named[1]}, which the folder's name says"
        return intrinsics, check_distortion(distortion) if distortion else (), (note,)
    assumed = "525,525,319.5,239.5"
    return _ROS_DEFAULT, (), (f"the camera is not named: the ROS default {assumed} is assumed; --intrinsics is better",)
