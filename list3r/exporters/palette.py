"""Colours of instances: distinct, and the same for an id in every export."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Color = tuple[int, int, int]

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
_LIGHTNESS = (0.68, 0.56, 0.76)


def instance_color(instance_id: int, chroma: float = 0.15) -> Color:
    """Return the sRGB colour of an id: hues a golden angle apart, at three lightnesses, in OKLCH (Ottosson 2020)."""
    hue = instance_id * _GOLDEN_ANGLE
    lightness = _LIGHTNESS[instance_id % len(_LIGHTNESS)]
    a, b = chroma * np.cos(hue), chroma * np.sin(hue)
    cone = np.array(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.2914855480 * b,
        ]
    )
    to_linear = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    r, g, b8 = (int(v) for v in np.round(255.0 * srgb_from_linear(to_linear @ cone**3)))
    return r, g, b8


def structure_color(instance_id: int) -> Color:
    """Return a greyish colour for floor, walls and the like, so that instances contrast with them."""
    return instance_color(instance_id, chroma=0.02)


def linear_from_srgb(rgb: ArrayLike) -> NDArray[np.float64]:
    """Return linear light in [0, 1] of sRGB values in [0, 255] (IEC 61966-2-1): what USD and glTF hold. Any shape."""
    v = np.asarray(rgb, dtype=np.float64) / 255.0
    return np.asarray(np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4))


def srgb_from_linear(linear: ArrayLike) -> NDArray[np.float64]:
    """Return the inverse of `linear_from_srgb`, in [0, 1], values outside clipped. Any shape."""
    v = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.asarray(np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055))
