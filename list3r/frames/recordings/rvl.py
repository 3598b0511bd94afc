"""Depth packed by RVL, as `compressed_depth_image_transport` writes it.

Wilson, "Fast lossless depth image compression", ISS 2017: runs of zeros and of differences to the last known pixel,
each number in groups of three bits, the lowest first, with a fourth that says whether more follow.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from list3r.compiled import compiled
from list3r.frames.files import MAX_PIXELS
from list3r.memory.core.errors import FrameError


def read_rvl(data: bytes) -> NDArray[np.uint16]:
    """Return depth as stored of width, height (32 bits each) and what is packed. Shape (H, W). Raises `FrameError`."""
    width, height = struct.unpack("<ii", data[:8]) if len(data) >= 8 else (0, 0)
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise FrameError(f"depth packed by RVL claims {width}x{height} pixels; is it damaged?")
    words = np.frombuffer(data[8 : 8 + (len(data) - 8) // 4 * 4], "<u4")
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).astype(np.uint8).ravel()
    out = np.zeros(width * height, np.uint16)
    if not _unpack(nibbles, out):
        raise FrameError("depth packed by RVL is damaged or cut off")
    return out.reshape(height, width)


@compiled
def _unpack(nibbles: NDArray[np.uint8], out: NDArray[np.uint16]) -> bool:
    """Fill `out`; False where the numbers end before, or run over it."""
    at, place, last, run, kind = 0, 0, 0, 0, 0
    while place < len(out):
        value, shift = 0, 0
        while True:
            if at >= len(nibbles) or shift > 30:
                return False
            nibble = int(nibbles[at])
            at += 1
            value |= (nibble & 7) << shift
            shift += 3
            if nibble < 8:
                break
        if kind == 0:  # pixels that are unknown
            place += value
            kind = 1
        elif kind == 1:  # how many are known
            run, kind = value, 2 if value else 0
        else:
            last += (value >> 1) ^ -(value & 1)
            out[place] = last & 0xFFFF
            place, run = place + 1, run - 1
            kind = 2 if run else 0
    return place == len(out) and run == 0
