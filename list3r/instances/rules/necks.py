"""What hangs together in computed depth by necks alone, and is of different colours, parted.

What stands in front comes out up to `SPILL_PX` too wide on every side, so that two things which stand near each other
touch, by a neck that is narrower than twice that. Views from which one hides the gap are outvoted by those that see it.
Parts of one thing hang together by necks too, such as the seat and the back of a chair; they are of one colour.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.cuts import Segment, Segmentation
from list3r.instances.geometric.features import lab_of
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.rules.snapping import SPILL_PX

COLOR_STEP = 12.0
"""Difference of mean colours (Lab, lightness halved) from which two pieces are two things, as in `clutter`."""
COLOR_LENGTH_M = 0.003
"""Distance that one unit of colour difference counts for when a voxel takes a side, as there."""

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


def part_necks(views: ChunkViews, cloud: Cloud, cut: Segmentation, least: int) -> Segmentation:
    """The cut with things, and surfaces of things, in pieces where these touch by necks alone.

    A piece has at least `least` voxels; the largest stays what it was, the others are things.
    """
    labels, segments = cut.labels.copy(), list(cut.segments)
    for number, segment in enumerate(cut.segments, start=1):
        rows = np.flatnonzero(cut.labels == number)
        if segment.structure or segment.kind == "sheet" or len(rows) < 2 * least:
            continue
        pieces = _pieces(views, cloud, rows, least)
        for piece in range(1, int(pieces.max()) + 1):
            segments.append(Segment("thing", None, False, segment.score))
            labels[rows[pieces == piece]] = len(segments)
    return replace(cut, labels=labels, segments=tuple(segments))


def _pieces(views: ChunkViews, cloud: Cloud, rows: Ints, least: int) -> Ints:
    """Piece of each of some voxels, from 0, the largest. Shape (M,).

    The view that parts them best says what the pieces are, and the other views vote.
    """
    sides = _seen_sides(views, cloud, rows)
    split, seeds = 0, np.zeros(len(rows), np.int64)
    for side in sides:
        size = np.bincount(side)[1:]
        if len(size) > 1 and np.sort(size)[-2] > max(split, least - 1):
            split = int(np.sort(size)[-2])
            seeds = np.where(np.append(False, size >= least)[side], side, 0)
    numbers = np.unique(seeds[seeds > 0]).tolist()
    if len(numbers) < 2:
        return np.zeros(len(rows), np.int64)
    color = lab_of(cloud.rgb[rows])
    numbers.sort(key=lambda n: (-int((seeds == n).sum()), n))
    home: dict[int, int] = {}
    for n in numbers:
        one = [m for m in home if home[m] == m and not _apart(sides, seeds == m, seeds == n, color)]
        home[n] = one[0] if one else n
    kept = [n for n in numbers if home[n] == n]
    piece = np.full(int(seeds.max()) + 1, -1, np.int64)
    piece[numbers] = [kept.index(home[n]) for n in numbers]
    where = np.concatenate([cloud.points[rows] / views.unit, COLOR_LENGTH_M * color], axis=1)
    sown = np.flatnonzero(seeds)
    return np.asarray(piece[seeds[sown]][cKDTree(where[sown]).query(where)[1]])


def _seen_sides(views: ChunkViews, cloud: Cloud, rows: Ints) -> list[Ints]:
    """For each view that shows some of the voxels: the part of its mask that each lies in, 0 where it is not seen."""
    place = np.full(len(cloud.keys) + 1, -1, np.int64)
    place[rows] = np.arange(len(rows))
    out = []
    for position, index in zip(views.anchors, cloud.index, strict=True):
        voxel = place[index]
        side = _sides(voxel >= 0, SPILL_PX * views.view(position).rgb.shape[1] / 320.0)
        if side.any():
            seen = np.zeros(len(rows), np.int64)
            seen[voxel[voxel >= 0]] = side[voxel >= 0]
            out.append(seen)
    return out


def _apart(sides: list[Ints], a: Mask, b: Mask, color: NDArray[np.float32]) -> bool:
    """Whether two pieces are of different colours, and in different parts in most views that show a third of each."""
    if np.linalg.norm(color[a].mean(axis=0) - color[b].mean(axis=0)) < COLOR_STEP:
        return False
    votes = 0
    for side in sides:
        one, two = side[a], side[b]
        if (one > 0).mean() > 1 / 3 and (two > 0).mean() > 1 / 3:
            same = np.bincount(one[one > 0]).argmax() == np.bincount(two[two > 0]).argmax()
            votes += -1 if same else 1
    return votes > 0


def _sides(mask: Mask, reach: float) -> NDArray[np.int32]:
    """Of each pixel of a mask the number, from 1, of the nearest part that is left when its border, `reach` px wide, is
    taken away; 0 where nothing is left. Shape (h, w)."""
    inner = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1, mode="edge"), cv2.DIST_L2, 5)[1:-1, 1:-1]
    core = (inner > reach).astype(np.uint8)
    if not core.any():
        return np.zeros(mask.shape, np.int32)
    _, part = cv2.connectedComponents(core, connectivity=8)
    _, nearest = cv2.distanceTransformWithLabels(1 - core, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP)
    number = np.zeros(int(nearest.max()) + 1, np.int32)
    number[nearest[core > 0]] = part[core > 0]
    return np.asarray(np.where(mask, number[nearest], 0), np.int32)
