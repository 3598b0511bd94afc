"""The pixels of a plan view: the scene from above in pale colours, walls dark."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from list3r.exporters.components import point_spacing
from list3r.exporters.plan_frame import PlanFrame
from list3r.memory.records import Support

PAPER = np.array([255.0, 255.0, 255.0])
_WALL = np.array([62.0, 68.0, 82.0])
_FLOOR = np.array([238.0, 236.0, 231.0])
_FADE = 0.42
"""How much of the seen colour stays in the pale picture."""
_LAYERS = 48
_MAX_SPLAT_PX = 41

Image = NDArray[np.float64]


def pale_picture(frame: PlanFrame, things: list[Support], floors: list[Support], walls: list[Support]) -> Image:
    """Floor as one tint, things in their colours faded and the higher over the lower, walls dark. Shape (H, W, 3)."""
    width, height = frame.size_px
    image = np.tile(PAPER, (height, width, 1))
    for support in floors:
        cover, splat = np.zeros((height, width, 1)), _pixels(frame, support)[2]
        _stamp(cover, *_pixels(frame, support)[:2], np.ones((len(support.points), 1)), splat)
        cover = np.clip(2.0 * uniform_filter(cover, (2 * splat + 1, 2 * splat + 1, 1)), 0.0, 1.0)
        image = image * (1 - cover) + _FLOOR * cover
    _draw_things(image, frame, things)
    density = np.zeros((height, width))
    for support in walls:
        x, y, splat = _pixels(frame, support)
        _accumulate(density, x, y, min(splat, 5))
    if density.any():
        strong = np.quantile(density[density > 0], 0.7)
        alpha = np.clip(density / strong, 0.0, 1.0)[..., None] * 0.9
        image = image * (1 - alpha) + _WALL * alpha
    return image


def _draw_things(image: Image, frame: PlanFrame, things: list[Support]) -> None:
    """Paint from low to high in thin layers, so that what is above covers what is below."""
    if not things:
        return
    parts = [_pixels(frame, s) for s in things]
    x, y = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
    splat = np.concatenate([np.full(len(p[0]), p[2]) for p in parts])
    rgb = np.concatenate([s.rgb for s in things]) * _FADE + PAPER * (1 - _FADE)
    height = np.concatenate([frame.height(s.points) for s in things])
    order = np.argsort(height, kind="stable")
    for layer in np.array_split(order, _LAYERS):
        for size in np.unique(splat[layer]):
            chosen = layer[splat[layer] == size]
            _stamp(image, x[chosen], y[chosen], rgb[chosen], int(size))


def _pixels(frame: PlanFrame, support: Support) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Pixel columns, rows, and the side of the square that a point covers, px (odd)."""
    xy = np.floor(frame.to_px(support.points)).astype(np.int64)
    spacing = point_spacing(support.points) * frame.pixels_per_unit
    return xy[:, 0], xy[:, 1], 2 * int(np.clip(spacing * 0.7, 0, _MAX_SPLAT_PX // 2)) + 1


def _stamp(image: Image, x: NDArray[np.int64], y: NDArray[np.int64], rgb: Image, splat: int) -> None:
    height, width = image.shape[:2]
    reach = splat // 2
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if dx * dx + dy * dy > (reach + 0.5) ** 2:
                continue
            inside = (x + dx >= 0) & (x + dx < width) & (y + dy >= 0) & (y + dy < height)
            image[y[inside] + dy, x[inside] + dx] = rgb[inside]


def _accumulate(density: Image, x: NDArray[np.int64], y: NDArray[np.int64], splat: int) -> None:
    height, width = density.shape
    reach = splat // 2
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            inside = (x + dx >= 0) & (x + dx < width) & (y + dy >= 0) & (y + dy < height)
            flat = (y[inside] + dy) * width + x[inside] + dx
            density += np.bincount(flat, minlength=height * width).reshape(height, width)
