"""What a picture's EXIF says of the lens: a focal length in pixels good to a few per cent.

A 35 mm equivalent is a whole number (26 mm +- 0.5 is 2 %) and does not know of stabilisation, so it is a start for
calibration and not a calibration.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

from list3r.frames.files import check_ordinary

_EXIF_IFD, _ORIENTATION = 0x8769, 0x0112
_QUARTER = (5, 6, 7, 8)
"""Orientations that lie on their side."""
_FOCAL_LENGTH, _FOCAL_35MM = 0x920A, 0xA405
_WIDTH, _HEIGHT = 0xA002, 0xA003
_PLANE_X_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_PLAUSIBLE = (0.3, 6.0)
"""Focal length by the longer side: 118 to 10 degrees across."""


def exif_focal(path: Path) -> float | None:
    """Focal length of the picture as stored, px; None where its EXIF says nothing that can be believed."""
    head = _head(path)
    if head is None:
        return None
    width, height, _, tags = head
    if _cropped(tags, width, height):
        return None
    return believable(_from_film(tags, width, height) or _from_sensor(tags, width, height), width, height)


def stated_size(path: object, upright: bool) -> tuple[int, int] | None:
    """Width and height by the head of a picture in a file of its own, `upright` as its EXIF says; None if unknown."""
    head = _head(path) if isinstance(path, Path) else None
    if head is None:
        return None
    return head[1::-1] if upright and head[2] else head[:2]


def _head(path: Path) -> tuple[int, int, bool, dict[int, Any]] | None:
    """Width and height as stored, whether it is to be turned by a quarter, and the tags of its camera."""
    from PIL import Image

    try:
        check_ordinary(path.stat(), path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                exif = image.getexif()
                return *image.size, exif.get(_ORIENTATION, 1) in _QUARTER, dict(exif.get_ifd(_EXIF_IFD))
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, Image.DecompressionBombError):
        return None


def film_focal(focal_35mm: float, width: int, height: int) -> float:
    """Focal length in px of a 35 mm equivalent, which compares diagonals (CIPA DCG-001)."""
    return focal_35mm * math.hypot(width, height) / _FILM_DIAGONAL_MM


def believable(focal: float | None, width: int, height: int) -> float | None:
    """Return the focal length, px, if any lens of a camera has it."""
    if focal is None or not math.isfinite(focal):
        return None
    low, high = _PLAUSIBLE
    return focal if low <= focal / max(width, height) <= high else None


def _from_film(tags: dict[int, Any], width: int, height: int) -> float | None:
    equivalent = _number(tags.get(_FOCAL_35MM))
    return film_focal(equivalent, width, height) if equivalent else None


def _from_sensor(tags: dict[int, Any], width: int, height: int) -> float | None:
    """From the lens's own focal length and the density of pixels on the sensor."""
    focal_mm, density = _number(tags.get(_FOCAL_LENGTH)), _number(tags.get(_PLANE_X_RESOLUTION))
    unit_mm = _UNIT_MM.get(int(_number(tags.get(_PLANE_UNIT)) or 2))
    taken = max(_number(tags.get(_WIDTH)) or 0, _number(tags.get(_HEIGHT)) or 0) or max(width, height)
    if not focal_mm or not density or unit_mm is None:
        return None
    return focal_mm * density / unit_mm * max(width, height) / taken


def _cropped(tags: dict[int, Any], width: int, height: int) -> bool:
    """Return whether the picture has another shape than the one that was taken."""
    taken = sorted(_number(tags.get(tag)) or 0 for tag in (_WIDTH, _HEIGHT))
    if not taken[0]:
        return False
    return abs(taken[1] / taken[0] * min(width, height) / max(width, height) - 1.0) > 0.02


def _number(value: Any) -> float | None:
    """Return a positive finite number, None for everything else that EXIF can hold."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
