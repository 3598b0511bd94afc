"""Polycam's raw export: `keyframes/` with pictures, cameras, depth and confidence, named by microseconds.

Layout as described by Polycam (github.com/PolyCam/polyform): camera-to-world rows t_00 to t_23 with ARKit's axes and y
up, depth in millimetres, confidence 0, 127 or 255. The optimised cameras (`corrected_*`) are taken where they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import VARIES, FolderLayout, Optics, own_camera, pose_matrix, read_json, there, varies_note
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions, check_intrinsics
from list3r.frames.recordings.axes import pose_of_arkit
from list3r.memory.core.errors import OptionError, SourceError

LEAST_CONFIDENCE = 1
"""Depth of confidence 0 is unknown (stored 0, 127, 255 for 0, 1, 2)."""


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
    known = np.array([stated for _, stated, _ in rows if stated is not None])
    if not len(known):
        raise SourceError(f"{cameras} states the camera of no picture; is the copy complete?")
    fx, fy, cx, cy, width, height = np.median(known, axis=0).tolist()
    spread = float(np.ptp(known[:, 0]) / fx) if fx > 0 and options.intrinsics is None else 0.0
    files = FrameFiles(
        FrameFile(
            color,
            there(base / "depth" / f"{color.stem}.png"),
            T_source_camera=pose,
            time_s=1e-6 * int(color.stem) if color.stem.isdigit() else None,
            confidence=there(base / "confidence" / f"{color.stem}.png"),
            lens=own_camera(stated, cameras) if stated is not None and spread > VARIES else None,
        )
        for color, stated, pose in rows
    )
    notes = ["cameras of Polycam" + (", optimised by it" if optimised else " as ARKit tracked them")]
    if spread > VARIES:
        notes.append(varies_note(spread, carried=True))
    try:
        intrinsics = options.intrinsics or check_intrinsics([fx, fy, cx, cy])
    except OptionError as error:
        raise SourceError(f"{cameras}: {error}") from None
    size = (round(height), round(width))
    optics = Optics(intrinsics, depth_scale=1000.0, intrinsics_size=size, shares_view=True)
    return FolderLayout(
        "polycam",
        files,
        optics,
        "color",
        intrinsics,
        tuple(notes),
        least_confidence=LEAST_CONFIDENCE,
        z_up=True,
        poses_drift=not optimised,
        upright_tags=False,
    )


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
