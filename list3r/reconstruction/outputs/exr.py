"""Depth images in OpenEXR, of one channel of floats, as OpenCV writes them.

Scan lines without compression, or with zlib over one line (ZIPS) or sixteen (ZIP). The layout is that of "Technical
Introduction to OpenEXR" and "OpenEXR File Layout" (openexr.com). The wheels of OpenCV read none.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import read_file
from list3r.memory.core.errors import OptionError

_MAGIC = 20000630
_LINES = {0: 1, 2: 1, 3: 16}
"""Scan lines of a block, by the number of the compression."""
_TYPES = {1: "<f2", 2: "<f4"}
_MOST_BYTES, _MOST_SIDE = 2**28, 2**14


def read_exr(path: Path) -> NDArray[np.float32]:
    """Return the one channel of an image. Shape (h, w). Raises `OptionError` for an invalid or damaged file."""
    try:
        return _read(read_file(path, _MOST_BYTES))
    except (ValueError, IndexError, struct.error, zlib.error, KeyError, UnicodeDecodeError) as error:
        raise OptionError(f"{path} is not a depth image in OpenEXR of one channel: {str(error)[:120]}") from None


def _read(data: bytes) -> NDArray[np.float32]:
    magic, version = struct.unpack_from("<II", data)
    if magic != _MAGIC or version & ~0x1FF or version & 0x200:
        raise ValueError("its first bytes are not those of an image in scan lines")
    header, at = _header(data)
    kind = _channel(header["channels"])
    compression = header["compression"][0]
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    width, height, lines = right - left + 1, bottom - top + 1, _LINES[compression]
    if not (0 < width <= _MOST_SIDE and 0 < height <= _MOST_SIDE):
        raise ValueError(f"it claims to be {width} x {height}")
    out = np.zeros((height, width), np.dtype(kind))
    for offset in struct.unpack_from(f"<{-(-height // lines)}Q", data, at):
        y, size = struct.unpack_from("<iI", data, offset)
        rows = min(lines, bottom - y + 1)
        if not 0 <= y - top < height:
            raise ValueError(f"a block begins at line {y}")
        wanted, block = rows * width * out.itemsize, data[offset + 8 : offset + 8 + size]
        raw = block if compression == 0 or size == wanted else _unpacked(block, wanted)
        out[y - top : y - top + rows] = np.frombuffer(raw, kind, rows * width).reshape(rows, width)
    return out.astype(np.float32)


def _header(data: bytes) -> tuple[dict[str, bytes], int]:
    """Return the attributes by name, and where they end."""
    found: dict[str, bytes] = {}
    at = 8
    while data[at] != 0:
        name_end = data.index(b"\0", at)
        type_end = data.index(b"\0", name_end + 1)
        (size,) = struct.unpack_from("<I", data, type_end + 1)
        start = type_end + 5
        found[data[at:name_end].decode()] = data[start : start + size]
        at = start + size
    return found, at + 1


def _channel(said: bytes) -> str:
    """Return the type of the only channel."""
    end = said.index(b"\0")
    kind, _, across, down = struct.unpack_from("<iIii", said, end + 1)
    if said[end + 17 :] != b"\0" or (across, down) != (1, 1):
        raise ValueError("it has more than one channel")
    return _TYPES[kind]


def _unpacked(block: bytes, wanted: int) -> bytes:
    """Undo zlib, differences of neighbouring bytes, and the separation of even and odd ones."""
    packed = zlib.decompressobj().decompress(block, wanted)
    if len(packed) != wanted:
        raise ValueError(f"a block has {len(packed)} bytes where {wanted} are needed")
    steps = np.frombuffer(packed, np.uint8).astype(np.int64)
    steps[1:] -= 128
    whole = np.cumsum(steps).astype(np.uint8)
    out = np.empty(wanted, np.uint8)
    half = (wanted + 1) // 2
    out[::2], out[1::2] = whole[:half], whole[half:]
    return out.tobytes()
