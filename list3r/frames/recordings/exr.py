"""Depth in an OpenEXR file: one channel of a scan-line file, as recorders of phones write it.

Layout as in "OpenEXR File Layout" of the format's own documentation. Uncompressed, run-length (RLE) and zip files are
read; the others (PIZ, PXR24, B44, DWA) are refused by name.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.files import MAX_PIXELS
from list3r.memory.core.errors import FrameError

_MAGIC = b"v/1\x01"
_LINES = {0: 1, 1: 1, 2: 1, 3: 16}
"""Lines of a block by the compression: none, RLE, ZIPS, ZIP."""
_NAMES = {4: "PIZ", 5: "PXR24", 6: "B44", 7: "B44A", 8: "DWAA", 9: "DWAB"}
_TYPES = ("<u4", "<f2", "<f4")
_OTHER_PARTS = 0x1A00
"""Flags of tiles, deep data and several parts."""
_DEPTH = ("Z", "depth.Z", "depth", "R", "Y")


def read_exr(data: bytes, name: str) -> NDArray[Any]:
    """Return the depth channel of a file, the first of Z, R, Y that it has. Shape (H, W). Raises `FrameError`."""
    try:
        return _read(data, name)
    except (struct.error, ValueError, IndexError, KeyError, zlib.error):
        raise FrameError(f"{name} is damaged or cut off") from None


def _read(data: bytes, name: str) -> NDArray[Any]:
    if not data.startswith(_MAGIC):
        raise FrameError(f"{name} is no OpenEXR file")
    if struct.unpack_from("<I", data, 4)[0] & _OTHER_PARTS:
        raise FrameError(f"{name} has tiles or several parts; scan-line files of one part are read")
    head, at = _header(data)
    packing = head["compression"][0]
    if packing not in _LINES:
        raise FrameError(f"{name} is compressed by {_NAMES.get(packing, packing)}; zip, RLE and none are read")
    left, top, right, bottom = struct.unpack("<4i", head["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if not 0 < width * height <= MAX_PIXELS or width < 1:
        raise FrameError(f"{name} claims {width}x{height} pixels")
    channels = _channels(head["channels"])
    wanted = next((c for c in _DEPTH if c in channels), next(iter(channels)))
    kinds = [np.dtype(kind) for kind in channels.values()]
    before = sum(k.itemsize for k in kinds[: list(channels).index(wanted)]) * width
    stride, kind = sum(k.itemsize for k in kinds) * width, np.dtype(channels[wanted])
    out = np.zeros((height, width), kind)
    blocks = -(-height // _LINES[packing])
    for offset in struct.unpack_from(f"<{blocks}Q", data, at):
        y, size = struct.unpack_from("<iI", data, offset)
        lines = min(_LINES[packing], bottom + 1 - y)
        raw = data[offset + 8 : offset + 8 + size]
        if size < lines * stride:  # a block that does not become smaller is stored as it is
            raw = _unpacked(raw, lines * stride, packing)
        rows = np.frombuffer(raw, np.uint8, lines * stride).reshape(lines, stride)
        part = np.ascontiguousarray(rows[:, before : before + width * kind.itemsize])
        out[y - top : y - top + lines] = part.view(kind)
    return out


def _header(data: bytes) -> tuple[dict[str, bytes], int]:
    """The attributes by name, and where what follows begins."""
    at, out = 8, dict[str, bytes]()
    while data[at]:
        name = data.index(b"\0", at)
        kind = data.index(b"\0", name + 1)
        (size,) = struct.unpack_from("<I", data, kind + 1)
        out[data[at:name].decode("latin-1")] = data[kind + 5 : kind + 5 + size]
        at = kind + 5 + size
    return out, at + 1


def _channels(data: bytes) -> dict[str, str]:
    """Number types of the channels by name, in the file's order; each has as many pixels as the picture."""
    at, out = 0, dict[str, str]()
    while data[at]:
        end = data.index(b"\0", at)
        kind, _, x, y = struct.unpack_from("<iIii", data, end + 1)
        if (x, y) != (1, 1):
            raise ValueError("a channel is sampled more thinly")
        out[data[at:end].decode("latin-1")] = _TYPES[kind]
        at = end + 17
    return out


def _unpacked(data: bytes, count: int, packing: int) -> bytes:
    """The bytes of a block: differences to the one before, those at even places first."""
    raw = _runs(data, count) if packing == 1 else zlib.decompressobj().decompress(data, count + 1)
    if len(raw) != count:
        raise ValueError("a block has another length than its lines")
    steps = np.frombuffer(raw, np.uint8).astype(np.int64)
    steps[1:] -= 128
    half, out = (count + 1) // 2, np.empty(count, np.uint8)
    whole = np.cumsum(steps).astype(np.uint8)
    out[::2], out[1::2] = whole[:half], whole[half:]
    return out.tobytes()


def _runs(data: bytes, count: int) -> bytes:
    """What run-length packing holds: -n and n bytes, or n - 1 and a byte that comes n times."""
    out, at = bytearray(), 0
    while at < len(data) and len(out) <= count:
        n = data[at] - 256 if data[at] > 127 else data[at]
        if n < 0:
            out += data[at + 1 : at + 1 - n]
            at += 1 - n
        else:
            out += data[at + 1 : at + 2] * (n + 1)
            at += 2
    return bytes(out)
