"""Draw the scene from above in pale colours, walls dark."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, uniform_filter

from list3r.exporters.components import point_spacing
from list3r.exporters.plan.frame import PlanFrame
from list3r.memory.records import Support

PAPER = 255.0
_WALL = np.array([62.0, 68.0, 82.0])
_HATCH, _HATCH_PX = np.array([196.0, 200.0, 208.0]), 12
"""Colour of the strokes where nothing was seen, and how far they are apart."""
_FADE_THINGS = 0.6
"""How much of the seen colour of things stays in the pale picture."""
_FADE_FLOOR = 0.3
"""The same for the floor."""
_LAYERS = 48
_MAX_REACH_PX = 20
"""A point covers at most a disc of this radius."""

Image = NDArray[np.float64]
Codes = NDArray[np.uint32]
Pixels = NDArray[np.int64]


def pale_picture(frame: PlanFrame, things: list[Support], floors: list[Support], walls: list[Support]) -> Image:
    """Draw the floor smoothed, things above it, the higher over the lower, all faded; walls dark. Shape (H, W, 3)."""
    width, height = frame.size_px
    image = np.full((height, width, 3), PAPER)
    for support in floors:
        color, cover = _smooth_floor(frame, support)
        image = image * (1 - cover) + color * cover
    codes = _from_above(frame, things)
    seen = codes > 0
    image[seen] = _rgb(codes[seen])
    alpha = 0.9 * _wall_density(frame, walls)
    return image * (1 - alpha) + _WALL * alpha


def hatched(pixels: Image) -> Image:
    """Return the picture with strokes where nothing was seen. Shape (H, W, 3)."""
    blank: NDArray[np.bool_] = np.asarray((pixels > PAPER - 2).all(axis=2))
    unseen = binary_opening(blank, iterations=3)
    y, x = np.indices(unseen.shape)
    return np.where((unseen & ((x + y) % _HATCH_PX == 0))[..., None], _HATCH, pixels)


def _smooth_floor(frame: PlanFrame, support: Support) -> tuple[Image, Image]:
    """Return faded colour (H, W, 3) and cover in [0, 1] (H, W, 1) of a floor, averaged over gaps between its points."""
    canvas, reach = _Canvas(frame), _reach(frame, support)
    canvas.stamp(canvas.place(frame, support), _codes(support.rgb, _FADE_FLOOR), min(reach, 2))
    codes = canvas.picture()
    layers = np.dstack([_rgb(codes), codes > 0]).astype(np.float32)
    layers[codes == 0] = 0.0
    window = 4 * reach + 3
    mean = uniform_filter(uniform_filter(layers, (window, window, 1)), (window, window, 1))
    weight = mean[..., 3:]
    usual = float(np.median(weight[codes > 0])) if (codes > 0).any() else 1.0
    return mean[..., :3] / np.maximum(weight, 1e-6), np.clip(2.0 * weight / usual, 0.0, 1.0).astype(np.float64)


def _from_above(frame: PlanFrame, supports: list[Support]) -> Codes:
    """Return the faded colours of things as `_codes`, painted from low to high, 0 where nothing is. Shape (H, W)."""
    canvas = _Canvas(frame)
    if not supports:
        return canvas.picture()
    place = np.concatenate([canvas.place(frame, s) for s in supports])
    reach = np.concatenate([np.full(len(s.points), _reach(frame, s)) for s in supports])
    codes = np.concatenate([_codes(s.rgb, _FADE_THINGS) for s in supports])
    order = np.argsort(np.concatenate([frame.height(s.points) for s in supports]), kind="stable")
    for layer in np.array_split(order, _LAYERS):
        for size in np.unique(reach[layer]):
            chosen = layer[reach[layer] == size]
            canvas.stamp(place[chosen], codes[chosen], int(size))
    return canvas.picture()


def _codes(rgb: NDArray[np.uint8], fade: float) -> Codes:
    """Return the faded colours in one number each, never 0: 1 << 24 | red << 16 | green << 8 | blue. Shape (N, 3) ->
    (N,)."""
    faded = np.round(rgb * fade + PAPER * (1 - fade)).astype(np.uint32)
    return np.asarray(np.uint32(1 << 24) | faded[:, 0] << 16 | faded[:, 1] << 8 | faded[:, 2])


def _rgb(codes: Codes) -> NDArray[np.uint32]:
    """Return the colours of `_codes`. Shape (...) -> (..., 3)."""
    return np.stack([codes >> 16 & 255, codes >> 8 & 255, codes & 255], axis=-1)


def _wall_density(frame: PlanFrame, walls: list[Support]) -> Image:
    """Return how many wall points stand over each pixel, in [0, 1] of what is usual. Shape (H, W, 1)."""
    canvas = _Canvas(frame)
    counts = np.zeros(canvas.codes.size)
    for support in walls:
        cells = canvas.place(frame, support)[:, None] + canvas.disc(min(_reach(frame, support), 1))
        counts += np.bincount(cells.ravel(), minlength=counts.size)
    inner = canvas.crop(counts)
    usual = np.quantile(inner[inner > 0], 0.7) if inner.any() else 1.0
    return np.clip(inner / usual, 0.0, 1.0)[..., None]


def _reach(frame: PlanFrame, support: Support) -> int:
    """Return the radius of the disc that a point covers so that neighbours touch, px."""
    if not len(support.points):
        return 0
    spacing = point_spacing(support.points) * frame.pixels_per_unit
    return int(np.clip(spacing * 0.7, 0, _MAX_REACH_PX))


class _Canvas:
    """Pixels as one number each, with a rim that takes what falls off the map."""

    def __init__(self, frame: PlanFrame) -> None:
        width, height = frame.size_px
        self.shape = (height + 4 * _MAX_REACH_PX, width + 4 * _MAX_REACH_PX)
        self.codes = np.zeros(self.shape[0] * self.shape[1], np.uint32)

    def place(self, frame: PlanFrame, support: Support) -> Pixels:
        """Return numbers of the pixels of points. Shape (N,)."""
        rim = _MAX_REACH_PX
        xy = np.floor(frame.to_px(support.points)).astype(np.int64) + 2 * rim
        x = np.clip(xy[:, 0], rim, self.shape[1] - rim - 1)
        y = np.clip(xy[:, 1], rim, self.shape[0] - rim - 1)
        return np.asarray(y * self.shape[1] + x)

    def disc(self, reach: int) -> Pixels:
        """Return steps from a pixel to those of a disc round it. Shape (D,)."""
        dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        inside = dx**2 + dy**2 <= (reach + 0.5) ** 2
        return np.asarray(dy[inside] * self.shape[1] + dx[inside])

    def stamp(self, place: Pixels, codes: Codes, reach: int) -> None:
        """Draw a disc for each point, later ones over earlier ones."""
        disc = self.disc(reach)
        step = max(1, 2_000_000 // len(disc))
        for start in range(0, len(place), step):
            cells = place[start : start + step, None] + disc
            self.codes[cells.ravel()] = np.repeat(codes[start : start + step], len(disc))

    def crop(self, values: NDArray[np.float64]) -> Image:
        """Return values of the map without the rim. Shape (H, W)."""
        rim = 2 * _MAX_REACH_PX
        return values.reshape(self.shape)[rim:-rim, rim:-rim]

    def picture(self) -> Codes:
        """Return the map without the rim. Shape (H, W)."""
        rim = 2 * _MAX_REACH_PX
        return self.codes.reshape(self.shape)[rim:-rim, rim:-rim]
