"""Which part of the pictures shows anything: a clip inside a frame of another shape has black bars at its sides.

And whether pictures are panoramas, which no camera with a focal length took.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.errors import SourceError

_BLACK, _SEEN = 24, 48
"""Brightest value of a bar, with the noise of its compression, and least value of a picture beside it, of 255."""
_LEAST_SHARE = 0.02
"""Of the side: the narrowest bar."""
_STRIP_PX = 8
_STRAIGHT = 0.6
"""A bar ends at a line that shows something along this share of it, in one of the pictures."""
LOOKED_AT = 9
"""Pictures, spread over the source, that must agree."""


@dataclass(frozen=True)
class ShownPart:
    """The part of a picture that shows something, px."""

    top: int
    left: int
    bottom: int
    """Row before which it ends."""
    right: int

    @property
    def size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.bottom - self.top, self.right - self.left


def shown_part(pictures: Iterable[NDArray[np.uint8]]) -> ShownPart | None:
    """Return the part without black bars of pictures of one size, None where they have none. Shapes (H, W, 3).

    A bar is black in every picture, ends at one line, and has a like one on the other side. Pictures after the first
    are looked at only while one is possible.
    """
    brightest: NDArray[np.uint8] | None = None
    for picture in pictures:
        value = picture.max(axis=2)
        if brightest is not None and value.shape != brightest.shape:
            continue
        brightest = value if brightest is None else np.maximum(brightest, value)
        if _bars(brightest, 0) == _bars(brightest, 1) == (0, 0):
            return None
    if brightest is None:
        return None
    (height, width), vertical, horizontal = brightest.shape, _sure(brightest, 0), _sure(brightest, 1)
    found = ShownPart(vertical[0], horizontal[0], height - vertical[1], width - horizontal[1])
    return None if found.size == (height, width) or min(found.size) < 2 * _STRIP_PX else found


def _bars(brightest: NDArray[np.uint8], axis: int) -> tuple[int, int]:
    """Black lines at the beginning and the end of an axis; none where they are too narrow, or unlike each other."""
    seen = np.flatnonzero(brightest.max(axis=1 - axis) > _BLACK)
    count = brightest.shape[axis]
    if not len(seen):
        return count, count
    first, last = int(seen[0]), count - 1 - int(seen[-1])
    like = abs(first - last) <= max(4, _LEAST_SHARE * count)
    return (first, last) if like and min(first, last) >= _LEAST_SHARE * count else (0, 0)


def _sure(brightest: NDArray[np.uint8], axis: int) -> tuple[int, int]:
    """As `_bars`, if both end at a line; what compression mixes with it counts to the bar."""
    first, last = _bars(brightest, axis)
    lines = np.moveaxis(brightest, axis, 0)
    if not first or first + last >= len(lines) - 2 * _STRIP_PX:
        return 0, 0
    seen = np.flatnonzero(lines.max(axis=0) > _BLACK)
    lines = lines[:, seen[0] : seen[-1] + 1]  # but for a bar across these
    begins, ends = _begin(lines[first : first + _STRIP_PX]), _begin(lines[::-1][last : last + _STRIP_PX])
    return (0, 0) if begins is None or ends is None else (first + begins, last + ends)


def _begin(lines: NDArray[np.uint8]) -> int | None:
    """The first of some lines that shows something nearly all along."""
    seen = (lines > _SEEN).mean(axis=1) >= _STRAIGHT
    return int(seen.argmax()) if seen.any() else None


def shown_note(shown: ShownPart, size: tuple[int, int]) -> str:
    """That bars are cut off, for people; `size` (height, width) is that of the pictures with them."""
    height, width = shown.size
    return (
        f"black bars are cut off: of {size[1]}x{size[0]} the {width}x{height} from ({shown.left}, {shown.top}) on are "
        "used; intrinsics are still given for the whole picture"
    )


_TWICE = 0.005
_MEET = 2.0


def check_no_panorama(pictures: Sequence[NDArray[np.uint8]], name: str) -> None:
    """Raise `SourceError` for pictures whose left side goes on at their right: all around, on a map of the sphere.

    Shapes (H, W, 3).
    """
    for picture in pictures:
        height, width = picture.shape[:2]
        if abs(width / height - 2) > _TWICE:
            return
        rows = picture[height // 8 : -(height // 8) or None].astype(np.int16)
        meet = np.abs(rows[:, 0] - rows[:, -1]).mean()
        inside = np.abs(np.diff(rows, axis=1)).mean()
        apart = np.abs(rows[:, 0] - rows[:, width // 2]).mean()
        if meet > _MEET * inside + 1.0 or apart < 3 * meet + 3.0:
            return
    if pictures:
        raise SourceError(
            f"{name} holds 360-degree panoramas (equirectangular, twice as wide as high, the left side goes on at the "
            "right), which no pinhole camera took; cut perspective views out of them first (ffmpeg -vf "
            "v360=e:rectilinear:h_fov=90:v_fov=90), or give --intrinsics if they are ordinary pictures"
        )
