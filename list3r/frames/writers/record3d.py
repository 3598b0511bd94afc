"""Write a recording as Record3D exports it (`.r3d`), see `list3r.frames.readers.phones.record3d`."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera, Frame
from list3r.frames.recordings.axes import arkit_of_pose
from list3r.frames.recordings.stored import import_lzfse
from list3r.frames.writers.base import SequenceWriter, jpeg

SURE = 2
"""Confidence of depth that is known (stored 0, 1, 2)."""


class Record3dWriter(SequenceWriter):
    """Writes `walk.r3d` frame by frame; depth may have another size than the pictures, and shares their view."""

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        super().__init__(folder, camera, fps)
        self._pack = import_lzfse().compress
        self._depth_size: tuple[int, int] | None = None
        self._poses: list[list[float]] = []
        self._times: list[float] = []
        self._archive = zipfile.ZipFile(folder / "walk.r3d", "w", zipfile.ZIP_STORED)

    def add(self, frame: Frame, confidence: NDArray[np.uint8] | None = None) -> None:
        """Write a frame; without a `confidence` (0, 1, 2) of the depth's size known depth counts as sure.

        A frame without a pose gets a quaternion of zeros, which is no rotation.
        """
        k, depth, T = len(self._times), frame.depth, frame.T_source_cam
        self._archive.writestr(f"rgbd/{k}.jpg", jpeg(frame.color))
        if depth is not None:
            self._depth_size = depth.shape[0], depth.shape[1]
            sure = np.where(depth > 0, SURE, 0) if confidence is None else confidence
            known = np.where(depth > 0, depth, np.nan).astype("<f4")
            self._archive.writestr(f"rgbd/{k}.depth", self._pack(known.tobytes()))
            self._archive.writestr(f"rgbd/{k}.conf", self._pack(sure.astype(np.uint8).tobytes()))
        self._poses.append([0.0] * 7 if T is None else _row(arkit_of_pose(T)))
        self._times.append(frame.time_s)

    def close(self) -> None:
        self._archive.writestr("metadata", json.dumps(self._metadata()))
        self._archive.close()

    def _metadata(self) -> dict[str, object]:
        c = self._camera
        metadata: dict[str, object] = {"w": c.width, "h": c.height, "fps": self._fps, "poses": self._poses}
        metadata |= {"K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1], "frameTimestamps": self._times}
        if self._depth_size is not None:
            metadata |= {"dw": self._depth_size[1], "dh": self._depth_size[0]}
        return metadata


def _row(T_world_arkit: NDArray[np.float64]) -> list[float]:
    return [*Rotation.from_matrix(T_world_arkit[:3, :3]).as_quat().tolist(), *T_world_arkit[:3, 3].tolist()]
