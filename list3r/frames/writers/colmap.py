"""Write a COLMAP model as text, see `list3r.frames.readers.colmap`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera, Frame
from list3r.frames.writers.base import numbers, put
from list3r.frames.writers.pictures import jpeg


class ColmapWriter:
    """`images/` and `sparse/0/` with one PINHOLE camera and no points; frames without a pose are pictures only."""

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        self._folder, self._camera = folder, camera
        self._rows: list[str] = []

    def add(self, frame: Frame) -> None:
        """Write a frame."""
        name = f"{frame.index:06d}.jpg"
        put(self._folder / "images" / name, jpeg(frame.color))
        if frame.T_source_cam is not None:
            T_cam_world = np.linalg.inv(frame.T_source_cam)
            quat_wxyz = np.roll(Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(), 1)
            place = numbers(T_cam_world[:3, 3])
            self._rows.append(f"{len(self._rows) + 1} {numbers(quat_wxyz)} {place} 1 {name}\n\n")

    def close(self) -> None:
        """Write the model; its pixel (0, 0) is the corner of the upper left pixel."""
        c, model = self._camera, self._folder / "sparse/0"
        put(model / "cameras.txt", f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx + 0.5} {c.cy + 0.5}\n")
        put(model / "images.txt", "".join(self._rows))
        put(model / "points3D.txt", "")
