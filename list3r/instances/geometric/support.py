"""The surface points of instances, gathered from the anchors' fused views."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.base import Proposals
from list3r.instances.geometric.cloud import pack
from list3r.instances.geometric.views import ChunkViews
from list3r.memory.core.records import Support


def collect_supports(
    views: ChunkViews,
    proposals: Sequence[Proposals],
    images: Sequence[NDArray[np.int32]],
    count: int,
    max_points: int,
) -> list[Support]:
    """Support of each of `count` instances from label images (instance + 1) of the anchors, thinned by voxels."""
    points, rgb, confidence, owner = [], [], [], []
    for candidates, image in zip(proposals, images, strict=True):
        view = views.view(candidates.position)
        image = without_rims(image, view.depth, count) if views.reconstruction.depth_noise is not None else image
        mask = (image > 0) & view.confirmed
        single = views.reconstruction.confidence[candidates.position][:: views.stride, :: views.stride]
        points.append(view.points[mask])
        rgb.append(view.rgb[mask])
        confidence.append(single[mask].astype(np.float32))
        owner.append(image[mask] - 1)
    if not points:
        return []
    xyz, colors, sure, owners = (np.concatenate(part) for part in (points, rgb, confidence, owner))
    order = np.argsort(owners, kind="stable")
    bounds = np.searchsorted(owners[order], np.arange(count + 1))
    out = []
    for number in range(count):
        mine = order[bounds[number] : bounds[number + 1]]
        mine = mine[without_fliers(xyz[mine], views.unit)]
        out.append(thin(xyz[mine], colors[mine], sure[mine], views.unit, max_points))
    return out


RIM_STEP = 0.02
"""Step of depth within one pixel, over the depth, at which an outline occludes something farther."""
RIM_LEAST = 0.3
"""Least share of its pixels that an instance keeps, else it is nothing but rim and keeps all."""


def without_rims(image: NDArray[np.int32], depth: NDArray[np.float32], count: int) -> NDArray[np.int32]:
    """Return a label image without the pixels at occluding outlines.

    Depth computed from pictures compares windows of them. Windows at such an outline hold both surfaces, so the
    background is pulled forward and fringes the instance (research/colour-video 0140).
    """
    label, around = image.astype(np.float32), np.ones((3, 3), np.uint8)
    inner = (cv2.erode(label, around) == label) & (cv2.dilate(label, around) == label)
    kept = np.where(inner | (cv2.dilate(depth, around) < depth * (1.0 + RIM_STEP)), image, 0)
    size, left = (np.bincount(x.ravel(), minlength=count + 1) for x in (image, kept))
    return np.where(np.isin(image, np.flatnonzero(left < RIM_LEAST * size)), image, kept)


FLIER_VOXEL_M = 0.02
"""Voxel edge for counting points, to find flying points."""
FLIER_SHARE = 0.15
"""Points of a voxel, relative to the median of the object's points, below which they are flying points. Both chosen on
seeds 5000 to 5009 and walks 1 to 6 of the house (research/discovery 0081)."""


def without_fliers(points: NDArray[np.float32], unit: float) -> NDArray[np.int64]:
    """Return positions of the points that others confirm, ascending.

    Flying points at outlines are isolated: many views show the surface, one shows the outlier. Shape (N, 3) -> (M,).
    """
    _, inverse, number = np.unique(
        pack(np.floor(points / (FLIER_VOXEL_M * unit)).astype(np.int64)), return_inverse=True, return_counts=True
    )
    held = number[inverse]
    usual = float(np.median(held)) if len(held) else 0.0
    keep = np.flatnonzero(held >= max(2.0 if usual >= 4.0 else 1.0, FLIER_SHARE * usual))
    return keep if len(keep) >= 10 else np.arange(len(points))


def thin(
    points: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    confidence: NDArray[np.float32],
    unit: float,
    max_points: int,
) -> Support:
    """Support of one mean point in each voxel: 5 mm for small objects, larger so that at most `max_points` are left."""
    if not len(points):
        return Support(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.uint8))
    voxel = 0.005 * unit
    while True:
        _, inverse, number = np.unique(
            pack(np.floor(points / voxel).astype(np.int64)), return_inverse=True, return_counts=True
        )
        if len(number) <= max_points:
            break
        voxel *= max(1.15, np.sqrt(len(number) / max_points))
    mean = [np.bincount(inverse, points[:, k], minlength=len(number)) / number for k in range(3)]
    color = [np.bincount(inverse, rgb[:, k], minlength=len(number)) / number for k in range(3)]
    sure = np.bincount(inverse, confidence, minlength=len(number)) / number
    sure = sure * (1.0 - 0.5**number)
    return Support(
        np.stack(mean, axis=1).astype(np.float32),
        np.clip(sure, 0.0, 1.0).astype(np.float32),
        np.clip(np.rint(np.stack(color, axis=1)), 0, 255).astype(np.uint8),
    )
