"""What colour says about two sessions: of surfaces that lie on one another, and of two instances wherever they are.

Depth cannot tell a book from the book that lies in its place. Their surfaces meet, so the colours of points that meet
are compared, in the light of the later session: what all surfaces that meet have in common is the light, and how far
they lie about it is the noise (decision 0059).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.memory.core.description.colors import lab_from_rgb
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.library.change.records import ChangeSettings
from list3r.memory.library.overlap.pair_scores import PairScores
from list3r.memory.library.overlap.voxels import ChunkShapes

Colors = NDArray[np.uint8]
HALF_LIGHT = np.array([0.5, 1.0, 1.0])
_HUE_CELL, _HUE_CELLS = 0.08, 48
_LEAST_POINTS, _LEAST_SURFACE = 12, 200
"""Points that must meet, for two instances to be compared, and for the light of two sessions."""


@dataclass(frozen=True)
class LightBetween:
    """How the colours of one session come out in another."""

    gain: Array
    """Of red, green and blue, as they are stored. Shape (3,)."""
    noise: float
    """Median distance of what meets, that apart; CIE L*a*b*, lightness at half weight."""

    @staticmethod
    def of(before: Colors, after: Colors) -> LightBetween | None:
        """Return what the colours of surfaces that meet tell, (N, 3) each; None where that is too few."""
        if len(before) < _LEAST_SURFACE:
            return None
        a, b = np.maximum(before.astype(float), 8.0), np.maximum(after.astype(float), 8.0)
        light = LightBetween(np.exp(np.median(np.log(b / a), axis=0)), 0.0)
        return LightBetween(light.gain, float(np.median(color_distance(light.lab(before), lab(after)))))

    def lab(self, rgb: Colors) -> Array:
        """Return colours of the earlier session as they would look in the later one. Shape (N, 3)."""
        return lab(np.clip(rgb * self.gain, 0.0, 255.0))

    def limit(self, s: ChangeSettings) -> float:
        """Return the median distance from which surfaces that meet are two surfaces."""
        return max(s.other_surface, s.other_surface_noise * self.noise)


SAME_LIGHT = LightBetween(np.ones(3), 0.0)


def lab(rgb: NDArray[Any]) -> Array:
    """Return CIE L*a*b* with lightness at half weight, which shading changes most. Shape (N, 3)."""
    return np.asarray(lab_from_rgb(rgb) * HALF_LIGHT)


def color_distance(a: Array, b: Array) -> Array:
    """Return distances of colours row by row. Shape (N,)."""
    return np.asarray(np.linalg.norm(a - b, axis=1))


def meeting(surface: cKDTree, points: Array, reach: float) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which points meet a surface, and the points of that which those are nearest to. Shapes (N,), (M,)."""
    far, at = (np.asarray(x) for x in surface.query(points, distance_upper_bound=reach))
    near = far < np.inf
    return near, at[near].astype(np.int64)


def palette_distance(a: Array, b: Array) -> float:
    """Return how far the colours of one instance lie from those of another, however much of each was seen.

    The median distance to the nearest colour of the other, the larger of both ways. Shapes (N, 3), (M, 3).
    """
    if not len(a) or not len(b):
        return float("inf")
    return max(float(np.median(cKDTree(y).query(x)[0])) for x, y in ((a, b), (b, a)))


def hue_distance(a: Array, b: Array) -> float:
    """Return how far the hues of two instances differ, and what share each has, however bright the light: 1 less the
    Bhattacharyya coefficient of their histograms, in [0, 1].

    Of a surface in less light L* + 16, a* and b* shrink alike, so that a* and b* are taken over L* + 16. Shapes (N, 3),
    (M, 3).
    """
    if not len(a) or not len(b):
        return 1.0
    shares = [_hue_histogram(x) for x in (a, b)]
    return max(0.0, 1.0 - float(np.sqrt(shares[0] * shares[1]).sum()))


def _hue_histogram(lab: Array) -> Array:
    """Shares of cells of `_HUE_CELL`, every colour dealt out to the four nearest. Shape (N, 3) -> (K, K)."""
    at = lab[:, 1:] / (2.0 * lab[:, :1] + 16.0) / _HUE_CELL + _HUE_CELLS / 2
    low = np.clip(np.floor(at).astype(np.int64), 0, _HUE_CELLS - 2)
    part = np.clip(at - low, 0.0, 1.0)
    out = np.zeros((_HUE_CELLS, _HUE_CELLS))
    for x in (0, 1):
        for y in (0, 1):
            weight = np.abs(1 - x - part[:, 0]) * np.abs(1 - y - part[:, 1])
            np.add.at(out, (low[:, 0] + x, low[:, 1] + y), weight)
    return out / len(lab)


def other_surfaces(u: ChunkShapes, v: ChunkShapes, p: PairScores, S_v_u: Sim3, s: ChangeSettings) -> NDArray[np.bool_]:
    """Return which pairs of instances of two chunks of two sessions have other colours where their surfaces meet.

    False where too little meets, or one is structure. Shape (E,).
    """
    out = np.zeros(len(p.i), bool)
    reach = s.meets_m * v.unit
    points = S_v_u.apply(u.points) if len(u.points) else u.points
    trees: dict[int, tuple[cKDTree, Colors]] = {}
    met: list[tuple[int, Colors, Colors]] = []
    for n in np.flatnonzero(np.maximum(p.i_on_j, p.j_on_i) >= s.meets).tolist():
        i, j = int(p.i[n]), int(p.j[n])
        own = slice(*np.searchsorted(u.owner, [i, i + 1]))
        if j not in trees:
            other = slice(*np.searchsorted(v.owner, [j, j + 1]))
            trees[j] = cKDTree(v.points[other]), v.rgb[other]
        tree, rgb = trees[j]
        near, at = meeting(tree, points[own], reach)
        met.append((n, u.rgb[own][near], rgb[at]))
    if not met:
        return out
    light = LightBetween.of(np.concatenate([a for _, a, _ in met]), np.concatenate([b for _, _, b in met]))
    if light is None:
        return out
    for n, a, b in met:
        if len(a) >= _LEAST_POINTS and not (u.structure[p.i[n]] or v.structure[p.j[n]]):
            out[n] = float(np.median(color_distance(light.lab(a), lab(b)))) > light.limit(s)
    return out


def small_picture(jpeg: bytes, height: int, width: int) -> Colors | None:
    """Return a stored picture at the size of the depth image beside it, RGB, shape (h, w, 3); None if damaged."""
    from PIL import Image

    try:
        picture = Image.open(io.BytesIO(jpeg))
        picture.draft("RGB", (width, height))
        return np.asarray(picture.convert("RGB").resize((width, height), Image.Resampling.BOX))
    except (OSError, ValueError, Image.DecompressionBombError):
        return None
