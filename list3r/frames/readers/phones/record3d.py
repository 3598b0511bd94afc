"""A recording of Record3D: an `.r3d` file (a zip), or the folder that it unpacks to.

`metadata` is JSON: `K` has nine numbers column by column for pictures of `w` x `h`, depth has `dw` x `dh`; `poses` are
[qx qy qz qw tx ty tz], camera-to-world with ARKit's axes and y up. `rgbd/N.depth` is float32 metres packed with LZFSE,
NaN where unknown; `rgbd/N.conf` is 0, 1 or 2. Recordings of the front camera have the same pose in
every frame, which is none.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.frames.beside import listed
from list3r.frames.files import MAX_TEXT_BYTES
from list3r.frames.layout import IMAGE_ENDINGS, VARIES, FolderLayout, Optics, read_json, varies_note
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import Intrinsics, SourceOptions, check_intrinsics, intrinsics_of_matrix
from list3r.frames.recordings.axes import pose_of_arkit, pose_of_quaternion
from list3r.frames.recordings.stored import CodedArray, Stored, ZipMember
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.core.unpacking import open_archive, parse_json

LEAST_CONFIDENCE = 2
"""Only what the sensor is most sure of (stored 0, 1, 2); lesser depth lies along edges."""
METADATA = "metadata"
_EXPORT = "metadata.json"
"""Of an export "EXR + JPG", which has the same table beside `rgb/` and `depth/`."""
_PICTURE = re.compile(r"rgbd/(\d{1,9})\.jpg")
_MOST_METADATA = MAX_TEXT_BYTES
_LEAST_TURN = 1e-4
"""Of a first pose that says more than that the recording begins there; nobody holds a phone as exactly level."""
_AT_START = pose_of_arkit(np.eye(4))[:3, :3]
_NOT_UPRIGHT = "poses begin at the first picture and do not say which way is up: floors and walls will"
MOST_DEPTH_PIXELS = 2**20
"""Of one depth image; LiDAR has 192x256, the front camera up to 720x960."""


@dataclass(frozen=True)
class PhoneCamera:
    """What a recording states of its camera; depth and pictures share their view."""

    size: tuple[int, int]
    """(height, width) of the pictures that `intrinsics` are of."""
    depth_size: tuple[int, int] | None
    intrinsics: Intrinsics

    @classmethod
    def of(cls, where: Path, content: Mapping[str, Any]) -> Self:
        """Return what the metadata of a recording state. Raises `SourceError`."""
        try:
            size = int(content["h"]), int(content["w"])
            depth = (int(content["dh"]), int(content["dw"])) if "dw" in content else None
            intrinsics = intrinsics_of_matrix([float(v) for v in content["K"]])
        except (KeyError, TypeError, ValueError, IndexError, OptionError):
            raise SourceError(f"{where}: its metadata states no camera K with w and h; export it again") from None
        if min(size) < 1 or (depth is not None and not 0 < depth[0] * depth[1] <= MOST_DEPTH_PIXELS):
            raise SourceError(f"{where}: its metadata states pictures of {size[1]}x{size[0]} and depth of {depth}")
        return cls(size, depth, intrinsics)

    def coded(self, stem: str, stored: Callable[[str], Stored]) -> list[tuple[str, CodedArray | None]]:
        """Return the endings of depth and confidence of a frame, and its files of these endings."""
        kinds, size = ((".depth", "<f4"), (".conf", "|u1")), self.depth_size
        return [(e, None if size is None else CodedArray(stored(stem + e), "lzfse", dtype, size)) for e, dtype in kinds]

    def layout(
        self,
        kind: str,
        files: Iterable[FrameFile],
        first_pose: NDArray[np.float64] | None,
        with_depth: bool,
        options: SourceOptions,
        notes: Sequence[str],
    ) -> FolderLayout:
        """Return the layout of frames of this camera."""
        given = options.intrinsics or self.intrinsics
        if with_depth:
            optics = Optics(given, depth_scale=1.0, intrinsics_size=self.size, shares_view=True)
        else:
            optics = Optics(given, intrinsics_size=self.size)
        up = first_pose is not None and not np.allclose(first_pose[:3, :3], _AT_START, rtol=0.0, atol=_LEAST_TURN)
        return FolderLayout(
            kind,
            FrameFiles(files),
            optics,
            "color",
            self.intrinsics,
            (*notes, *(() if up or first_pose is None else (_NOT_UPRIGHT,))),
            least_confidence=LEAST_CONFIDENCE,
            z_up=up,
            poses_drift=True,
            upright_tags=False,
        )


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The layout of an unpacked recording or of an export "EXR + JPG", or None for another folder."""
    if (root / _EXPORT).is_file() and (root / "rgb").is_dir():
        content = read_json(root / _EXPORT)
        if isinstance(content, dict) and {"K", "w", "h", "poses"} <= set(content):
            return _exported(root, content, options)
    if not ((root / METADATA).is_file() and (root / "rgbd").is_dir()):
        return None
    present = {f"rgbd/{p.name}" for p in (root / "rgbd").iterdir()}
    return _layout(root, read_json(root / METADATA), present, lambda name: root / name, options)


def _exported(root: Path, content: Mapping[str, Any], options: SourceOptions) -> FolderLayout:
    """The layout of `rgb/N.jpg`, `depth/N.exr` with `metadata.json`. Raises `SourceError`."""
    colors = {int(p.stem): p for p in listed(root / "rgb", IMAGE_ENDINGS) if p.stem.isdigit()}
    if not colors:
        raise SourceError(f"{root} holds no pictures rgb/N.jpg; is the copy complete?")
    depths = {int(p.stem): p for p in listed(root / "depth", (".exr", ".npy", ".png")) if p.stem.isdigit()}
    if (root / "depth").exists() and not set(depths) & set(colors):
        raise SourceError(f"{root}: depth/ has no N.exr of a picture rgb/N.jpg; copy it again, or export as .r3d")
    camera, poses, times = PhoneCamera.of(root / _EXPORT, content), _poses(content), content.get("frameTimestamps")
    files = [
        FrameFile(
            colors[k], depths.get(k), None, poses[k] if k < len(poses) else None, _time(times, k, content.get("fps"))
        )
        for k in sorted(colors)
    ]
    first = next((p for p in poses if p is not None), None)
    notes = ["camera and poses of Record3D (ARKit), of metadata.json"]
    layout = camera.layout("record3d", files, first, bool(depths), options, notes)
    return replace(layout, read=(_EXPORT,))


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
        raise SourceError(f"{path} is not a complete zip file ({error}); is the copy complete?") from None
    except ValueError as error:
        raise SourceError(f"{path}: its metadata is not valid JSON ({error}); export it from Record3D again") from None
    return _layout(path, content, members, lambda name: ZipMember(path, name), options)


def _layout(
    where: Path, content: object, present: set[str], stored: Callable[[str], Stored], options: SourceOptions
) -> FolderLayout:
    if not isinstance(content, dict):
        raise SourceError(f"{where}: its metadata is not a table; export it from Record3D again")
    named = (_PICTURE.fullmatch(name) for name in present)
    numbers = sorted(int(found[1]) for found in named if found)
    if not numbers:
        raise SourceError(f"{where} holds no pictures rgbd/N.jpg; is the copy complete?")
    camera = PhoneCamera.of(where, content)
    poses, times = _poses(content), content.get("frameTimestamps")
    fps = content.get("fps")
    spread, lenses = _lenses(content, camera) if options.intrinsics is None else (0.0, [])
    files, with_depth = [], False
    for k in numbers:
        depth, confidence = (
            coded if coded is not None and f"rgbd/{k}{ending}" in present else None
            for ending, coded in camera.coded(f"rgbd/{k}", stored)
        )
        with_depth = with_depth or depth is not None
        pose = poses[k] if k < len(poses) else None
        lens = lenses[k] if k < len(lenses) else None
        time_s = _time(times, k, fps)
        files.append(FrameFile(stored(f"rgbd/{k}.jpg"), depth, None, pose, time_s, confidence, lens=lens))
    notes = ["camera and poses of Record3D (ARKit)"]
    if not any(content["K"][6:8]):
        notes.append("K of its metadata is written row by row, and read so")
    if spread > VARIES:
        notes.append(varies_note(spread, carried=True))
    gaps = numbers[-1] - numbers[0] + 1 - len(numbers)
    if gaps:
        notes.append(f"{gaps} of the pictures {numbers[0]} to {numbers[-1]} are not there; is the copy complete?")
    if _stands(content):
        finite = all(pose_of_row(row) is not None for row in content["poses"])
        why = "every frame states the same pose, as of the front camera" if finite else "no frame states a pose"
        notes.append(f"{why}: poses are not used")
    first = next((p for p in poses if p is not None), None)
    return camera.layout("record3d", files, first, with_depth, options, notes)


def _poses(content: Mapping[str, Any]) -> list[NDArray[np.float64] | None]:
    rows = content.get("poses")
    if _stands(content):
        return []
    return [pose_of_row(row) for row in rows] if isinstance(rows, list) else []


def _stands(content: Mapping[str, Any]) -> bool:
    """Whether several frames have one pose, to the last digit: nobody holds a phone so still."""
    rows = content.get("poses")
    return isinstance(rows, list) and len(rows) > 1 and all(row == rows[0] for row in rows)


def pose_of_row(row: object) -> NDArray[np.float64] | None:
    """Return the pose of qx qy qz qw tx ty tz, z up. Shape (4, 4). None where they are no such numbers."""
    if not (isinstance(row, list) and len(row) == 7 and all(isinstance(v, int | float) for v in row)):
        return None
    T_world_arkit = pose_of_quaternion(row[4:], row[:4])
    return None if T_world_arkit is None else pose_of_arkit(T_world_arkit)


def _time(times: object, k: int, fps: object) -> float | None:
    """Seconds of a frame: of the list of times, else by the frame rate."""
    if isinstance(times, list) and k < len(times) and isinstance(times[k], int | float) and math.isfinite(times[k]):
        return float(times[k])
    return k / fps if isinstance(fps, int | float) and fps > 0 else None


def _lenses(content: Mapping[str, Any], camera: PhoneCamera) -> tuple[float, list[Camera | None]]:
    """Return by what share the focal lengths of frames differ, and the frames' own cameras where that is much.

    `perFrameIntrinsicCoeffs` has fx, fy, cx, cy of each frame; None for one that has no such numbers.
    """
    rows = content.get("perFrameIntrinsicCoeffs")
    height, width = camera.size
    out: list[Camera | None] = []
    for row in rows if isinstance(rows, list) else []:
        try:
            out.append(Camera(width, height, *check_intrinsics([float(v) for v in row[:4]])))
        except (TypeError, ValueError, OptionError):
            out.append(None)
    focal = [lens.fx for lens in out if lens is not None]
    spread = float(np.ptp(focal) / np.median(focal)) if focal else 0.0
    return (spread, out) if spread > VARIES else (spread, [])
