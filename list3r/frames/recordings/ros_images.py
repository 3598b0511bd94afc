"""Pictures and depth of ROS messages as arrays, and the cameras that CameraInfo states."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.decoding.decode import decode_picture
from list3r.frames.options import Intrinsics, check_distortion, check_intrinsics
from list3r.frames.recordings.rvl import read_rvl
from list3r.memory.core.errors import FrameError, SourceError

DEPTH_ENCODINGS = {"16UC1": "<u2", "mono16": "<u2", "32FC1": "<f4"}
"""Encodings of depth (REP 118): millimetres as whole numbers, metres as floats."""
_COLORS = {
    "rgb8": None,
    "8UC3": cv2.COLOR_BGR2RGB,
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
}
_PNG_AT = 12
"""Bytes of the header of compressedDepth: a format and two floats of the quantisation."""
_MOST_PIXELS = 2**27


def is_depth(message: Any) -> bool:
    """Return whether an Image or CompressedImage holds depth."""
    if hasattr(message, "encoding"):
        return message.encoding in DEPTH_ENCODINGS
    data = bytes(message.data[:26])
    return (
        "compressedDepth" in message.format
        or message.format.split(";")[0].strip() in DEPTH_ENCODINGS
        or (data.startswith(b"\x89PNG") and data[24:26] == b"\x10\x00")  # one channel of 16 bits
    )


def read_color(message: Any) -> NDArray[np.uint8]:
    """RGB of an Image or CompressedImage. Shape (H, W, 3). Raises `FrameError`."""
    if not hasattr(message, "encoding"):
        return np.asarray(cv2.cvtColor(_decoded(message.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))
    if message.encoding not in _COLORS:
        raise FrameError(f"pictures of encoding {message.encoding} cannot be read; debayer or convert them")
    channels = {"mono8": 1, "8UC1": 1, "rgba8": 4, "bgra8": 4}.get(message.encoding, 3)
    rows = _rows(message, np.dtype(np.uint8), channels)
    change = _COLORS[message.encoding]
    return np.ascontiguousarray(rows) if change is None else np.asarray(cv2.cvtColor(rows, change))


def read_depth(message: Any) -> NDArray[Any]:
    """Depth as stored: whole millimetres or float metres. Shape (H, W). Raises `FrameError`."""
    if hasattr(message, "encoding"):
        if message.encoding not in DEPTH_ENCODINGS:
            raise FrameError(f"pictures of encoding {message.encoding} are no depth ({', '.join(DEPTH_ENCODINGS)} are)")
        kind = np.dtype(DEPTH_ENCODINGS[message.encoding])
        return _rows(message, kind.newbyteorder(">" if message.is_bigendian else "<"), 1).astype(kind)
    data = bytes(message.data)
    if message.format.rstrip().lower().endswith("rvl"):
        return read_rvl(data[_PNG_AT:])
    image = _decoded(data[_PNG_AT:] if data[:4] != b"\x89PNG" else data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise FrameError("a compressed depth image has several channels")
    if image.dtype == np.uint8:
        raise FrameError("a compressed image of 8 bits is no depth")
    if not message.format.startswith("32FC1"):
        return image
    _, a, b = struct.unpack("<iff", data[:_PNG_AT])
    with np.errstate(divide="ignore"):
        return np.where(image > 0, a / (image.astype(np.float32) - b), 0).astype(np.float32)


def _rows(message: Any, kind: np.dtype[Any], channels: int) -> NDArray[Any]:
    """Return the pixels of an Image, without what pads its rows. Shape (H, W) or (H, W, channels)."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    used = width * channels * kind.itemsize
    data = np.asarray(message.data, np.uint8)
    if not 0 < height * width <= _MOST_PIXELS or step < used or len(data) < step * height:
        raise FrameError(f"an image of {width}x{height} in {len(data)} bytes is cut off, or its size is wrong")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :used]).view(kind)
    return rows.reshape((height, width) if channels == 1 else (height, width, channels))


def _decoded(data: Any, flags: int) -> NDArray[Any]:
    image = decode_picture(bytes(data), flags, "a compressed image")
    if image is None:
        raise FrameError("a compressed image cannot be decoded")
    return image


def camera_of(
    info: Any, topic: str, *, rectified: bool
) -> tuple[Intrinsics, tuple[float, ...], tuple[int, int] | None]:
    """fx, fy, cx, cy, the lens (OpenCV's) and (height, width) of a CameraInfo; of rectified pictures by its P.

    Raises `SourceError` for a camera that is not calibrated or a lens that OpenCV's five numbers do not say.
    """
    k = np.asarray(getattr(info, "k", getattr(info, "K", ())), float)
    p = np.asarray(getattr(info, "p", getattr(info, "P", ())), float)
    d = [float(v) for v in getattr(info, "d", getattr(info, "D", ()))]
    m = p if rectified and p.size == 12 and p[0] > 0 else k
    if m.size not in (9, 12) or not m[0] > 0:
        raise SourceError(f"{topic} states no calibrated camera; give --intrinsics fx,fy,cx,cy")
    row = m.size // 3
    intrinsics = check_intrinsics([float(m[0]), float(m[row + 1]), float(m[2]), float(m[row + 2])])
    size = (int(info.height), int(info.width)) if info.height and info.width else None
    if rectified or not any(d):
        return intrinsics, (), size
    if info.distortion_model not in ("plumb_bob", "rational_polynomial", "", "inverse_brown_conrady") or any(d[5:]):
        raise SourceError(f"{topic} states a {info.distortion_model} lens; give rectified pictures (image_proc)")
    return intrinsics, check_distortion(d[:5]), size
