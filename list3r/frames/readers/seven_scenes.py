"""The 7-Scenes layout: `frame-NNNNNN.color.*`, `.depth.png`, `.pose.txt`.

The Kinect of 7-Scenes delivers colour and depth unregistered, and its poses belong to the depth camera. The 585 px of
its `camera-intrinsics.txt` are nominal; the cameras that are taken were measured (research/depth-odometry 0072).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from list3r.frames.layout import FolderLayout, Optics, natural_key, read_camera_matrix
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import Intrinsics, SourceOptions
from list3r.memory.core.errors import SourceError

_COLOR = re.compile(r"^frame-(\d+)\.color\.(png|jpg|jpeg)$", re.IGNORECASE)
KINECT_NOMINAL: Intrinsics = (585.0, 585.0, 320.0, 240.0)
KINECT_DEPTH: Intrinsics = (579.0, 579.0, 320.0, 240.0)
KINECT_COLOR: Intrinsics = (524.0, 524.0, 320.0, 240.0)
KINECT_DISTORTION = (-0.025, 0.0, 0.0, 0.0, 0.0)
KINECT_T_COLOR_DEPTH = np.array(
    [[1.0, 0.0, 0.0, -0.025], [0.0, 1.0, 0.0, -0.004], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None when the folder has another. Raises `SourceError` for several sequences in one folder."""
    folder = _sequence_folder(root)
    if folder is None:
        return None
    names = sorted((p.name for p in folder.iterdir() if _COLOR.match(p.name)), key=natural_key)
    present = {p.name for p in folder.iterdir()}
    files = FrameFiles(_files(folder, name, present) for name in names)
    intrinsics, note = _file_intrinsics(folder, root)
    if _is_kinect(intrinsics):
        optics = Optics(KINECT_COLOR, KINECT_DISTORTION, KINECT_DEPTH, KINECT_T_COLOR_DEPTH, 1000.0)
        known = (
            f"{note}; depth and colour are not registered in 7-Scenes, and its depth camera of 585 px is nominal: the "
            "measured cameras of its Kinect are used"
        )
        return FolderLayout("7scenes", files, optics, "depth", intrinsics, (known,))
    other = (
        "the intrinsics are not those of the 7-Scenes Kinect, so depth is taken as registered into the colour image; "
        "give --depth-intrinsics and --depth-to-color if it is not"
    )
    return FolderLayout("7scenes", files, Optics(intrinsics, depth_scale=1000.0), "color", intrinsics, (note, other))


def _is_kinect(intrinsics: Intrinsics) -> bool:
    return max(abs(a - b) for a, b in zip(intrinsics, KINECT_NOMINAL, strict=True)) <= 1.0


def _sequence_folder(root: Path) -> Path | None:
    if any(_COLOR.match(p.name) for p in root.iterdir()):
        return root
    inside = sorted(p for p in root.glob("seq-*") if p.is_dir() and any(_COLOR.match(q.name) for q in p.iterdir()))
    if len(inside) > 1:
        raise SourceError(f"{root} holds {len(inside)} sequences; name one of them, such as {inside[0]}")
    return inside[0] if inside else None


def _files(folder: Path, name: str, present: set[str]) -> FrameFile:
    stem = name.split(".", 1)[0]
    depth = next((f for f in (f"{stem}.depth.png", f"{stem}.depth.npy") if f in present), f"{stem}.depth.png")
    pose = f"{stem}.pose.txt"
    return FrameFile(folder / name, folder / depth, folder / pose if pose in present else None)


def _file_intrinsics(folder: Path, root: Path) -> tuple[Intrinsics, str]:
    for path in (folder / "camera-intrinsics.txt", root / "camera-intrinsics.txt"):
        if path.is_file():
            return read_camera_matrix(path), f"intrinsics of {path.name}"
    return KINECT_NOMINAL, "no camera-intrinsics.txt: the Kinect of 7-Scenes is assumed"
