"""Write the Replica layout of NICE-SLAM, see `list3r.frames.readers.replica`."""

from __future__ import annotations

import json
from pathlib import Path

from list3r.frames.base import Camera, Frame
from list3r.frames.writers.base import numbers, put
from list3r.frames.writers.pictures import jpeg, png16

UNITS_PER_M = 6553.5


class ReplicaWriter:
    """`results/frame*.jpg`, `results/depth*.png`, `traj.txt` and `cam_params.json`, numbered again from 0.

    Frames without a pose are left out, because `traj.txt` has a row for every picture.
    """

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        self._folder, self._camera = folder, camera
        self._rows: list[str] = []

    def add(self, frame: Frame) -> None:
        """Write a frame that has a pose."""
        if frame.T_source_cam is None:
            return
        stem = f"{len(self._rows):06d}"
        put(self._folder / f"results/frame{stem}.jpg", jpeg(frame.color))
        if frame.depth is not None:
            put(self._folder / f"results/depth{stem}.png", png16(frame.depth, UNITS_PER_M))
        self._rows.append(numbers(frame.T_source_cam))

    def close(self) -> None:
        """Write the poses and the camera."""
        c = self._camera
        camera = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": UNITS_PER_M}
        put(self._folder / "traj.txt", "\n".join(self._rows) + "\n")
        put(self._folder / "cam_params.json", json.dumps({"camera": camera}, indent=1))
