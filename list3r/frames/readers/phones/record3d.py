"""A recording of Record3D: an `.r3d` file (a zip), or the folder that it unpacks to.

`metadata` is JSON: `K` has nine numbers column by column for pictures of `w` x `h`, depth has `dw` x `dh`; `poses` are
[qx qy qz qw tx ty tz], camera-to-world with ARKit's axes and y up. `rgbd/N.depth` is float32 metres packed with LZFSE,
NaN where unknown; `rgbd/N.conf` is 0, 1 or 2. Recordings of the front camera have no depth of a room and no poses.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import MAX_TEXT_BYTES
from list3r.frames.layout import FolderLayout, Optics, read_json
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions, check_intrinsics
from list3r.frames.recordings.axes import pose_of_arkit, pose_of_quaternion
from list3r.frames.recordings.stored import CodedArray, Stored, ZipMember
from list3r.memory.errors import OptionError, SourceError
from list3r.memory.unpacking import open_archive, parse_json

LEAST_CONFIDENCE = 2
"""Only what the sensor is most sure of (stored 0, 1, 2); lesser depth lies along edges."""
_PICTURE = re.compile(r"rgbd/(\d{1,9})\.jpg")
_MOST_METADATA = MAX_TEXT_BYTES
_MOST_DEPTH_PIXELS = 2**19
"""Of one depth image; phones have up to 640x480."""
_VARIES = 0.01
"""Focal lengths of frames that differ by a larger share are told of: one camera serves all frames."""


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout of an unpacked recording, or None for another folder."""
    if not ((root / "metadata").is_file() and (root / "rgbd").is_dir()):
        return None
    present = {f"rgbd/{p.name}" for p in (root / "rgbd").iterdir()}
    return _layout(root, read_json(root / "metadata"), present, lambda name: root / name, options)


def find_file(path: Path, options: SourceOptions) -> FolderLayout:
    """The frames of an `.r3d` file; they stay in it. Raises `SourceError` for a file that is none."""
    try:
        with open_archive(path) as archive:
            members = set(archive.namelist())
            if "metadata" not in members:
                raise SourceError(f"{path} holds no `metadata`; export it from Record3D as .r3d")
            if archive.getinfo("metadata").file_size > _MOST_METADATA:
                raise SourceError(f"{path}: its metadata unpacks to more than {_MOST_METADATA} bytes")
            content = parse_json(archive.read("metadata"))
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise SourceError(f"{path} is no whole zip file ({error}); was the upload finished?") from None
    except ValueError as error:
        raise SourceError(f"{path}: its metadata is not JSON ({error}); export it from Record3D again") from None
    return _layout(path, content, members, lambda name: ZipMember(path, name), options)


def _layout(
    where: Path, content: object, present: set[str], stored: Callable[[str], Stored], options: SourceOptions
) -> FolderLayout:
    if not isinstance(content, dict):
        raise SourceError(f"{where}: its metadata is no table; export it from Record3D again")
    named = (_PICTURE.fullmatch(name) for name in present)
    numbers = sorted(int(found[1]) for found in named if found)
    if not numbers:
        raise SourceError(f"{where} holds no pictures rgbd/N.jpg; was the upload finished?")
    width, height, depth_size, intrinsics = _cameras(where, content)
    poses, times = _poses(content), content.get("frameTimestamps")
    fps = content.get("fps")
    files, with_depth = [], False
    for k in numbers:
        depth, confidence = (
            CodedArray(stored(f"rgbd/{k}.{end}"), "lzfse", dtype, depth_size)
            if depth_size is not None and f"rgbd/{k}.{end}" in present
            else None
            for end, dtype in (("depth", "<f4"), ("conf", "|u1"))
        )
        with_depth = with_depth or depth is not None
        pose = poses[k] if k < len(poses) else None
        files.append(FrameFile(stored(f"rgbd/{k}.jpg"), depth, None, pose, _time(times, k, fps), confidence))
    size = (height, width)
    optics = Optics(options.intrinsics or intrinsics, (), intrinsics, np.eye(4), 1.0, size, size)
    if not with_depth:
        optics = Optics(options.intrinsics or intrinsics, intrinsics_size=size)
    notes = ["camera and poses of Record3D (ARKit)"]
    spread = _focal_spread(content)
    if spread > _VARIES:
        notes.append(f"focal lengths of frames differ by {100 * spread:.1f} %: one camera serves all of them")
    lost = sum(p is None for p in poses) + max(0, len(numbers) - len(poses))
    if lost:
        notes.append(f"{lost} of {len(numbers)} frames come without a pose")
    return FolderLayout(
        "record3d",
        FrameFiles(files),
        optics,
        "color",
        intrinsics,
        tuple(notes),
        least_confidence=LEAST_CONFIDENCE,
        z_up=True,
        poses_drift=True,
        upright_tags=False,
    )


def _cameras(where: Path, content: Mapping[str, Any]) -> tuple[int, int, tuple[int, int] | None, Any]:
    """Width and height of pictures, (height, width) of depth, and fx, fy, cx, cy. Raises `SourceError`."""
    try:
        k = [float(v) for v in content["K"]]
        width, height = int(content["w"]), int(content["h"])
        depth = (int(content["dh"]), int(content["dw"])) if "dw" in content else None
        intrinsics = check_intrinsics([k[0], k[4], k[6], k[7]])  # column by column
    except (KeyError, TypeError, ValueError, IndexError, OptionError):
        raise SourceError(f"{where}: its metadata states no camera K with w and h; export it again") from None
    if width < 1 or height < 1 or (depth is not None and not 0 < depth[0] * depth[1] <= _MOST_DEPTH_PIXELS):
        raise SourceError(f"{where}: its metadata states pictures of {width}x{height} and depth of {depth}")
    return width, height, depth, intrinsics


def _poses(content: Mapping[str, Any]) -> list[NDArray[np.float64] | None]:
    rows = content.get("poses")
    out: list[NDArray[np.float64] | None] = []
    for row in rows if isinstance(rows, list) else []:
        good = isinstance(row, list) and len(row) == 7 and all(isinstance(v, int | float) for v in row)
        T_world_arkit = pose_of_quaternion(row[4:], row[:4]) if good else None
        out.append(None if T_world_arkit is None else pose_of_arkit(T_world_arkit))
    return out


def _time(times: object, k: int, fps: object) -> float | None:
    """Seconds of a frame: of the list of times, else by the frame rate."""
    if isinstance(times, list) and k < len(times) and isinstance(times[k], int | float) and math.isfinite(times[k]):
        return float(times[k])
    return k / fps if isinstance(fps, int | float) and fps > 0 else None


def _focal_spread(content: Mapping[str, Any]) -> float:
    """By what share the focal lengths of frames differ, where they are stated one by one."""
    rows = content.get("perFrameIntrinsicCoeffs")
    rows = rows if isinstance(rows, list) else []
    focal = [r[0] for r in rows if isinstance(r, list) and r and isinstance(r[0], int | float)]
    return float(np.ptp(focal) / np.median(focal)) if focal and min(focal) > 0 else 0.0
