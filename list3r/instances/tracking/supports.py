"""The surface points of instances, gathered from the anchors' fused views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.instances.base import Proposals
from list3r.instances.geometric.support import thin, without_fliers
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.learned.readings import kept_readings
from list3r.instances.learned.weights import load_weights
from list3r.memory.records import Support


def collect_supports(
    views: ChunkViews,
    proposals: Sequence[Proposals],
    images: Sequence[NDArray[np.int32]],
    bases: NDArray[np.float64],
    max_points: int,
    most_off: float,
) -> list[Support]:
    """Support of each instance from label images (instance + 1) of the anchors, thinned by voxels.

    Readings that are off their surface with a probability above `most_off` are left out. `bases` (count, 4) are the
    planes, in chunk coordinates, of the walls and floors that flat instances lie on, NaN for the others.
    """
    points, rgb, confidence, owner, noise = [], [], [], [], []
    things = [np.where(_structural(views, p), 0, image) for p, image in zip(proposals, images, strict=True)]
    surface = surface_pixels(views, [p.position for p in proposals], things, most_off)
    for candidates, image, kept in zip(proposals, images, surface, strict=True):
        view = views.view(candidates.position)
        mask = (image > 0) & view.confirmed & kept
        single = views.reconstruction.confidence[candidates.position][:: views.stride, :: views.stride]
        points.append(view.points[mask])
        rgb.append(view.rgb[mask])
        confidence.append(single[mask].astype(np.float32))
        owner.append(image[mask] - 1)
        noise.append(view.reading[mask])
    if not points:
        return []
    xyz, colors, sure, owners, sigma = (np.concatenate(part) for part in (points, rgb, confidence, owner, noise))
    count = len(bases)
    order = np.argsort(owners, kind="stable")
    bounds = np.searchsorted(owners[order], np.arange(count + 1))
    out = []
    for number in range(count):
        mine = order[bounds[number] : bounds[number + 1]]
        mine = mine[without_fliers(xyz[mine], views.unit)]
        flat = len(mine) > 0 and np.isfinite(bases[number]).all()
        places = _press(xyz[mine], sigma[mine], bases[number]) if flat else xyz[mine]
        support = thin(places, colors[mine], sure[mine], views.unit, max_points)
        out.append(_set_on(support, bases[number]) if flat else support)
    return out


def _press(points: NDArray[np.float32], sigma: NDArray[np.float32], base: NDArray[np.float64]) -> NDArray[np.float32]:
    """Points of a flat thing with what may be noise of their depth taken off their height over its base."""
    height = points @ base[:3] + base[3]
    away = height - np.median(height)
    off = np.clip(away, -2.0 * sigma, 2.0 * sigma)
    return np.asarray(points - off[:, None] * base[:3], np.float32)


def _set_on(support: Support, base: NDArray[np.float64]) -> Support:
    """Support of a flat thing with every fourth point repeated on the base: it reaches down to what it lies on."""
    some = support.points[::4]
    height = some @ base[:3] + base[3]
    foot = (some - np.maximum(height, 0.0)[:, None] * base[:3]).astype(np.float32)
    return Support(
        np.concatenate([support.points, foot]),
        np.concatenate([support.confidence, 0.5 * support.confidence[::4]]).astype(np.float32),
        np.concatenate([support.rgb, support.rgb[::4]]),
    )


def surface_pixels(
    views: ChunkViews, positions: Sequence[int], images: Sequence[NDArray[np.int32]], most_off: float
) -> list[NDArray[np.bool_]]:
    """Return which pixels of anchors count; readings of things that lie off their surface do not. Shape (h, w) each.

    `images` (h, w) are thing + 1, 0 for none and for structure.
    """
    kept = [np.ones(image.shape, bool) for image in images]
    if most_off < 1.0 and any((image > 0).any() for image in images):
        told, start = kept_readings(load_weights(), views, positions, images, most_off), 0
        for pixels, image, position in zip(kept, images, positions, strict=True):
            mask = (image > 0) & views.view(position).confirmed
            pixels[mask] = told[start : start + mask.sum()]
            start += int(mask.sum())
    return kept


def _structural(views: ChunkViews, proposals: Proposals) -> NDArray[np.bool_]:
    """Pixels at working size that are of what bounds the room. Shape (h, w)."""
    stride = views.stride
    flags = np.append(False, proposals.structure if proposals.structure is not None else [])
    if len(flags) == 1:
        return np.zeros(proposals.labels[::stride, ::stride].shape, bool)
    return np.asarray(flags.astype(bool)[proposals.labels[::stride, ::stride]])
