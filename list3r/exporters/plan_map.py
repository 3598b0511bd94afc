"""The pixels of a plan view: the scene from above in pale colours, walls dark."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from list3r.exporters.components import point_spacing
from list3r.exporters.plan_frame import PlanFrame
from list3r.memory.records import Support

PAPER = 255.0
_WALL = np.array([62.0, 68.0, 82.0])
_FLOOR = np.array([238.0, 236.0, 231.0])
_FADE = 0.42
"""How much of the seen colour stays in the pale picture."""
_LAYERS = 48
_MAX_REACH_PX = 20
"""A point covers at most a disc of this radius."""

Image = NDArray[np.float64]
Codes = NDArray[np.uint32]
Pixels = NDArray[np.int64]


def pale_picture(frame: PlanFrame, things: list[Support], floors: list[Support], walls: list[Support]) -> Image:
    """Floor as one tint, things in their colours faded and the higher over the lower, walls dark. Shape (H, W, 3)."""
    width, height = frame.size_px
    image = np.full((height, width, 3), PAPER)
    for support in floors:
        cover = _floor_cover(frame, support)
        image = image * (1 - cover) + _FLOOR * cover
    codes = _things_from_above(frame, things)
    seen = codes > 0
    image[seen] = np.stack([codes >> 16 & 255, codes >> 8 & 255, codes & 255], axis=-1)[seen]
    alpha = 0.9 * _wall_density(frame, walls)
    return image * (1 - alpha) + _WALL * alpha


def _floor_cover(frame: PlanFrame, support: Support) -> Image:
    """Where a floor was seen, in [0, 1], smoothed over the gaps between its points. Shape (H, W, 1)."""
    canvas = _Canvas(frame)
    reach = _reach(frame, support)
    canvas.stamp(canvas.place(frame, support), np.ones(len(support.points), np.uint32), reach)
    seen = (canvas.picture() > 0).astype(np.float64)
    return np.clip(2.5 * uniform_filter(seen, 4 * reach + 3), 0.0, 1.0)[..., None]


def _things_from_above(frame: PlanFrame, things: list[Support]) -> Codes:
    """Colours as 1 << 24 | red << 16 | green << 8 | blue, 0 where nothing is, from low to high. Shape (H, W)."""
    canvas = _Canvas(frame)
    if not things:
        return canvas.picture()
    place = np.concatenate([canvas.place(frame, s) for s in things])
    reach = np.concatenate([np.full(len(s.points), _reach(frame, s)) for s in things])
    rgb = np.round(np.concatenate([s.rgb for s in things]) * _FADE + PAPER * (1 - _FADE)).astype(np.uint32)
    codes = np.uint32(1 << 24) | rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]
    order = np.argsort(np.concatenate([frame.height(s.points) for s in things]), kind="stable")
    for layer in np.array_split(order, _LAYERS):
        for size in np.unique(reach[layer]):
            chosen = layer[reach[layer] == size]
            canvas.stamp(place[chosen], codes[chosen], int(size))
    return canvas.picture()


def _wall_density(frame: PlanFrame, walls: list[Support]) -> Image:
    """How many wall points stand over each pixel, in [0, 1] of what is usual. Shape (H, W, 1)."""
    canvas = _Canvas(frame)
    counts = np.zeros(canvas.codes.size)
    for support in walls:
        cells = canvas.place(frame, support)[:, None] + canvas.disc(min(_reach(frame, support), 2))
        counts += np.bincount(cells.ravel(), minlength=counts.size)
    inner = canvas.crop(counts)
    usual = np.quantile(inner[inner > 0], 0.7) if inner.any() else 1.0
    return np.clip(inner / usual, 0.0, 1.0)[..., None]


def _reach(frame: PlanFrame, support: Support) -> int:
    """Radius of the disc that a point covers so that neighbours touch, px."""
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
        """Numbers of the pixels of points. Shape (N,)."""
        rim = _MAX_REACH_PX
        xy = np.floor(frame.to_px(support.points)).astype(np.int64) + 2 * rim
        x = np.clip(xy[:, 0], rim, self.shape[1] - rim - 1)
        y = np.clip(xy[:, 1], rim, self.shape[0] - rim - 1)
        return np.asarray(y * self.shape[1] + x)

    def disc(self, reach: int) -> Pixels:
        """Steps from a pixel to those of a disc round it. Shape (D,)."""
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
        """Values of the map without the rim. Shape (H, W)."""
        rim = 2 * _MAX_REACH_PX
        return values.reshape(self.shape)[rim:-rim, rim:-rim]

    def picture(self) -> Codes:
        """The map without the rim. Shape (H, W)."""
        rim = 2 * _MAX_REACH_PX
        return self.codes.reshape(self.shape)[rim:-rim, rim:-rim]
