"""Writers of folders of pictures: the layouts of TUM RGB-D, nerfstudio, COLMAP and Replica, see the readers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from list3r.frames.base import Camera, Frame
from list3r.frames.recordings.axes import OPENGL_TO_OPENCV
from list3r.frames.writers.base import SequenceWriter, jpeg, numbers, png16

TUM_UNITS_PER_M, TRANSFORMS_UNITS_PER_M, REPLICA_UNITS_PER_M = 5000.0, 1000.0, 6553.5


class TumWriter(SequenceWriter):
    """`rgb/`, `depth/` (5000 units a metre), their lists, `groundtruth.txt` and `calibration.txt`."""

    most_depth_m = 13.1

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        super().__init__(folder, camera, fps)
        self._lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}

    def add(self, frame: Frame) -> None:
        stem, time = f"{frame.index:06d}", f"{frame.time_s:.6f}"
        self.put(f"rgb/{stem}.jpg", jpeg(frame.color))
        self._lists["rgb"].append(f"{time} rgb/{stem}.jpg")
        if frame.depth is not None:
            self.put(f"depth/{stem}.png", png16(frame.depth, TUM_UNITS_PER_M))
            self._lists["depth"].append(f"{time} depth/{stem}.png")
        if frame.T_source_cam is not None:
            quat_xyzw = Rotation.from_matrix(frame.T_source_cam[:3, :3]).as_quat()
            row = f"{time} {numbers(frame.T_source_cam[:3, 3])} {numbers(quat_xyzw)}"
            self._lists["groundtruth"].append(row)

    def close(self) -> None:
        c = self._camera
        for name, rows in self._lists.items():
            if rows:
                self.put(f"{name}.txt", "\n".join(rows) + "\n")
        self.put("calibration.txt", f"{c.fx} {c.fy} {c.cx} {c.cy}\n")


class TransformsWriter(SequenceWriter):
    """`images/`, `depth/` (millimetres) and `transforms.json`; frames without a pose have no place in it."""

    unposed, most_depth_m = False, 65.5

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        super().__init__(folder, camera, fps)
        self._frames: list[dict[str, Any]] = []

    def add(self, frame: Frame) -> None:
        if frame.T_source_cam is None:
            return
        stem = f"frame_{frame.index:06d}"
        entry: dict[str, Any] = {"file_path": f"images/{stem}.jpg"}
        self.put(entry["file_path"], jpeg(frame.color))
        if frame.depth is not None:
            entry["depth_file_path"] = f"depth/{stem}.png"
            self.put(entry["depth_file_path"], png16(frame.depth, TRANSFORMS_UNITS_PER_M))
        entry["transform_matrix"] = (frame.T_source_cam @ OPENGL_TO_OPENCV).tolist()
        self._frames.append(entry)

    def close(self) -> None:
        c, unit_m = self._camera, 1.0 / TRANSFORMS_UNITS_PER_M
        transforms = {"camera_model": "OPENCV", "w": c.width, "h": c.height}
        transforms |= {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "depth_unit_scale_factor": unit_m}
        self.put("transforms.json", json.dumps({**transforms, "frames": self._frames}, indent=1))


class ColmapWriter(SequenceWriter):
    """`images/` and `sparse/0/` with one PINHOLE camera and no points; frames without a pose are pictures only."""

    depth = False

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        super().__init__(folder, camera, fps)
        self._rows: list[str] = []

    def add(self, frame: Frame) -> None:
        name = f"{frame.index:06d}.jpg"
        self.put(f"images/{name}", jpeg(frame.color))
        if frame.T_source_cam is not None:
            T_cam_world = np.linalg.inv(frame.T_source_cam)
            quat_wxyz = np.roll(Rotation.from_matrix(T_cam_world[:3, :3]).as_quat(), 1)
            place = numbers(T_cam_world[:3, 3])
            self._rows.append(f"{len(self._rows) + 1} {numbers(quat_wxyz)} {place} 1 {name}\n\n")

    def close(self) -> None:
        c = self._camera  # the model's pixel (0, 0) is the corner of the upper left pixel
        lens = f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx + 0.5} {c.cy + 0.5}\n"
        for name, text in (("cameras", lens), ("images", "".join(self._rows)), ("points3D", "")):
            self.put(f"sparse/0/{name}.txt", text)


class ReplicaWriter(SequenceWriter):
    """`results/frame*.jpg`, `results/depth*.png`, `traj.txt` and `cam_params.json`, numbered again from 0.

    Frames without a pose are left out, because `traj.txt` has a row for every picture.
    """

    unposed, most_depth_m = False, 10.0

    def __init__(self, folder: Path, camera: Camera, fps: float) -> None:
        super().__init__(folder, camera, fps)
        self._rows: list[str] = []

    def add(self, frame: Frame) -> None:
        if frame.T_source_cam is None:
            return
        stem = f"{len(self._rows):06d}"
        self.put(f"results/frame{stem}.jpg", jpeg(frame.color))
        if frame.depth is not None:
            self.put(f"results/depth{stem}.png", png16(frame.depth, REPLICA_UNITS_PER_M))
        self._rows.append(numbers(frame.T_source_cam))

    def close(self) -> None:
        c = self._camera
        camera = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
        self.put("traj.txt", "\n".join(self._rows) + "\n")
        self.put("cam_params.json", json.dumps({"camera": camera | {"scale": REPLICA_UNITS_PER_M}}, indent=1))
