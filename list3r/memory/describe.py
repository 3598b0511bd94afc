"""Words for a thing without a label: size, colour and shape, and centimetres where the memory has metres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from list3r.memory.geometry import Array

_TERMS: tuple[tuple[str, tuple[float, float, float]], ...] = (
    ("black", (10, 0, 0)),
    ("dark grey", (33, 0, 0)),
    ("grey", (57, 0, 0)),
    ("light grey", (77, 0, 0)),
    ("white", (94, 0, 0)),
    ("red", (42, 58, 38)),
    ("dark red", (25, 38, 22)),
    ("pink", (72, 38, 4)),
    ("orange", (66, 36, 62)),
    ("brown", (36, 18, 26)),
    ("tan", (64, 10, 28)),
    ("beige", (83, 3, 18)),
    ("yellow", (82, 4, 76)),
    ("olive", (50, -6, 44)),
    ("green", (50, -42, 34)),
    ("dark green", (28, -24, 16)),
    ("light green", (80, -32, 32)),
    ("teal", (50, -28, -8)),
    ("light blue", (76, -10, -24)),
    ("blue", (40, 12, -52)),
    ("dark blue", (20, 10, -32)),
    ("purple", (38, 42, -40)),
)
"""Basic colour terms (Berlin and Kay) with shades, as CIE L*a*b* (D65) of what most people call so."""

_CENTERS = np.array([lab for _, lab in _TERMS])
_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_WHITE = np.array([0.95047, 1.0, 1.08883])


def lab_from_rgb(rgb: NDArray[np.uint8]) -> Array:
    """CIE L*a*b* (D65) of sRGB colours. Shape (..., 3) -> (..., 3)."""
    c = np.asarray(rgb, dtype=np.float64) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    t = linear @ _XYZ.T / _WHITE
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def color_name(rgb: NDArray[np.uint8]) -> str:
    """The colour term that most of the points wear. `rgb` has shape (N, 3); "grey" for none.

    Each point votes for its nearest term (lightness counts half: shading changes it most); the shade of the winning
    hue comes from the median of its voters.
    """
    if len(rgb) == 0:
        return "grey"
    lab = lab_from_rgb(rgb[:: -(-len(rgb) // 300)])
    hues = np.array([_hue(name) for name, _ in _TERMS])
    votes = _nearest(lab)
    winner = _winner(hues[votes])
    own = np.median(lab[hues[votes] == winner], axis=0)
    shades = np.flatnonzero(hues == winner)
    return _TERMS[int(shades[_nearest(own[None], shades)[0]])][0]


def _hue(name: str) -> str:
    word: str = name.split()[-1]
    return "grey" if word in ("black", "white") else word


def _winner(hues: NDArray[np.str_]) -> str:
    names, counts = np.unique(hues, return_counts=True)
    return str(names[np.argmax(counts)])


def _nearest(lab: Array, among: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    centers = _CENTERS if among is None else _CENTERS[among]
    d = lab[:, None, :] - centers[None]
    return np.asarray(np.argmin((d * np.array([0.5, 1.0, 1.0])) ** 2 @ np.ones(3), axis=1))


def median_rgb(rgb: NDArray[np.uint8]) -> tuple[int, int, int]:
    """Median colour of points, channel by channel. Shape (N, 3)."""
    if len(rgb) == 0:
        return (128, 128, 128)
    r, g, b = (int(x) for x in np.median(rgb, axis=0))
    return r, g, b


def shape_word(points: Array, size: Array) -> str:
    """sheet, slab, long, round or box-like, from points (N, 3) in the axes of their box and its full edge lengths (3,).

    Round is told by the footprint: the points of a cylinder that is seen from one side or all round lie on a circle,
    which a box of its extents leaves at the corners.
    """
    ordered = np.sort(np.maximum(size, 1e-9))
    if ordered[0] < 0.12 * ordered[1]:
        return "sheet"
    if ordered[2] > 3.0 * ordered[1]:
        return "long thing"
    if ordered[0] < 0.3 * ordered[1]:
        return "slab"
    width = size[:2]
    if min(width) > 0.7 * max(width) and len(points) >= 40 and ordered[2] < 3.0 * min(width):
        radial = np.linalg.norm(
            (points[:, :2] - (points[:, :2].min(axis=0) + np.ptp(points[:, :2], axis=0) / 2)) / (width / 2), axis=1
        )
        corner = float((radial > 1.12).mean())
        rim = float(((radial > 0.75) & (radial <= 1.12)).mean())
        if corner < 0.06 and rim > 0.35:
            return "cylinder"
    return "box"


def describe(points: Array, color: str, size: Array, unit: float, *, metric: bool, structure: str | None) -> str:
    """Description of a thing: "small white cylinder, 9 cm".

    `points` (N, 3) are in the axes of its box and `size` (3,) are the box's full edge lengths, world units; `unit` is
    what a metre is about, also where the memory is not metric, and then no centimetres are told.
    """
    longest = float(np.max(size))
    if structure is not None:
        what = {"plane": "flat surface"}.get(structure, structure)
        return _with_size(f"{color} {what}", longest, metric)
    metres = longest / unit
    scale = "tiny" if metres < 0.06 else "small" if metres < 0.3 else "medium" if metres < 0.8 else "large"
    return _with_size(f"{scale} {color} {shape_word(points, size)}", longest, metric)


def _with_size(words: str, longest: float, metric: bool) -> str:
    if not metric:
        return words
    return f"{words}, {longest * 100:.0f} cm" if longest < 1.0 else f"{words}, {longest:.1f} m"
