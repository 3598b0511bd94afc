"""The picture of what was seen from above: pale colours, walls dark, nothing where nothing was seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.exporters.components import point_spacing
from list3r.exporters.plan.view import PlanView
from list3r.memory.core.records import Support

LONG_SIDE_PX = 1100
"""Pixels of the longer side of the map."""
_MAX_REACH_PX = 14
"""A point covers at most a disc of this radius."""
_WALL = (62, 68, 82)
_HEIGHTS = 1 << 30
"""Steps into which heights are divided, above the 24 bits of a colour."""

Image = NDArray[np.uint8]


def picture_from_above(view: PlanView, instances: list[Support], floors: list[Support], walls: list[Support]) -> Image:
    """Draw the highest point over each pixel, walls over all. Shape (H, W, 4), row 0 at the top, alpha 0 = not seen."""
    image = _highest(view, [(s, 0.3, 1.8) for s in floors])
    for layer in (_highest(view, [(s, 0.6, 0.7) for s in instances]), _wall_picture(view, walls)):
        alpha = layer[..., 3:] / 255.0
        image[..., :3] = np.round(image[..., :3] * (1 - alpha) + layer[..., :3] * alpha)
        image[..., 3] = np.maximum(image[..., 3], layer[..., 3])
    return image


def _highest(view: PlanView, supports: list[tuple[Support, float, float]]) -> Image:
    """Draw supports, each with the share of its colour that stays and the radius of a point in spacings."""
    canvas = _Canvas(view)
    buffer = np.zeros(canvas.cells, np.int64)
    heights = [view.height(s.points) for s, _, _ in supports if len(s.points)]
    low, high = (min(map(np.min, heights)), max(map(np.max, heights))) if heights else (0.0, 1.0)
    for support, fade, spacings in supports:
        if not len(support.points):
            continue
        level = (view.height(support.points) - low) / max(high - low, 1e-9)
        rgb = np.round(support.rgb * fade + 255.0 * (1 - fade)).astype(np.int64) @ (1 << 16, 1 << 8, 1)
        key = (1 + (level * _HEIGHTS).astype(np.int64)) << 24 | rgb
        reach = spacings * point_spacing(support.points) * canvas.pixels_per_unit
        for step in canvas.disc(reach):
            np.maximum.at(buffer, canvas.place(view, support) + step, key)
    alpha = np.where(buffer > 0, 255, 0)
    return canvas.cropped(np.stack([buffer >> 16 & 255, buffer >> 8 & 255, buffer & 255, alpha], axis=1))


def _wall_picture(view: PlanView, walls: list[Support]) -> Image:
    """Draw walls the darker the more of their points are over a pixel."""
    canvas = _Canvas(view)
    counts = np.zeros(canvas.cells)
    for support in walls:
        for step in canvas.disc(1.0):
            counts += np.bincount(canvas.place(view, support) + step, minlength=canvas.cells)
    usual = float(np.quantile(counts[counts > 0], 0.7)) if counts.any() else 1.0
    alpha = np.round(230 * np.clip(counts / usual, 0.0, 1.0))
    return canvas.cropped(np.column_stack([np.tile(_WALL, (canvas.cells, 1)), alpha]))


class _Canvas:
    """Pixels of the map as one number each, with a rim for points outside."""

    def __init__(self, view: PlanView) -> None:
        span = view.high - view.low
        self.pixels_per_unit = float(LONG_SIDE_PX / span.max())
        width, height = np.ceil(span * self.pixels_per_unit).astype(int)
        self._shape = (int(height) + 2 * self._rim, int(width) + 2 * self._rim)
        self.cells = self._shape[0] * self._shape[1]

    _rim = 2 * _MAX_REACH_PX + 2

    def place(self, view: PlanView, support: Support) -> NDArray[np.int64]:
        """Return the pixels of points. Shape (N,)."""
        x, y = np.floor((view.on_page(support.points) - view.low) * self.pixels_per_unit).astype(np.int64).T
        least, most = _MAX_REACH_PX, np.array(self._shape)[::-1] - _MAX_REACH_PX - 1
        x, y = np.clip(x + self._rim, least, most[0]), np.clip(self._shape[0] - 1 - self._rim - y, least, most[1])
        return np.asarray(y * self._shape[1] + x)

    def disc(self, radius: float) -> list[int]:
        """Return the offsets of a disc of pixels."""
        r = int(np.clip(radius, 0, _MAX_REACH_PX))
        dy, dx = np.mgrid[-r : r + 1, -r : r + 1]
        inside = dx**2 + dy**2 <= (r + 0.5) ** 2
        return [int(v) for v in dy[inside] * self._shape[1] + dx[inside]]

    def cropped(self, values: NDArray[np.generic]) -> Image:
        """Return the map without its rim. Shape (cells, 4) -> (H, W, 4)."""
        rim = self._rim
        return values.reshape(*self._shape, 4)[rim:-rim, rim:-rim].astype(np.uint8)
