"""Borders of things in computed depth, told by colour.

A plane sweep compares windows, and a window that holds a piece of what stands in front fits best at its depth: so what
stands in front is wider than it is, by up to the window's half and more where what lies behind it is plain. Where a
thing ends the picture tells better than the depth.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.cuts import Segmentation
from list3r.instances.geometric.features import lab_of
from list3r.instances.geometric.views import ChunkViews

SPILL_PX = 5.0
"""How much wider a thing may be on every side, px of a picture of 320: half a coarse window of the sweep and one."""
ROUNDS = 3
ODDS = 2.0
"""How many times likelier a colour must be outside a thing than inside to be no part of it, and the other way round."""
BIN = 8.0
"""Edge of the cells in which colours are counted, Lab with lightness halved; neighbours count too."""
_LOW, _SIZE = (0.0, -80.0, -80.0), (8, 20, 20)

Mask = NDArray[np.bool_]


def snap_things(views: ChunkViews, cloud: Cloud, cut: Segmentation, least: int) -> Segmentation:
    """The cut with voxels near the border of a thing given to what they look like a part of, by most of the views, and
    without things of which fewer than `least` voxels and half are left, and what a thing took as a whole.
    """
    thing = np.array([False, *(s.kind == "thing" for s in cut.segments)])
    votes = [np.zeros(0, np.int64)]
    for position, index in zip(views.anchors, cloud.index, strict=True):
        labels = np.append(cut.labels, 0)[index].astype(np.int32)
        found = snapped(views.view(position).rgb, labels, thing)
        known = index >= 0
        votes.append(index[known].astype(np.int64) * len(thing) + found[known])
    labels = _elected(cut.labels, np.concatenate(votes), len(thing))
    before, after = (np.bincount(x, minlength=len(thing)) for x in (cut.labels, labels))
    gone = (after == 0) | (thing & (after < np.minimum(least, 0.5 * before)))
    labels = np.where(gone[labels], 0, labels)
    return without_segments(Segmentation(labels, cut.segments, cut.up), ~gone[1:])


def without_segments(cut: Segmentation, kept: Mask) -> Segmentation:
    """The cut with some of its segments only. Shape (S,)."""
    renumber = np.append(0, np.where(kept, np.cumsum(kept), 0)).astype(np.int32)
    segments = tuple(s for s, keep in zip(cut.segments, kept, strict=True) if keep)
    return Segmentation(renumber[cut.labels], segments, cut.up)


def snapped(rgb: NDArray[np.uint8], labels: NDArray[np.int32], thing: Mask) -> NDArray[np.int32]:
    """Labels of a view in which things have given up, near their borders, what looks like what is around them, and
    taken what looks like them. Shapes (h, w, 3) and (h, w); `thing` says of each label whether it is one.
    """
    reach = SPILL_PX * rgb.shape[1] / 320.0
    cell = _cells(rgb)
    out = labels.copy()
    wide = int(np.ceil(2.0 * reach)) + 1
    for label in np.unique(labels[thing[labels]]).tolist():
        rows, columns = np.nonzero(labels == label)
        box = tuple(
            slice(max(0, int(x.min()) - wide), min(n, int(x.max()) + wide + 1))
            for x, n in zip((rows, columns), labels.shape, strict=True)
        )
        mine = labels[box] == label
        now = _by_color(mine, thing[labels[box]] & ~mine, cell[box], reach)
        out[box] = np.where(mine & ~now, 0, np.where(now & ~mine, label, out[box]))
    return out


def _by_color(mask: Mask, other: Mask, cell: NDArray[np.int64], reach: float) -> Mask:
    """A mask with its border, `reach` px on either side, told by colour; `other` things give nothing. Shape (h, w).

    Likelihoods of colours inside and around are counted in the middle and around the mask first, then in what they say.
    """
    inner = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1, mode="edge"), cv2.DIST_L2, 5)[1:-1, 1:-1]
    outer = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    core = mask & (inner >= min(reach, 0.5 * float(inner.max())))
    ring = ~mask & (outer <= 2.0 * reach)
    sure, free = mask & (inner > reach), ring & (outer <= reach) & ~other
    own, around = core, ring
    for _ in range(ROUNDS):
        odds = _share(cell[own])[cell] / _share(cell[around])[cell]
        now = sure | mask & (odds > 1.0 / ODDS) | free & (odds > ODDS)
        own, around = now, ring & ~now
        if not own.any() or not around.any():
            return mask
    now = cv2.medianBlur(now.astype(np.uint8), 3) > 0
    return np.asarray(_touching(now, mask & now))


def _touching(mask: Mask, seeds: Mask) -> Mask:
    """The connected parts of a mask that hold a seed."""
    _, part = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    return np.asarray(mask & np.isin(part, np.unique(part[seeds])))


def _cells(rgb: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Cell of each pixel's colour. Shape (h, w, 3) -> (h, w)."""
    lab = lab_of(rgb.reshape(-1, 3).astype(np.float32))
    at = np.clip(np.floor((lab - np.array(_LOW)) / BIN).astype(np.int64), 0, np.array(_SIZE) - 1)
    return np.asarray(((at[:, 0] * _SIZE[1] + at[:, 1]) * _SIZE[2] + at[:, 2]).reshape(rgb.shape[:2]))


def _share(cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """How likely a colour is by a sample, for every cell; colours that were never seen are a little likely too."""
    count = np.bincount(cells.ravel(), minlength=int(np.prod(_SIZE))).reshape(_SIZE).astype(np.float64)
    for axis in range(3):
        low, high = np.roll(count, 1, axis), np.roll(count, -1, axis)
        for moved, edge in ((low, 0), (high, -1)):
            np.moveaxis(moved, axis, 0)[edge] = 0.0
        count = count + 0.5 * (low + high)
    return np.asarray((count.ravel() + 1.0) / (count.sum() + count.size))


def _elected(labels: NDArray[np.int32], votes: NDArray[np.int64], count: int) -> NDArray[np.int32]:
    """The label with most votes of each voxel; that of before where it has as many, or nobody voted."""
    code, number = np.unique(votes, return_counts=True)
    voxel, label = code // count, (code % count).astype(np.int32)
    weight = 2 * number + (label == labels[voxel])
    order = np.lexsort((label, -weight, voxel))
    first = np.flatnonzero(np.diff(voxel[order], prepend=-1))
    out = labels.copy()
    out[voxel[order][first]] = label[order][first]
    return out
