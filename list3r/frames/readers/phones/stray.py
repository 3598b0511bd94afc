"""A recording of Stray Scanner: `rgb.mp4`, `depth/`, `confidence/`, `camera_matrix.csv`, `odometry.csv`.

Layout as in strayrobots/scanner (docs/format.md): depth in millimetres at 256 x 192 for frame N in `NNNNNN.png`, the
camera for pictures as stored, poses camera-to-world with OpenCV's axes already, in ARKit's world with y up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import read_camera_matrix, read_lines, read_numbers
from list3r.frames.options import Intrinsics, SourceOptions
from list3r.frames.readers.phones.scan import LEAST_CONFIDENCE
from list3r.frames.readers.video_depth import RecordingParts, VideoWithDepth
from list3r.frames.recordings.axes import Z_UP_FROM_Y_UP, pose_of_quaternion
from list3r.memory.core.errors import SourceError

_MILLIMETRES = 1000.0


def is_recording(root: Path) -> bool:
    """Whether a folder is such a recording, if without its poses or its camera.

    Raises `SourceError` for one without its video.
    """
    tables = [(root / name).is_file() for name in ("odometry.csv", "camera_matrix.csv")]
    if all(tables) and not (root / "rgb.mp4").is_file():
        raise SourceError(f"{root} is a recording of Stray Scanner without its rgb.mp4; is the copy complete?")
    return any(tables) and (root / "rgb.mp4").is_file()


def open_recording(root: Path, options: SourceOptions) -> VideoWithDepth:
    """Return the frames of a recording. Raises `SourceError` and `OptionError` where the files do not fit together."""
    depths = sorted((root / "depth").glob("*.png")) + sorted((root / "depth").glob("*.npy"))
    intrinsics, note = _matrix(root / "camera_matrix.csv") if options.intrinsics is None else (options.intrinsics, "")
    odometry = root / "odometry.csv"
    poses = "poses of odometry.csv (ARKit)" if odometry.is_file() else "there is no odometry.csv"
    parts = RecordingParts(
        "stray",
        root / "rgb.mp4",
        intrinsics,
        {int(p.stem): p for p in depths if p.stem.isdigit()},
        _odometry(odometry) if odometry.is_file() else {},
        _MILLIMETRES,
        f"{note or 'camera as given'}, {poses}",
        z_up=True,
        poses_drift=True,
        confidence=lambda number: root / "confidence" / f"{number:06d}.png",
        least_confidence=LEAST_CONFIDENCE,
    )
    return VideoWithDepth(root, parts, options)


def _matrix(path: Path) -> tuple[Intrinsics, str]:
    """Return the camera, and how it is written."""
    if not path.is_file():
        raise SourceError(f"{path} is missing; is the copy complete? Without it, give --intrinsics fx,fy,cx,cy")
    last = [row for row in read_numbers(path) if row][-1:]
    how = " (written column by column)" if last and any(last[0][:2]) else ""
    return read_camera_matrix(path), f"camera of camera_matrix.csv{how}"


def _odometry(path: Path) -> dict[int, NDArray[np.float64]]:
    """Poses by frame number. Raises `SourceError` for rows that are no numbers."""
    poses: dict[int, NDArray[np.float64]] = {}
    for number, line in enumerate(read_lines(path), start=1):
        words = [word.strip() for word in line.split(",")]
        if len(words) < 9 or (number == 1 and words[0].isidentifier()):
            continue
        try:
            _, frame, *values = (float(word) for word in words[:9])
        except ValueError:
            raise SourceError(f"{path}: line {number} is not timestamp, frame and a pose; fix or remove it") from None
        T_world_cam = pose_of_quaternion(values[:3], values[3:7]) if _whole(frame) else None
        if T_world_cam is not None:
            poses[int(frame)] = np.asarray(Z_UP_FROM_Y_UP @ T_world_cam)
    return poses


def _whole(value: float) -> bool:
    return bool(np.isfinite(value)) and value == int(value) >= 0
