"""A plain folder of images in natural order, with depth and poses beside them if they are there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import (
    IMAGE_ENDINGS,
    FolderLayout,
    Optics,
    natural_key,
    pose_matrix,
    read_calibration,
    read_numbers,
)
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions

_COLOR_FOLDERS = ("images", "rgb", "color", "colour", "image")
_POSE_FILES = ("poses.txt", "traj.txt")


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None when there are no images in the folder or in its `images`, `rgb` or `color`."""
    folder = next((f for f in (root, *(root / name for name in _COLOR_FOLDERS)) if _images(f)), None)
    if folder is None:
        return None
    colors = _images(folder)
    depths = {p.stem: p for p in _listed(root / "depth", (".png", ".npy", ".tif", ".tiff"))} if folder != root else {}
    pose_files = {p.stem: p for p in _listed(root / "pose", (".txt",))} if folder != root else {}
    poses, notes = _poses(root, len(colors))
    files = FrameFiles(
        FrameFile(color, depths.get(color.stem), None if pose is not None else pose_files.get(color.stem), pose)
        for color, pose in zip(colors, poses, strict=True)
    )
    written = read_calibration(root)
    if written is None:
        return FolderLayout("images", files, Optics(), notes=notes)
    optics = Optics(*written)
    return FolderLayout("images", files, optics, "color", written[0], ("intrinsics of calibration.txt", *notes))


def _images(folder: Path) -> list[Path]:
    return _listed(folder, IMAGE_ENDINGS)


def _listed(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    """Files of these endings that are not hidden, in natural order; empty for what is not a folder."""
    if not folder.is_dir():
        return []
    found = (p for p in folder.iterdir() if p.name.lower().endswith(endings) and not p.name.startswith("."))
    return sorted((p for p in found if p.is_file()), key=lambda p: natural_key(p.name))


def _poses(root: Path, count: int) -> tuple[list[NDArray[np.float64] | None], tuple[str, ...]]:
    """Camera-to-world poses, one row of 12 or 16 numbers for each image."""
    path = next((root / name for name in _POSE_FILES if (root / name).is_file()), None)
    if path is None:
        return [None] * count, ()
    rows = read_numbers(path)
    if len(rows) != count:
        return [None] * count, (f"{path.name} has {len(rows)} rows for {count} images and is ignored",)
    return [pose_matrix(row) for row in rows], (f"poses of {path.name}",)
