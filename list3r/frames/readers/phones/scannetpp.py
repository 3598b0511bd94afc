"""A scan of ScanNet++ by iPhone: `rgb.mp4` or `rgb.mkv`, `depth.bin`, `pose_intrinsic_imu.json`.

As the data set's toolkit reads them: depth of 256 x 192, each frame behind its size in four bytes, either whole
millimetres packed with LZ4 or float metres packed with deflate; a table of `frame_NNNNNN` with `intrinsic` (3 x 3, of
the video) and `aligned_pose` (camera-to-world with OpenCV's axes, in the world of the laser scan).
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.layout import VARIES, pose_matrix, read_json, varies_note
from list3r.frames.options import Intrinsics, SourceOptions, intrinsics_of_matrix
from list3r.frames.readers.video_depth import RecordingParts, VideoWithDepth
from list3r.frames.recordings.stored import CodedArray, FileSlice
from list3r.memory.core.errors import FrameError, OptionError, SourceError

_SIZE = (192, 256)
_TABLE, _DEPTH = "pose_intrinsic_imu.json", "depth.bin"
_NAME = re.compile(r"frame_(\d{1,9})")


def is_recording(root: Path) -> bool:
    """Return whether a folder is such a scan, or holds one in `iphone/`."""
    return any((base / _TABLE).is_file() and _video(base) is not None for base in (root, root / "iphone"))


def open_scan(root: Path, options: SourceOptions) -> VideoWithDepth:
    """Return the frames of a scan. Raises `SourceError` and `OptionError`."""
    base = root if (root / _TABLE).is_file() else root / "iphone"
    video = _video(base)
    assert video is not None
    stated, poses = _cameras(base / _TABLE)
    fx, fy, cx, cy = np.median(list(stated.values()), axis=0).tolist()
    spread = float(np.ptp([row[0] for row in stated.values()]) / fx)
    carried = spread > VARIES and options.intrinsics is None and not options.distortion
    note = f"cameras and poses of {_TABLE}, aligned to the laser scan"
    depth, units = _depth(base / _DEPTH) if (base / _DEPTH).is_file() else ({}, 1000.0)
    parts = RecordingParts(
        "scannetpp",
        video,
        options.intrinsics or (fx, fy, cx, cy),
        depth,
        poses,
        units,
        f"{note}; {varies_note(spread, carried)}" if spread > VARIES else note,
        lenses=stated if carried else {},
    )
    return VideoWithDepth(root, parts, options)


def _video(base: Path) -> Path | None:
    return next((base / n for n in ("rgb.mp4", "rgb.mkv") if (base / n).is_file()), None)


def _cameras(path: Path) -> tuple[dict[int, Intrinsics], dict[int, NDArray[np.float64]]]:
    """Cameras and poses by frame number. Raises `SourceError`."""
    content = read_json(path)
    rows = {int(m[1]): v for k, v in content.items() if (m := _NAME.fullmatch(k))} if isinstance(content, dict) else {}
    if not rows:
        raise SourceError(f"{path} names no frames frame_000000; is it of ScanNet++?")
    try:
        stated = {number: intrinsics_of_matrix(np.ravel(row["intrinsic"]).tolist()) for number, row in rows.items()}
        found = {number: _pose(row) for number, row in rows.items()}
    except (KeyError, TypeError, ValueError, OptionError):
        raise SourceError(
            f"{path}: a frame lacks intrinsic (3 x 3) or aligned_pose (4 x 4); fix or remove it"
        ) from None
    return stated, {number: T for number, T in found.items() if T is not None}


def _pose(row: Mapping[str, Any]) -> NDArray[np.float64] | None:
    return pose_matrix(np.asarray(row.get("aligned_pose", row["pose"]), np.float64).ravel().tolist())


def _depth(path: Path) -> tuple[dict[int, CodedArray], float]:
    """Where the depth of each frame lies, and its units per metre. Raises `SourceError`."""
    size, places = path.stat().st_size, list[tuple[int, int]]()
    with path.open("rb") as file:
        at = 0
        while at + 4 <= size:
            length = int.from_bytes(file.read(4), "little")
            if not 0 < length <= size - at - 4:
                break
            places.append((at + 4, length))
            at = file.seek(at + 4 + length)
    if not places:
        raise SourceError(f"{path} has no frames one by one; unpack it with the data set's toolkit")
    slices = [FileSlice(path, start, length, f"depth {k}") for k, (start, length) in enumerate(places)]
    for codec, dtype, units in (("lz4", "<u2", 1000.0), ("deflate", "<f4", 1.0)):
        try:
            CodedArray(slices[0], codec, dtype, _SIZE).decode()  # type: ignore[arg-type]
        except (FrameError, zlib.error):
            continue
        return {k: CodedArray(s, codec, dtype, _SIZE) for k, s in enumerate(slices)}, units  # type: ignore[arg-type]
    raise SourceError(f"{path} is packed in no known way (LZ4, deflate); is the copy complete?")
