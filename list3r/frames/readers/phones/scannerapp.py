"""The export "All data" of 3D Scanner App: `frame_N.jpg` with `frame_N.json`, `depth_N.png`, `conf_N.png`, in a folder.

Each JSON has `intrinsics`, nine numbers row by row for the picture beside it, and `cameraPoseARFrame`, camera-to-world
row by row with ARKit's axes and y up. Depth is in millimetres, confidence 0, 1, 2 or as brightness.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from list3r.frames.beside import listed
from list3r.frames.layout import FolderLayout, pose_matrix, read_json
from list3r.frames.listing import FrameFile
from list3r.frames.options import SourceOptions, intrinsics_of_matrix
from list3r.frames.readers.phones.scan import scan_layout, there
from list3r.frames.recordings.axes import pose_of_arkit
from list3r.memory.core.errors import OptionError, SourceError

_PICTURE = re.compile(r"frame_(\d+)\.(jpg|jpeg|png)", re.IGNORECASE)


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None for another folder. Raises `SourceError` for cameras that cannot be read."""
    colors = [p for p in listed(root, (".jpg", ".jpeg", ".png")) if _PICTURE.fullmatch(p.name)]
    tables = {p: p.with_suffix(".json") for p in colors}
    if not colors or not any(path.is_file() for path in tables.values()):
        return None
    stated = {p: _table(path) for p, path in tables.items() if path.is_file()}
    files = [
        FrameFile(
            p,
            there(root / f"depth_{p.stem[6:]}.png"),
            T_source_camera=stated[p][1] if p in stated else None,
            time_s=stated[p][2] if p in stated else None,
            confidence=there(root / f"conf_{p.stem[6:]}.png"),
        )
        for p in colors
    ]
    cameras = [stated[p][0] if p in stated else None for p in colors]
    layout = scan_layout("scannerapp", files, cameras, root, options, "cameras and poses of 3D Scanner App (ARKit)")
    return replace(layout, poses_drift=True, read=("info.json", *(path.name for path in tables.values())))


def _table(path: Path) -> tuple[list[float], Any, float | None]:
    """fx, fy, cx, cy, the pose and seconds of a picture. Raises `SourceError`."""
    content: Any = read_json(path)
    try:
        T = pose_matrix(float(v) for v in np.ravel(content["cameraPoseARFrame"]))
        camera = intrinsics_of_matrix([float(v) for v in np.ravel(content["intrinsics"])])
        time_s = float(content["time"]) if "time" in content else None
    except (KeyError, TypeError, ValueError, IndexError, OptionError):
        raise SourceError(f"{path} lacks intrinsics or cameraPoseARFrame of 3D Scanner App; export it again") from None
    return list(camera), None if T is None else pose_of_arkit(T), time_s
