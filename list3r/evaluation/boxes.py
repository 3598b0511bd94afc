"""Overlap of upright oriented boxes, exact by polygon clipping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import OrientedBox, Sim3, upright_box

Array = NDArray[np.float64]


def footprint(box: OrientedBox) -> Array:
    """Return the corners of an upright box in the plane, counterclockwise. Shape (4, 2)."""
    signs = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    return np.asarray(box.center[:2] + (signs * box.size[:2]) @ box.rotation[:2, :2].T)


def clip_polygon(subject: Array, clip: Array) -> Array:
    """Return the intersection of two convex counterclockwise polygons (Sutherland and Hodgman, 1974). (N, 2), (M, 2) ->
    (K, 2)."""
    out = subject
    for a, b in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        if len(out) == 0:
            break
        edge = b - a
        side = edge[0] * (out[:, 1] - a[1]) - edge[1] * (out[:, 0] - a[0])
        kept: list[Array] = []
        for k in range(len(out)):
            n = (k + 1) % len(out)
            if side[k] >= 0:
                kept.append(out[k])
            if (side[k] > 0 > side[n]) or (side[k] < 0 < side[n]):
                kept.append(out[k] + side[k] / (side[k] - side[n]) * (out[n] - out[k]))
        out = np.array(kept).reshape(-1, 2)
    return out


def polygon_area(polygon: Array) -> float:
    """Return the area of a counterclockwise polygon (N, 2)."""
    if len(polygon) < 3:
        return 0.0
    x, y = (polygon - polygon[0]).T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def intersection_volume(a: OrientedBox, b: OrientedBox) -> float:
    """Return the volume that two upright boxes share."""
    low = max(a.center[2] - a.size[2] / 2, b.center[2] - b.size[2] / 2)
    high = min(a.center[2] + a.size[2] / 2, b.center[2] + b.size[2] / 2)
    reach = (np.linalg.norm(a.size[:2]) + np.linalg.norm(b.size[:2])) / 2
    if high <= low or np.linalg.norm(a.center[:2] - b.center[:2]) >= reach:
        return 0.0
    return max(polygon_area(clip_polygon(footprint(a), footprint(b))), 0.0) * float(high - low)


def box_overlaps(
    truth: Sequence[OrientedBox], estimate: Sequence[OrientedBox], is_round: Sequence[bool] = ()
) -> tuple[Array, Array]:
    """Return IoU, and the share of each estimated box that is in each true one. Two of shape (T, E).

    True boxes with `is_round` have no yaw and take that of the estimate.
    """
    turns = list(is_round) or [False] * len(truth)
    shared = np.array(
        [
            [intersection_volume(replace(a, rotation=b.rotation) if turn else a, b) for b in estimate]
            for a, turn in zip(truth, turns, strict=True)
        ]
    ).reshape(len(truth), len(estimate))
    volume_a = np.array([np.prod(box.size) for box in truth]).reshape(-1, 1)
    volume_b = np.array([np.prod(box.size) for box in estimate]).reshape(1, -1)
    union = np.maximum(volume_a + volume_b - shared, 1e-12)
    return shared / union, shared / np.maximum(volume_b, 1e-12)


def upright(box: OrientedBox, tilt_deg: float = 1.0) -> OrientedBox:
    """Return the box itself if one of its axes is vertical within the tilt, else the least upright box of its corners.

    Axes are reordered so that the third one points up.
    """
    vertical = int(np.argmax(np.abs(box.rotation[2])))
    if abs(box.rotation[2, vertical]) < np.cos(np.deg2rad(tilt_deg)):
        return upright_box(box.corners())
    first, second = (vertical + 1) % 3, (vertical + 2) % 3
    yaw = np.arctan2(box.rotation[1, first], box.rotation[0, first])
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return OrientedBox(box.center, box.size[[first, second, vertical]], rotation)


def transform_box(S_a_b: Sim3, box: OrientedBox) -> OrientedBox:
    """Return a box of frame b in frame a."""
    center = S_a_b.apply(box.center[None])[0]
    return OrientedBox(center, float(S_a_b.scale) * box.size, S_a_b.rotation @ box.rotation)
