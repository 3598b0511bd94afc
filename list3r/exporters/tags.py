"""Place tags on a picture so that every one can be read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Rect = tuple[float, float, float, float]
"""x0, y0, x1, y1, px."""

_CROSSING_PX2 = 60.0
"""A crossing of lines counts as much as so much of a tag that is hidden."""
_ANGLES = np.deg2rad(np.arange(0.0, 360.0, 15.0) - 90.0)


@dataclass(frozen=True)
class TagTarget:
    """An instance to be tagged."""

    xy: tuple[float, float]
    """Its middle, px."""
    half: tuple[float, float]
    """Half width and height of its footprint, px."""
    tag: tuple[float, float]
    """Width and height of its tag, px."""

    @property
    def small(self) -> bool:
        """Whether a tag on top would hide the instance."""
        return self.half[0] < self.tag[0] or self.half[1] < self.tag[1] * 1.2


def place_tags(targets: Sequence[TagTarget], page: Rect) -> list[tuple[float, float]]:
    """Return the middles of the tags, px, one for each anchor: the nearest place that is free, small instances first.

    Tags avoid each other and the small instances, and the lines to tags avoid each other. Where nothing is free within
    the search radius the place of least overlap is taken.
    """
    leaders: list[tuple[float, float, float, float]] = []
    boxes = [_around(a.xy, a.half) for a in targets if a.small]
    owner = np.array([n for n, a in enumerate(targets) if a.small], dtype=int)
    places: list[tuple[float, float]] = [(0.0, 0.0)] * len(targets)
    order = sorted(range(len(targets)), key=lambda n: (not targets[n].small, targets[n].half[0] * targets[n].half[1]))
    for n in order:
        target = targets[n]
        others = np.array(boxes, dtype=float).reshape(-1, 4)[owner != n]
        places[n] = _nearest_free(target, others, page, np.array(leaders, dtype=float).reshape(-1, 4))
        leaders.append((*target.xy, *places[n]))
        boxes.append(_around(places[n], (target.tag[0] / 2 + 2, target.tag[1] / 2 + 2)))
        owner = np.append(owner, -1)
    return places


def _around(xy: tuple[float, float], half: tuple[float, float]) -> Rect:
    return xy[0] - half[0], xy[1] - half[1], xy[0] + half[0], xy[1] + half[1]


def _nearest_free(
    target: TagTarget, boxes: NDArray[np.float64], page: Rect, leaders: NDArray[np.float64]
) -> tuple[float, float]:
    half = np.array(target.tag) / 2
    low, high = np.array(page[:2]) + half, np.array(page[2:]) - half
    best, least = target.xy, np.inf
    for ring in _rings(target):
        places = np.clip(ring, low, np.maximum(low, high))
        left = np.maximum(places[:, None] - half, boxes[None, :, :2])
        right = np.minimum(places[:, None] + half, boxes[None, :, 2:])
        overlap = np.maximum(right - left, 0.0).prod(axis=2).sum(axis=1)
        overlap = overlap + _CROSSING_PX2 * crossings(np.array(target.xy), places, leaders)
        k = int(np.argmin(overlap))
        if overlap[k] < least:
            best, least = (float(places[k, 0]), float(places[k, 1])), float(overlap[k])
        if least <= 0:
            break
    return best


def crossings(start: NDArray[np.float64], ends: NDArray[np.float64], leaders: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return how many leaders a line from `start` (2,) to each of `ends` (N, 2) crosses; leaders (L, 4). Shape (N,)."""
    a, b = leaders[None, :, :2], leaders[None, :, 2:]
    end = ends[:, None]
    apart = _side(start, end, a) * _side(start, end, b) < 0
    between = _side(a, b, start) * _side(a, b, end) < 0
    return np.asarray((apart & between).sum(axis=1))


def _side(a: NDArray[np.float64], b: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the side of the line from a to b on which a point is, by sign."""
    return np.asarray((b - a)[..., 0] * (p - a)[..., 1] - (b - a)[..., 1] * (p - a)[..., 0])


def _rings(target: TagTarget) -> Iterator[NDArray[np.float64]]:
    """Return places round an anchor, the best first: on it if it is large, then rings of growing radius. Shape (R, 2)
    each."""
    middle, across = np.array(target.xy), np.array(target.tag)
    start = np.array(target.half) + across / 2 + 3 if target.small else np.zeros(2)
    if not target.small:
        yield middle[None]
    for step in range(0 if target.small else 1, 40):
        radius = start + step * across[1] * 0.6
        yield middle + np.stack([np.cos(_ANGLES) * radius[0], np.sin(_ANGLES) * radius[1]], axis=1)
