"""Which readings of things lie off their surface: a small network over what the views around say of each.

Depth at outlines, on slanted surfaces and of phones' LiDAR mixes what is near with what is behind it; such readings
stretch the boxes of things. A reading is told by where it lies in its mask, how depth runs round it, and whether other
anchors see a surface of the same thing there (docs/decisions/0125-readings-off-their-surface.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import pack
from list3r.instances.geometric.fusion import Float, View
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.learned.network import Weights, two_layers

FEATURES = 24
NEIGHBOURS = 4
"""Anchors to either side that are asked about a reading."""
GRAIN_M = 0.02
"""Edge of the voxels in which readings are counted."""
OFF_M = 0.03
"""Distance from the surface from which a reading is off it, in training."""
LEAST_SHARE, LEAST_COUNT = 0.15, 10
"""Readings of a thing that are kept whatever the network says."""

Images = Sequence[NDArray[np.int32]]


def kept_readings(weights: Weights, views: ChunkViews, positions: Sequence[int], images: Images, most: float) -> Float:
    """Return which readings of things lie on their surface: with a probability above `most` they are off it.

    `images` (h, w) are thing + 1 on the anchors at `positions`, 0 for none. Readings are the confirmed pixels of
    things, anchor by anchor, row by row. Shape (N,).
    """
    x = reading_features(views, positions, images)
    x = (x - weights["readings.mean"]) / weights["readings.std"]
    off = 1.0 / (1.0 + np.exp(-two_layers(weights, "readings.net", np.asarray(x, np.float32))[:, 0].clip(-30, 30)))
    shown = [views.view(p) for p in positions]
    owner = np.concatenate([image[(image > 0) & v.confirmed] for v, image in zip(shown, images, strict=True)])
    keep = off <= most
    count, kept = np.bincount(owner), np.bincount(owner, keep)
    least = np.maximum(LEAST_COUNT, LEAST_SHARE * count)
    for number in np.flatnonzero((count > 0) & (kept < least)).tolist():
        mine = np.flatnonzero(owner == number)
        keep[mine[np.argsort(off[mine], kind="stable")[: int(np.ceil(least[number]))]]] = True
    return np.asarray(keep)


def reading_features(views: ChunkViews, positions: Sequence[int], images: Images) -> Float:
    """Return what is known of the readings of things. Shape (N, FEATURES)."""
    shown = [views.view(p) for p in positions]
    rows = [np.flatnonzero((image > 0) & v.confirmed) for v, image in zip(shown, images, strict=True)]
    parts = []
    for k, view in enumerate(shown):
        others = [j for j in range(max(0, k - NEIGHBOURS), min(len(shown), k + NEIGHBOURS + 1)) if j != k]
        near = [(shown[j], images[j]) for j in others]
        parts.append(
            np.column_stack([_around(view, images[k], rows[k], views.unit), _seen(view, images[k], rows[k], near)])
        )
    points = np.concatenate([v.points.reshape(-1, 3)[r] for v, r in zip(shown, rows, strict=True)]) / views.unit
    owner = np.concatenate([image.ravel()[r] for image, r in zip(images, rows, strict=True)])
    computed = np.full(len(owner), views.reconstruction.depth_noise is not None)
    x = np.column_stack([np.concatenate(parts), _among(points, owner), computed])
    return np.asarray(x, np.float32)


def _around(view: View, image: NDArray[np.int32], rows: NDArray[np.int64], unit: float) -> Float:
    """What the view itself shows round readings. Shape (n, 10)."""
    depth = view.depth
    far, safe = np.where(depth > 0, depth, np.float32(1e3)), np.maximum(depth, np.float32(0.1 * unit))
    small, large = np.ones((3, 3), np.uint8), np.ones((7, 7), np.uint8)
    low, high = cv2.erode(far, large), cv2.dilate(depth, large)
    steep = cv2.dilate(depth, small) - cv2.erode(far, small)
    known = cv2.blur((depth > 0).astype(np.float32), (7, 7))
    rim = np.zeros(image.shape, np.uint8)
    rim[:, 1:] |= image[:, 1:] != image[:, :-1]
    rim[:, :-1] |= image[:, 1:] != image[:, :-1]
    rim[1:] |= image[1:] != image[:-1]
    rim[:-1] |= image[1:] != image[:-1]
    inside = np.minimum(cv2.distanceTransform(1 - rim, cv2.DIST_L2, 3), 10.0) / 3.0
    ray = view.points - view.T_chunk_cam[:3, 3].astype(np.float32)
    length = np.linalg.norm(ray, axis=-1)
    facing = np.abs((view.normals * ray).sum(axis=-1)) / np.maximum(length, 1e-6)
    columns = [
        100.0 * view.sigma / safe,
        safe / np.float32(unit),
        np.minimum(20.0 * steep / safe, 5.0),
        np.minimum(20.0 * (high - low) / safe, 5.0),
        known,
        inside,
        facing,
        np.abs(view.normals).sum(axis=-1) > 0.5,
        np.minimum(20.0 * (depth - low) / safe, 5.0),
        np.minimum(20.0 * (high - depth) / safe, 5.0),
    ]
    return np.stack([c.ravel()[rows] for c in columns], axis=1).astype(np.float32)


def _seen(
    view: View, image: NDArray[np.int32], rows: NDArray[np.int64], others: Sequence[tuple[View, NDArray[np.int32]]]
) -> Float:
    """What other anchors see where readings lie: the surface, what is behind it, something before it; and whether it is
    of the same thing there. Shape (n, 8).
    """
    points, own = view.points.reshape(-1, 3)[rows], image.ravel()[rows]
    agree, through, hidden, same, other, off = np.zeros((6, len(rows)), np.float32)
    for seen, labels in others:
        T = np.linalg.inv(seen.T_chunk_cam).astype(np.float32)
        at = points @ T[:3, :3].T + T[:3, 3]
        z = np.maximum(at[:, 2], np.float32(1e-6))
        c = seen.camera
        x = np.rint(at[:, 0] / z * np.float32(c.fx) + np.float32(c.cx)).astype(np.int64)
        y = np.rint(at[:, 1] / z * np.float32(c.fy) + np.float32(c.cy)).astype(np.int64)
        ok = (at[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < c.width) & (y < c.height)
        x, y = np.where(ok, x, 0), np.where(ok, y, 0)
        read = seen.depth[y, x]
        ok &= read > 0
        residual = read - z
        reach = 3.0 * np.hypot(view.sigma.ravel()[rows], seen.sigma[y, x]) + 0.002 * z
        near, behind = ok & (np.abs(residual) < reach), ok & (residual >= reach) & seen.confirmed[y, x]
        alike = labels[y, x] == own
        agree += near
        through += behind
        hidden += ok & (residual <= -reach)
        same += near & alike
        other += (near | behind) & ~alike
        off += np.where(near, residual, 0.0)
    z = np.maximum(view.depth.ravel()[rows], np.float32(1e-6))
    columns = [
        np.log1p(agree),
        np.log1p(through),
        agree / (agree + through + 1.0),
        np.log1p(hidden),
        same / (same + other + 1.0),
        np.log1p(same),
        np.log1p(other),
        50.0 * off / (agree + 1.0) / z,
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def _among(points: Float, owner: NDArray[np.int32]) -> Float:
    """How many others of its thing lie near each reading, and how large its thing is; metres. Shape (N, 5)."""
    out = np.zeros((len(points), 5), np.float32)
    order = np.argsort(owner, kind="stable")
    starts = np.flatnonzero(np.diff(owner[order], prepend=-1))
    for mine in np.split(order, starts[1:]) if len(order) else []:
        own = points[mine]
        codes = pack(np.floor(own / GRAIN_M).astype(np.int64))
        _, inverse, number = np.unique(codes, return_inverse=True, return_counts=True)
        held = number[inverse]
        extent = np.sort(np.ptp(np.quantile(own, [0.01, 0.99], axis=0), axis=0))
        out[mine, 0] = np.log(held / np.median(held))
        out[mine, 1:4] = np.log(np.maximum(extent, 0.005))
        out[mine, 4] = np.log(len(mine))
    return out
