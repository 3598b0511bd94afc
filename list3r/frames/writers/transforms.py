"""Write nerfstudio's `transforms.json`, see `list3r.frames.readers.nerfstudio`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from list3r.frames.base import Camera, Frame
from list3r.frames.recordings.axes import OPENGL_TO_OPENCV
from list3r.frames.writers.base import put
from list3r.frames.writers.pictures import jpeg, png16

UNITS_PER_M = 1000.0


class TransformsWriter:
    """`images/`, `depth/` (millimetres) and `transforms.json`; frames without a pose have no place in it."""

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        self._folder, self._camera = folder, camera
        self._frames: list[dict[str, Any]] = []

    def add(self, frame: Frame) -> None:
        """Write a frame that has a pose."""
        if frame.T_source_cam is None:
            return
        stem = f"frame_{frame.index:06d}"
        entry: dict[str, Any] = {"file_path": f"images/{stem}.jpg"}
        put(self._folder / entry["file_path"], jpeg(frame.color))
        if frame.depth is not None:
            entry["depth_file_path"] = f"depth/{stem}.png"
            put(self._folder / entry["depth_file_path"], png16(frame.depth, UNITS_PER_M))
        entry["transform_matrix"] = (frame.T_source_cam @ OPENGL_TO_OPENCV).tolist()
        self._frames.append(entry)

    def close(self) -> None:
        """Write the list of frames with the camera."""
        c = self._camera
        transforms = {"camera_model": "OPENCV", "w": c.width, "h": c.height}
        transforms |= {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "depth_unit_scale_factor": 1.0 / UNITS_PER_M}
        put(self._folder / "transforms.json", json.dumps({**transforms, "frames": self._frames}, indent=1))
