"""A scene of ScanNet: unpacked (`color/`, `depth/`, `pose/`, `intrinsic/`), or a `.sens` file as it was recorded.

The `.sens` header, version 4, little-endian: name, four 4x4 matrices (intrinsics and extrinsics of colour and depth),
codecs, sizes, units a metre, number of frames; then for each frame its pose, two times in microseconds, the sizes of
its picture and depth, and these. Poses are camera-to-world with OpenCV's axes; minus infinity where tracking was lost.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import FolderLayout, Optics, natural_key, pose_matrix, read_camera_matrix, read_numbers
from list3r.frames.listing import FrameFile, FrameFiles
from list3r.frames.options import SourceOptions, intrinsics_of_matrix
from list3r.frames.recordings.stored import CodedArray, FileSlice
from list3r.memory.core.errors import SourceError

_VERSION = 4
_MATRIX = struct.Struct("<16f")
_SIZES = struct.Struct("<iiIIIIfQ")
"""Codecs of colour (2: JPEG) and depth (1: zlib); width, height of colour and of depth; units a metre; frames."""
_FRAME = struct.Struct("<16fQQQQ")
_JPEG, _ZLIB = 2, 1
_LONGEST_NAME = 4096
_MOST_FRAMES = 2**18
"""Of one file: two hours."""


def find(root: Path, options: SourceOptions) -> FolderLayout | None:
    """The unpacked layout, or None for another folder. Raises `SourceError` for cameras that cannot be read."""
    if not all((root / name).is_dir() for name in ("color", "depth", "pose", "intrinsic")):
        return None
    colors = sorted((root / "color").glob("*.jpg"), key=lambda p: natural_key(p.name))
    files = FrameFiles(
        FrameFile(color, root / "depth" / f"{color.stem}.png", root / "pose" / f"{color.stem}.txt") for color in colors
    )
    cameras = [read_camera_matrix(root / "intrinsic" / f"intrinsic_{name}.txt") for name in ("color", "depth")]
    optics = Optics(options.intrinsics or cameras[0], (), cameras[1], _extrinsics(root), 1000.0)
    return FolderLayout("scannet", files, optics, "depth", None, ("cameras of intrinsic/",), upright_tags=False)


def find_file(path: Path, options: SourceOptions) -> FolderLayout:
    """The frames of a `.sens` file; its pictures stay in it. Raises `SourceError` for a file that is none."""
    with path.open("rb") as file:
        (version,) = struct.unpack("<I", _exactly(file, 4, path))
        (length,) = struct.unpack("<Q", _exactly(file, 8, path))
        if version != _VERSION or length > _LONGEST_NAME:
            raise SourceError(f"{path} is not a .sens file of version 4; unpack the scene with ScanNet's reader")
        _exactly(file, length, path)
        color_k, color_e, depth_k, depth_e = (_matrix(file, path) for _ in range(4))
        codec, depth_codec, width, height, depth_width, depth_height, units, count = _SIZES.unpack(
            _exactly(file, _SIZES.size, path)
        )
        if codec != _JPEG or depth_codec != _ZLIB:
            raise SourceError(
                f"{path} has pictures of codec {codec}, depth of codec {depth_codec}; JPEG and zlib are read"
            )
        if not (units > 0 and 0 < depth_width * depth_height <= 2**26):
            raise SourceError(f"{path} states depth of {depth_width}x{depth_height} with {units:g} units a metre")
        files, whole = _frames(file, path, count, (depth_height, depth_width))
    if not files:
        raise SourceError(f"{path} holds no frame; is the copy complete?")
    notes = [] if whole else [f"the file ends after {len(files)} of {count} frames; is the copy complete?"]
    depth = intrinsics_of_matrix(depth_k.ravel().tolist())
    color = options.intrinsics or intrinsics_of_matrix(color_k.ravel().tolist())
    T_color_depth = _rigid_or_identity(np.linalg.inv(color_e) @ depth_e)
    optics = Optics(color, (), depth, T_color_depth, units, (height, width))
    return FolderLayout("scannet", FrameFiles(files), optics, "depth", None, tuple(notes), upright_tags=False)


def _frames(file: BinaryIO, path: Path, count: int, size: tuple[int, int]) -> tuple[list[FrameFile], bool]:
    """The frames that the file holds, and whether these are all."""
    end = path.stat().st_size
    files: list[FrameFile] = []
    while len(files) < min(count, _MOST_FRAMES):
        head = file.read(_FRAME.size)
        if len(head) < _FRAME.size:
            return files, False
        *pose, color_us, _, color_bytes, depth_bytes = _FRAME.unpack(head)
        start, number = file.tell(), len(files)
        if not color_bytes or start + color_bytes + depth_bytes > end:
            return files, False
        color = FileSlice(path, start, color_bytes, f"frame-{number:06d}.jpg")
        depth = FileSlice(path, start + color_bytes, depth_bytes, f"frame-{number:06d}.depth")
        packed = CodedArray(depth, "zlib", "<u2", size)
        time_s = 1e-6 * color_us if color_us or not number else None  # a clock may begin at 0; no clock is all 0
        files.append(FrameFile(color, packed, T_source_camera=pose_matrix(pose), time_s=time_s))
        file.seek(color_bytes + depth_bytes, 1)
    return files, len(files) == count


def _exactly(file: BinaryIO, count: int, path: Path) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise SourceError(f"{path} ends within its header; is the copy complete?")
    return data


def _matrix(file: BinaryIO, path: Path) -> NDArray[np.float64]:
    return np.array(_MATRIX.unpack(_exactly(file, _MATRIX.size, path)), np.float64).reshape(4, 4)


def _extrinsics(root: Path) -> NDArray[np.float64]:
    """From the depth to the colour camera, by the extrinsics of both where they are written."""
    found = []
    for name in ("color", "depth"):
        path = root / "intrinsic" / f"extrinsic_{name}.txt"
        rows = read_numbers(path) if path.is_file() else []
        pose = pose_matrix(v for row in rows for v in row)
        found.append(np.eye(4) if pose is None else pose)
    return np.asarray(np.linalg.inv(found[0]) @ found[1])


def _rigid_or_identity(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = pose_matrix(matrix.ravel().tolist()) if np.isfinite(matrix).all() else None
    return np.eye(4) if pose is None else pose
