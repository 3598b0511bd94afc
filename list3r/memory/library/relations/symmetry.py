"""Instances that are round about the vertical: what was seen of one from the front tells its back."""

from __future__ import annotations

import numpy as np

from list3r.memory.core.geometry import Array
from list3r.memory.library.relations.settings import SymmetrySettings

_LAYERS, _SAMPLE, _STEPS = 8, 200, 6


def round_axis(points: Array, noise: float, settings: SymmetrySettings | None = None) -> Array | None:
    """Return where the vertical axis stands about which an instance is round, None if it is not. z is up.

    Cut into level layers, the points of a round instance have one distance from the axis in each: balls, bowls, vases,
    baskets. The axis is the one for which those distances vary least (Gauss-Newton, weights for absolute deviations,
    from the algebraic circles). An instance counts as round when they vary by less than the `noise` of a point and
    little for its size, and when the circles are not much wider than what was seen, as a flat side would make them.
    What has a lid or a bottom in sight does not; its outline is seen anyway. Shape (N, 3) -> (2,), world.
    """
    s = settings or SymmetrySettings()
    p = points[:: -(-len(points) // _SAMPLE)]
    height = float(np.ptp(p[:, 2]))
    if len(p) < 5 * _LAYERS or height <= 0.0:
        return None
    layer = np.minimum((p[:, 2] - p[:, 2].min()) / height * _LAYERS, _LAYERS - 1).astype(np.int64)
    middle = p[:, :2].mean(axis=0)
    xy = p[:, :2] - middle
    axis = np.linalg.lstsq(np.column_stack([2 * xy, np.eye(_LAYERS)[layer]]), (xy**2).sum(axis=1))[0][:2]
    weight = np.ones(len(xy))
    for _ in range(_STEPS):
        toward, off, _ = _around(xy, axis, layer, weight)
        weight = 1.0 / np.maximum(np.abs(off), 0.5 * noise)
        normal = (toward * weight[:, None]).T @ toward
        if np.linalg.det(normal) <= 1e-9 * np.trace(normal) ** 2:
            return None
        axis = axis - np.linalg.solve(normal, toward.T @ (weight * off))
    _, off, radius = _around(xy, axis, layer, np.ones(len(xy)))
    spread = float(np.sqrt(np.mean(np.minimum(np.abs(off), 2.0 * noise) ** 2)))
    seen = 0.5 * float(np.ptp(xy, axis=0).max())
    if spread > min(s.most_noise * noise, s.most_uneven * radius) or radius > s.most_radius * seen:
        return None
    return np.asarray(axis + middle)


def turned(points: Array, axis: Array) -> Array:
    """Return the points of a round instance with those that three quarter turns about its axis make of them. (N, 3) ->
    (4N, 3)
    """
    x, y = (points[:, :2] - axis).T
    quarters = [np.column_stack([a, b]) for a, b in ((x, y), (-y, x), (-x, -y), (y, -x))]
    return np.concatenate([np.column_stack([q + axis, points[:, 2]]) for q in quarters])


def _around(xy: Array, axis: Array, layer: Array, weight: Array) -> tuple[Array, Array, float]:
    """Return how the distances from the axis, less their mean in the layer, change with the axis (N, 2); those (N,);
    and the largest such mean.
    """
    away = xy - axis
    distance = np.linalg.norm(away, axis=1)
    toward = -away / np.maximum(distance, 1e-12)[:, None]
    total = np.maximum(np.bincount(layer, weight, _LAYERS), 1e-12)
    mean = [np.bincount(layer, weight * v, _LAYERS) / total for v in (distance, toward[:, 0], toward[:, 1])]
    slope = toward - np.column_stack([mean[1], mean[2]])[layer]
    return slope, distance - mean[0][layer], float(mean[0].max())
