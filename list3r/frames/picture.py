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

from list3r.memory.errors import FrameError


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

    @classmethod
    def of(cls, image: av.VideoFrame, aspect: Fraction) -> Upright:
        """As the first picture and its display matrix say; `aspect` is the width of its pixels by their height."""
        return cls((image.height, image.width), aspect, *_orientation(image), bool(image.interlaced_frame))

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the upright picture with square pixels, px."""
        height, width = self.stored
        width = max(1, round(width * self.aspect))
        return (width, height) if self.turns % 2 else (height, width)

    def color(self, image: av.VideoFrame, size: tuple[int, int]) -> NDArray[np.uint8]:
        """RGB, upright, of (height, width) `size`. Shape (H, W, 3).

        Raises `FrameError` for a picture that is stored in another size than the first.
        """
        if (image.height, image.width) != self.stored:
            was = f"{self.stored[1]}x{self.stored[0]}"
            raise FrameError(f"the picture is {image.width}x{image.height}, the first one {was}")
        height, width = size[::-1] if self.turns % 2 else size
        if (height, width) == self.stored:
            rgb = image.to_ndarray(format="rgb24")
        else:
            rgb = image.reformat(width=width, height=height, format="rgb24", interpolation="AREA").to_ndarray()
        if self.mirrored:
            rgb = rgb[:, ::-1]
        return np.ascontiguousarray(np.rot90(rgb, self.turns))

    def notes(self) -> tuple[str, ...]:
        """What is done, for people."""
        out = []
        if self.turns:
            out.append(f"frames are turned by {90 * self.turns} degrees counter-clockwise, as the file says")
        if self.mirrored:
            out.append("frames are mirrored, as the file says")
        if self.aspect != 1:
            out.append(f"pixels are {float(self.aspect):.3g} times as wide as high and are made square")
        if self.interlaced:
            out.append("frames are interlaced, which smears what moves; better deinterlace first (ffmpeg -vf bwdif)")
        return tuple(out)


_LUMA = ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "gray")
"""Formats whose first plane is the picture in grey, one byte a pixel."""


def small_gray(image: av.VideoFrame, side: int) -> NDArray[np.uint8]:
    """A stored picture in grey, its longer side at most `side` px. Shape (H, W).

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
