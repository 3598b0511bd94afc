"""Polycam's raw export: `keyframes/` with pictures, cameras, depth and confidence, named by microseconds.

Layout as described by Polycam (github.com/PolyCam/polyform): camera-to-world rows t_00 to t_23 with ARKit's axes and y
up, depth in millimetres, confidence 0, 127 or 255. The optimised cameras (`corrected_*`) are taken where they are.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import FolderLayout, pose_matrix, read_json
from list3r.frames.listing import FrameFile
from list3r.frames.options import SourceOptions
from list3r.frames.readers.phones.scan import scan_layout, there
from list3r.frames.recordings.axes import pose_of_arkit
from list3r.memory.core.errors import SourceError


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None without `keyframes/images` and cameras. Raises `SourceError` for bad cameras."""
    base = root if root.name == "keyframes" else root / "keyframes"
    optimised = (base / "corrected_images").is_dir() and (base / "corrected_cameras").is_dir()
    images = base / ("corrected_images" if optimised else "images")
    cameras = base / ("corrected_cameras" if optimised else "cameras")
    if base.is_dir() and images.is_dir() and not cameras.is_dir() and (root / "mesh_info.json").is_file():
        raise SourceError(f"{root} is an export of Polycam without keyframes/cameras; is the copy complete?")
    if not (images.is_dir() and cameras.is_dir()):
        return None
    colors = sorted(images.glob("*.jpg"), key=lambda p: (len(p.stem), p.stem))
    rows = [(color, *_camera(cameras / f"{color.stem}.json")) for color in colors]
    files = [
        FrameFile(
            color,
            there(base / "depth" / f"{color.stem}.png"),
            T_source_camera=pose,
            time_s=1e-6 * int(color.stem) if color.stem.isdigit() else None,
            confidence=there(base / "confidence" / f"{color.stem}.png"),
        )
        for color, _, pose in rows
    ]
    note = "cameras of Polycam" + (", optimised by it" if optimised else " as ARKit tracked them")
    layout = scan_layout("polycam", files, [stated for _, stated, _ in rows], cameras, options, note)
    return replace(layout, poses_drift=not optimised)


def _camera(path: Path) -> tuple[list[float] | None, NDArray[np.float64] | None]:
    """fx, fy, cx, cy, width, height and the pose of a picture, None where the file is missing or says no such thing."""
    if not path.is_file():
        return None, None
    content = read_json(path)
    if not isinstance(content, dict):
        raise SourceError(f"{path} is not a camera of Polycam; fix or remove it")
    try:
        stated = [float(content[name]) for name in ("fx", "fy", "cx", "cy", "width", "height")]
        T_world_arkit = pose_matrix(float(content[f"t_{row}{column}"]) for row in range(3) for column in range(4))
    except (KeyError, TypeError, ValueError):
        raise SourceError(f"{path} lacks fx, fy, cx, cy, width, height or t_00 to t_23; fix or remove it") from None
    return stated, None if T_world_arkit is None else pose_of_arkit(T_world_arkit)
