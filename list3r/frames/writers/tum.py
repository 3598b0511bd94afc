"""Write the TUM RGB-D layout, see `list3r.frames.readers.tum`."""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera, Frame
from list3r.frames.writers.base import numbers, put
from list3r.frames.writers.pictures import jpeg, png16

UNITS_PER_M = 5000.0


class TumWriter:
    """`rgb/`, `depth/` (5000 units a metre), their lists, `groundtruth.txt` and `calibration.txt`."""

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        self._folder, self._camera = folder, camera
        self._lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}

    def add(self, frame: Frame) -> None:
        """Write a frame."""
        stem, time = f"{frame.index:06d}", f"{frame.time_s:.6f}"
        put(self._folder / f"rgb/{stem}.jpg", jpeg(frame.color))
        self._lists["rgb"].append(f"{time} rgb/{stem}.jpg")
        if frame.depth is not None:
            put(self._folder / f"depth/{stem}.png", png16(frame.depth, UNITS_PER_M))
            self._lists["depth"].append(f"{time} depth/{stem}.png")
        if frame.T_source_cam is not None:
            quat_xyzw = Rotation.from_matrix(frame.T_source_cam[:3, :3]).as_quat()
            row = f"{time} {numbers(frame.T_source_cam[:3, 3])} {numbers(quat_xyzw)}"
            self._lists["groundtruth"].append(row)

    def close(self) -> None:
        """Write the lists and the camera."""
        c = self._camera
        for name, rows in self._lists.items():
            if rows:
                put(self._folder / f"{name}.txt", "\n".join(rows) + "\n")
        put(self._folder / "calibration.txt", f"{c.fx} {c.fy} {c.cx} {c.cy}\n")
