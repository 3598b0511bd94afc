"""Depth in the pictures of a video of 12 or 16 bits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import SourceError

if TYPE_CHECKING:
    import av

_BITS = 12


@dataclass(frozen=True)
class DepthCode:
    """What the numbers of a depth video mean: codes of 12 bits, evenly over the depth or over the log of it."""

    least_m: float
    """Depth of the code 0, which also stands for no depth."""
    most_m: float
    """Depth of the largest code."""
    shift_m: float
    """Added before the logarithm is taken."""
    logarithmic: bool

    @classmethod
    def of(cls, info: object) -> DepthCode | None:
        """Return what a feature of LeRobot says; None where it says nothing: then depth is in millimetres.

        Raises `SourceError` for numbers that mean no depth.
        """
        info = info if isinstance(info, dict) else {}
        if "video.depth_min" not in info or "video.depth_max" not in info:
            return None
        least, most, shift = info["video.depth_min"], info["video.depth_max"], info.get("video.shift", 0.0)
        logarithmic = bool(info.get("video.use_log", True))
        numbers = all(isinstance(v, int | float) and math.isfinite(v) for v in (least, most, shift))
        if not numbers or not 0 <= least < most or (logarithmic and least + shift <= 0):
            raise SourceError(f"depth is coded from {least} to {most} m, shifted by {shift}; fix meta/info.json")
        return cls(float(least), float(most), float(shift), logarithmic)

    def metres(self, codes: NDArray[Any]) -> NDArray[np.float32]:
        """Return depth, 0 where there is none. Shape as `codes`."""
        share = codes.astype(np.float64) / (2**_BITS - 1)
        if self.logarithmic:
            low, high = math.log(self.least_m + self.shift_m), math.log(self.most_m + self.shift_m)
            depth = np.exp(low + share * (high - low)) - self.shift_m
        else:
            depth = self.least_m + share * (self.most_m - self.least_m)
        return np.where(codes > 0, depth, 0.0).astype(np.float32)


def bits_of(image: av.VideoFrame) -> int:
    """Return the bits of a pixel's first component."""
    return int(image.format.components[0].bits)


def metres_of(image: av.VideoFrame, code: DepthCode | None) -> NDArray[np.float32]:
    """Return depth of a picture of over 8 bits; without a code its numbers are millimetres. Shape (H, W)."""
    plane: Any = image.planes[0]
    stored = np.frombuffer(plane, "<u2").reshape(-1, plane.line_size // 2)[: image.height, : image.width]
    if code is None:
        return np.asarray(stored * np.float32(0.001), np.float32)
    bits = bits_of(image)
    return code.metres(stored >> (bits - _BITS) if bits >= _BITS else stored << (_BITS - bits))
