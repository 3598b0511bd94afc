"""A plain folder of images in natural order, with depth, confidence, poses and camera beside them where they are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from list3r.frames.beside import FoundFrames, Pairs, listed, look, pair
from list3r.frames.layout import FolderLayout, Optics
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions
from list3r.frames.readers.tum import poses_at
from list3r.frames.recordings.camera_files import StatedCamera, read_camera
from list3r.frames.recordings.pose_lists import PoseList, read_pose_list
from list3r.frames.recordings.stamps import times_of_names
from list3r.memory.core.errors import SourceError

_POSE_FILES = re.compile(r"(\w+_)?(poses|traj|trajectory|groundtruth)\.(txt|csv|log)|.*\.(log|traj)", re.IGNORECASE)
_POSE_FOLDERS = ("pose", "poses")
_BASE_POSES = ("rtabmap_poses.txt",)
"""Poses of a robot's base, whose x points ahead, not of its camera."""
_MILLIMETRES = 1000.0


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout, or None when there are no images in the folder or in the one of its folders that is named as such.

    Raises `SourceError` for depth or poses that belong to none of the pictures.
    """
    found = look(root, alone=options.kind == "images")
    if found is None:
        return None
    depths, confidences = (_pairs(root, found, files, what) for files, what in _beside(found))
    times_s = times_of_names(found.colors) if depths is None or depths.times_s is None else depths.times_s
    poses, pose_files, read = _poses(root, found.colors, times_s)
    none: list[Path | None] = [None] * len(found.colors)
    files = FrameFiles(
        FrameFile(color, depth, file, pose, time_s, sure)
        for color, depth, file, pose, time_s, sure in zip(
            found.colors,
            depths.files if depths else none,
            pose_files,
            poses,
            none if times_s is None else times_s.tolist(),
            confidences.files if confidences else none,
            strict=True,
        )
    )
    camera = _camera(root, options)
    notes = [f"depth belongs to the pictures by {depths.how}"] if depths else []
    if depths and (alone := len(found.depths) - len(set(depths.files) - {None})):
        notes.append(f"{alone} of {len(found.depths)} depth images belong to no picture")
    if confidences:
        notes.append("depth of confidence 0 is not used")
    notes += [f"poses of {name}" for name in read]
    scale = camera.depth_scale if camera else None
    if scale is None and found.depths and "rtabmap" in found.depths[0].parent.name:
        scale = _MILLIMETRES
    if camera is None:
        optics = Optics(depth_scale=scale)
    else:
        notes.append(f"intrinsics of {camera.name}")
        read = (*read, camera.name)
        optics = Optics(camera.intrinsics, camera.distortion, depth_scale=scale, intrinsics_size=camera.size)
        if depths and not camera.distortion:
            optics = Optics(camera.intrinsics, depth_scale=scale, intrinsics_size=camera.size, shares_view=True)
    return FolderLayout(
        "images",
        files,
        optics,
        "color",
        camera.intrinsics if camera else None,
        (*notes, *found.notes),
        least_confidence=1 if confidences else None,
        read=(*read, *((depths.how,) if depths else ())),
    )


def _camera(root: Path, options: SourceOptions) -> StatedCamera | None:
    """The camera of a file. Raises `SourceError` for a file without one, unless the user says it."""
    try:
        return read_camera(root)
    except SourceError:
        if options.intrinsics is None:
            raise
        return None


def _beside(found: FoundFrames) -> tuple[tuple[list[Path], str], ...]:
    return (found.depths, "depth"), (found.confidences, "confidence")


def _pairs(root: Path, found: FoundFrames, files: list[Path], what: str) -> Pairs | None:
    return pair(root, found.colors, files, what) if files else None


_Poses = tuple[list[NDArray[np.float64] | None], list[Path | None], tuple[str, ...]]


def _poses(root: Path, colors: Sequence[Path], times_s: NDArray[np.float64] | None) -> _Poses:
    """The pose of each picture, or the file that holds it, and the names of what was read.

    Raises `SourceError` for poses that belong to no picture.
    """
    none: list[Path | None] = [None] * len(colors)
    for path in sorted(root.iterdir()):
        if _POSE_FILES.fullmatch(path.name) and path.is_file():
            if path.name in _BASE_POSES:
                raise SourceError(f"{path} has poses of the robot's base; export those of the camera (--poses_camera)")
            return _of_pictures(path, read_pose_list(path), len(colors), times_s), none, (path.name,)
    for name in _POSE_FOLDERS:
        if files := listed(root / name, (".txt",)):
            found = pair(root, colors, files, name)
            return [None] * len(colors), found.files, (f"{name}/",)
    return [None] * len(colors), none, ()


def _of_pictures(
    path: Path, listed: PoseList, count: int, times_s: NDArray[np.float64] | None
) -> list[NDArray[np.float64] | None]:
    """The poses at the pictures' times, or row by row where there are as many. Raises `SourceError` for others."""
    if listed.time_s is not None and times_s is not None and listed.known.any():
        rows = np.flatnonzero(listed.known)
        rows = rows[np.argsort(listed.time_s[rows], kind="stable")]
        turns = Rotation.from_matrix(listed.T[rows, :3, :3]).as_quat()
        found = poses_at(times_s, listed.time_s[rows], np.hstack([listed.T[rows, :3, 3], turns]))
        if any(T is not None for T in found):
            return found
    if len(listed.T) != count:
        raise SourceError(
            f"{path} has {len(listed.T)} poses ({listed.layout}) for {count} pictures"
            + ("" if listed.time_s is None else ", and none is of the time in a picture's name")
            + "; give a row for each picture, or use --poses estimate with the file moved away"
        )
    return [T if known else None for T, known in zip(listed.T, listed.known, strict=True)]
