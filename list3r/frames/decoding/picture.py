"""How a decoded picture is put upright, with square pixels, as the file says."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import FrameError


@dataclass(frozen=True)
class Upright:
    """The way from a stored picture to the upright one; the same for all pictures of a stream."""

    stored: tuple[int, int]
    """(height, width) as stored, px."""
    aspect: Fraction
    """Width of a stored pixel by its height."""
    turns: int
    """Counter-clockwise quarter turns, after mirroring."""
    mirrored: bool
    """Left and right are exchanged first."""
    interlaced: bool = False
    """Every other line was taken a moment later."""
    hdr: bool = False
    """Brightness is coded by SMPTE ST 2084, which looks grey where it is taken for the usual code."""

    @classmethod
    def of(cls, image: av.VideoFrame, aspect: Fraction) -> Upright:
        """As the first picture and its display matrix say; `aspect` is the width of its pixels by their height."""
        hdr = getattr(image, "color_trc", None) == _PQ
        return cls((image.height, image.width), aspect, *_orientation(image), bool(image.interlaced_frame), hdr)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the upright picture with square pixels, px."""
        height, width = self.stored
        width = max(1, round(width * self.aspect))
        return (width, height) if self.turns % 2 else (height, width)

    def color(self, image: av.VideoFrame, size: tuple[int, int]) -> NDArray[np.uint8]:
        """RGB, upright, of (height, width) `size`. Shape (H, W, 3).

        A call or a stream over a poor line goes on in smaller pictures of the same shape, which are enlarged. Raises
        `FrameError` for a picture of another shape than the first.
        """
        here, was = (image.height, image.width), self.stored
        if abs(image.width * was[0] - image.height * was[1]) > _SAME_SHAPE * image.height * was[1]:
            raise FrameError(f"the picture is {here[1]}x{here[0]}, the first one {was[1]}x{was[0]}")
        height, width = size[::-1] if self.turns % 2 else size
        if (height, width) == here:
            rgb = image.to_ndarray(format="rgb24")
        else:
            how = "AREA" if height <= here[0] else "BICUBIC"
            rgb = image.reformat(width=width, height=height, format="rgb24", interpolation=how).to_ndarray()
        if self.hdr:
            rgb = _PQ_TO_SRGB[rgb]
        if self.mirrored:
            rgb = rgb[:, ::-1]
        return np.ascontiguousarray(np.rot90(rgb, self.turns))

    def notes(self) -> tuple[str, ...]:
        """Return what is done, for people."""
        out = []
        if self.turns:
            out.append(f"frames are turned by {90 * self.turns} degrees counter-clockwise, as the file says")
        if self.mirrored:
            out.append("frames are mirrored, as the file says")
        if self.aspect != 1:
            out.append(f"pixels are {float(self.aspect):.3g} times as wide as high and are made square")
        if self.interlaced:
            out.append("frames are interlaced, which smears what moves; deinterlace it first (ffmpeg -vf bwdif)")
        if self.hdr:
            out.append("the video is HDR10 (PQ); its brightness is brought to that of ordinary video")
        return tuple(out)


_SAME_SHAPE = 0.01
"""Width by height may differ so much where pictures of a stream come in other sizes."""
_PQ = 16
"""FFmpeg's number of the transfer function of SMPTE ST 2084."""
_WHITE_NITS = 203.0
"""Diffuse white of HDR video (ITU-R BT.2408); what is brighter is white."""


def _pq_to_srgb() -> NDArray[np.uint8]:
    """Return the usual code (IEC 61966-2-1) of each value of ST 2084, both of 8 bits. Shape (256,)."""
    v = np.linspace(0.0, 1.0, 256) ** (1.0 / 78.84375)
    nits = 10000.0 * (np.maximum(v - 0.8359375, 0.0) / (18.8515625 - 18.6875 * v)) ** (1.0 / 0.1593017578125)
    light = np.minimum(nits / _WHITE_NITS, 1.0)
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * code), np.uint8)


_PQ_TO_SRGB = _pq_to_srgb()
_LUMA = ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "gray")
"""Formats whose first plane is the picture in grey, one byte a pixel."""


def small_gray(image: av.VideoFrame, side: int) -> NDArray[np.uint8]:
    """Return a stored picture in grey, its longer side at most `side` px. Shape (H, W).

    Nearly all video holds the grey picture as it is; to take that costs a tenth of having it made.
    """
    scale = min(1.0, side / max(image.width, image.height))
    width, height = max(1, round(image.width * scale)), max(1, round(image.height * scale))
    if image.format.name not in _LUMA:
        return np.asarray(image.reformat(width=width, height=height, format="gray", interpolation="AREA").to_ndarray())
    plane = image.planes[0]
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[: image.height, : image.width]
    return np.asarray(cv2.resize(rows, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _orientation(image: av.VideoFrame) -> tuple[int, bool]:
    """Quarter turns and mirroring of the display matrix: x' = a x + c y, y' = b x + d y, in 16.16 fixed point."""
    try:
        stored: Any = image.side_data.get("DISPLAYMATRIX")
        matrix = np.frombuffer(bytes(stored or b""), np.int32).astype(np.float64)
    except (AttributeError, KeyError, TypeError, ValueError):
        matrix = np.zeros(0)
    if len(matrix) != 9:
        return round(getattr(image, "rotation", 0) / 90) % 4, False
    a, b, _, c, d = matrix[:5]
    mirrored = bool(a * d - b * c < 0)
    sign = -1.0 if mirrored else 1.0
    return round(math.degrees(math.atan2(-sign * b, sign * a)) / 90) % 4, mirrored
