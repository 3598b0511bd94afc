"""A recording of Stray Scanner: `rgb.mp4`, `depth/`, `confidence/`, `camera_matrix.csv`, `odometry.csv`.

Layout as in strayrobots/scanner (docs/format.md): depth in millimetres at 256 x 192 for frame N in `NNNNNN.png`, the
camera for pictures as stored, poses camera-to-world with OpenCV's axes already, in ARKit's world with y up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import BadFrame, Frame, SourceInfo
from list3r.frames.decoding.decode import read_raw_depth
from list3r.frames.layout import Optics, read_lines, read_numbers
from list3r.frames.options import Intrinsics, SourceOptions, check_intrinsics
from list3r.frames.readers.video import VideoSource
from list3r.frames.recordings.axes import Z_UP_FROM_Y_UP, pose_of_quaternion
from list3r.frames.registration.rig import WORKING_SIDES, build_rig
from list3r.memory.errors import FrameError, OptionError, SourceError

LEAST_CONFIDENCE = 1
"""Depth of confidence 0 is unknown (stored 0, 1, 2)."""
_MILLIMETRES = 1000.0


def is_recording(root: Path) -> bool:
    """Whether a folder is such a recording."""
    return (root / "rgb.mp4").is_file() and (root / "odometry.csv").is_file()


class StraySource:
    """A `FrameSource`: the pictures of the video, each with depth and pose of its number."""

    def __init__(self, root: Path, options: SourceOptions) -> None:
        """Raises `SourceError` and `OptionError` where the files do not fit together."""
        intrinsics = options.intrinsics or _matrix(root / "camera_matrix.csv")
        side = WORKING_SIDES[True] if options.max_side is None else options.max_side
        words = replace(options, kind="auto", intrinsics=intrinsics, max_side=side, depth_scale=None)
        self._video = VideoSource(root / "rgb.mp4", words)
        self._poses = _odometry(root / "odometry.csv")
        self._root = root
        depths = sorted((root / "depth").glob("*.png")) + sorted((root / "depth").glob("*.npy"))
        self._depth = {int(p.stem): p for p in depths if p.stem.isdigit()}
        stored = self._video.stored_size
        scale = options.depth_scale or _MILLIMETRES
        optics = Optics(intrinsics, options.distortion or (), intrinsics, np.eye(4), scale, stored, stored)
        size = read_raw_depth(next(iter(self._depth.values()))).shape if self._depth else None
        self._rig = build_rig(optics, stored, (size[0], size[1]) if size else None, options.max_depth_m, side)
        self._info = self._describe(root)

    @property
    def info(self) -> SourceInfo:
        """What was recognised."""
        return self._info

    def read(self, start: int, stop: int) -> Iterator[Frame | BadFrame]:
        """Frames at positions [start, stop) in order; one that cannot be decoded comes as a `BadFrame`."""
        return self.read_every(start, stop, 1)

    def read_every(self, start: int, stop: int, step: int) -> Iterator[Frame | BadFrame]:
        """As `read`, but only each `step`-th frame from `start` on."""
        for frame in self._video.read_every(start, stop, step):
            try:
                yield frame if isinstance(frame, BadFrame) else self._with_depth(frame)
            except FrameError as error:
                yield BadFrame(frame.index, str(error))

    def position(self, index: int) -> int:
        """Where a frame (Frame.index) is among those handed out."""
        return self._video.position(index)

    def read_poses(self) -> list[tuple[int, float, NDArray[np.float64]]]:
        """Frame.index, seconds and pose of every frame that has one; no picture is decoded."""
        numbers = (self._video.number(k) for k in range(self._info.frame_count))
        found = ((k, self._video.time_s(k), self._pose(k)) for k in numbers)
        return [(k, time_s, T) for k, time_s, T in found if T is not None]

    def _with_depth(self, frame: Frame) -> Frame:
        depth = None
        if self._depth:
            if frame.index not in self._depth:
                raise FrameError(f"frame {frame.index} has no depth image")
            depth = self._rig.depth(self._sure(frame.index))
        return replace(frame, depth=depth, T_source_cam=self._pose(frame.index))

    def _sure(self, number: int) -> NDArray[np.generic]:
        raw = read_raw_depth(self._depth[number])
        path = self._root / "confidence" / f"{number:06d}.png"
        if not path.is_file():
            return raw
        confidence = read_raw_depth(path)
        if confidence.shape != raw.shape:
            raise FrameError(f"{path.name}: confidence and depth are of different sizes")
        return np.where(confidence >= LEAST_CONFIDENCE, raw, np.zeros((), raw.dtype))

    def _pose(self, number: int) -> NDArray[np.float64] | None:
        return self._poses.get(number)

    def _describe(self, root: Path) -> SourceInfo:
        info = self._video.info
        notes = [*info.notes, "camera of camera_matrix.csv, poses of odometry.csv (ARKit)"]
        missing = tuple(m for m in info.missing if "depth" not in m) if self._depth else info.missing
        return replace(
            info,
            kind="stray",
            path=str(root),
            has_depth=bool(self._depth),
            has_poses=bool(self._poses),
            scale_kind="metric" if self._depth else "relative",
            depth_camera=self._rig.registration.depth_camera if self._rig.registration else None,
            T_color_depth=self._rig.registration.T_color_depth if self._rig.registration else None,
            depth_scale=self._rig.depth_scale if self._depth else None,
            notes=tuple(notes),
            missing=missing,
            z_up=True,
            poses_drift=True,
        )


def _matrix(path: Path) -> Intrinsics:
    rows = read_numbers(path) if path.is_file() else []
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        raise SourceError(f"{path} is no 3x3 camera matrix; mend it, or give --intrinsics fx,fy,cx,cy")
    try:
        return check_intrinsics([rows[0][0], rows[1][1], rows[0][2], rows[1][2]])
    except OptionError as error:
        raise SourceError(f"{path}: {error}") from None


def _odometry(path: Path) -> dict[int, NDArray[np.float64]]:
    """Poses by frame number. Raises `SourceError` for rows that are no numbers."""
    poses: dict[int, NDArray[np.float64]] = {}
    for number, line in enumerate(read_lines(path)[1:], start=2):
        words = [word.strip() for word in line.split(",")]
        if len(words) < 9:
            continue
        try:
            _, frame, *values = (float(word) for word in words[:9])
        except ValueError:
            raise SourceError(f"{path}: line {number} is not timestamp, frame and a pose; mend or remove it") from None
        T_world_cam = pose_of_quaternion(values[:3], values[3:7]) if _whole(frame) else None
        if T_world_cam is not None:
            poses[int(frame)] = np.asarray(Z_UP_FROM_Y_UP @ T_world_cam)
    return poses


def _whole(value: float) -> bool:
    return bool(np.isfinite(value)) and value == int(value) >= 0
