"""Words for an instance without a label: size, colour and shape, and centimetres where the memory has metres."""

from __future__ import annotations

import numpy as np

from list3r.memory.core.geometry import Array

_SMALL_M = 0.6
"""Longest edge of what can be called round: of larger instances too little is seen."""
_SURFACE_M = 0.008
"""Deviation of support points from the surface that they lie on."""


def shape_word(points: Array, size: Array, unit: float = 1.0) -> str:
    """Return what an instance is shaped like, from points (N, 3) in the axes of its box and its full edge lengths (3,).

    The third axis stands upright where gravity is known; `unit` is what a metre is. Flat instances are a `sheet`, a
    `panel` (upright and large) or a `slab`; a `table` is a level top with nothing but legs under it; `cylinder` and
    `box` are said of what fits one and not the other; everything else is an `object`.
    """
    ordered = np.sort(np.maximum(size, 1e-9))
    if ordered[0] < max(0.12 * ordered[1], min(0.02 * unit, 0.3 * ordered[1])) and ordered[2] <= 5.0 * ordered[1]:
        upright = int(np.argmin(size)) != 2
        return "panel" if upright and ordered[1] > 0.5 * unit else "sheet"
    if ordered[2] > 3.0 * ordered[1]:
        return "bar"
    if ordered[0] < 0.3 * ordered[1]:
        return "slab"
    if _is_table(points, size, unit):
        return "table"
    if len(points) < 40:
        return "object"
    tolerance = max(_SURFACE_M * unit, 0.04 * float(ordered[1]))
    round_share, square_share = _on_circle(points, size, tolerance), _on_faces(points, size, tolerance)
    if ordered[2] < _SMALL_M * unit and round_share > max(0.6, square_share):
        return "cylinder"
    return "box" if square_share > 0.75 else "object"


def _is_table(points: Array, size: Array, unit: float) -> bool:
    """Return whether it is a level top that most of the points lie on, wide, and high over the lowest of them."""
    if size[2] < 0.35 * unit or min(size[0], size[1]) < 0.35 * unit or len(points) < 40:
        return False
    top = points[:, 2] > float(np.quantile(points[:, 2], 0.95)) - 0.06 * unit
    if top.mean() < 0.6:
        return False
    return bool((np.ptp(points[top][:, :2], axis=0) > 0.7 * size[:2]).all())


def _sides(points: Array, size: Array) -> Array:
    """Return the points below the top and above the bottom of an instance: those that tell its outline."""
    level = points[:, 2] / max(float(size[2]), 1e-9)
    return points[(level < 0.3) & (level > -0.45)]


def _on_circle(points: Array, size: Array, tolerance: float) -> float:
    """Return the share of the sides that lie on the circle that fits them best (Kasa's linear fit, once reweighted); 0
    where the circle is not the size of the instance.
    """
    sides = _sides(points, size)[:, :2]
    if len(sides) < 20:
        return 0.0
    weight = np.ones(len(sides))
    for _ in range(3):
        left = np.column_stack([2.0 * sides, np.ones(len(sides))]) * weight[:, None]
        x, y, c = np.linalg.lstsq(left, (sides**2).sum(axis=1) * weight, rcond=None)[0]
        radius = float(np.sqrt(max(c + x * x + y * y, 0.0)))
        off = np.abs(np.linalg.norm(sides - (x, y), axis=1) - radius)
        weight = 1.0 / (1.0 + (off / tolerance) ** 2)
    wide = float(np.max(size[:2]))
    if not 0.7 * wide < 2.0 * radius < 1.25 * wide:
        return 0.0
    return float((off < tolerance).mean())


def _on_faces(points: Array, size: Array, tolerance: float) -> float:
    """Return the share of the sides that lie on the upright faces of the box."""
    sides = _sides(points, size)[:, :2]
    if len(sides) < 20:
        return 0.0
    return float((np.abs(np.abs(sides) - size[:2] / 2.0).min(axis=1) < tolerance).mean())


def describe(
    shape: str, color: str, size: Array, unit: float, *, metric: bool, structure: str | None, guessed: bool = False
) -> str:
    """Return the description of an instance: "small white cylinder, 9 cm".

    `shape` is the `shape_word` and `size` (3,) the full edge lengths of its box, world units; `unit` is what a metre is
    about, also where the memory is not metric, and then no centimetres are given. Of a guessed metre it is said.
    """
    longest = float(np.max(size))
    about = "about " if guessed else ""
    if structure is not None:
        what = {"plane": "flat surface"}.get(structure, structure)
        return _with_size(f"{color} {what}", longest, about, metric)
    metres = longest / unit
    scale = "tiny" if metres < 0.06 else "small" if metres < 0.3 else "medium" if metres < 0.8 else "large"
    return _with_size(f"long {color} bar" if shape == "bar" else f"{scale} {color} {shape}", longest, about, metric)


def _with_size(words: str, longest: float, about: str, metric: bool) -> str:
    if not metric:
        return words
    length = f"{longest * 100:.0f} cm" if longest < 0.995 else f"{longest:.1f} m"
    return f"{words}, {about}{length}"
