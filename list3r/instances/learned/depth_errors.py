"""Segments that errors of computed depth may have made: bent walls and slivers.

Computed depth has a bias that is larger than its noise and constant over a patch, so a patch of a wall can float before
it like an object. Two cues that the networks do not have decide: the possible depth error there, and whether the
picture shows a border round the patch (research/discovery 0088).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.planes import Plane
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.learned.cut import CloudCut
from list3r.instances.learned.graph import ChunkSurface


@dataclass(frozen=True)
class DepthErrorSettings:
    """Limits of depth-error segments, chosen on walks 41 and 42 of `benchmarks/colour.py`."""

    deviations: float = 2.0
    """Deviations of depth within which a voxel may be in a plane."""
    within: float = 0.75
    """Share of an object's voxels that do, for its shape to say nothing."""
    step: float = 3.2
    """Median step of colour across the rim of an object, Lab with lightness halved, below which the picture shows no
    border. Patches of walls and floors had 0.9 to 2.6, pictures, rugs and bed-covers 4 to 28."""
    reach_px: int = 4
    """Pixels between the two sides of a rim that are compared."""
    least_spread: float = 0.58
    """Deviation of an object's points along the second of its axes over that of its depth, below which it is a sliver:
    as narrow as the depth error to either side."""


def voxel_doubt(views: ChunkViews, cloud: Cloud) -> NDArray[np.float32]:
    """Return the mean deviation of the computed depth that fell into each voxel, chunk units. Shape (N,)."""
    noise = views.reconstruction.depth_noise
    assert noise is not None
    total, count = np.zeros(len(cloud.keys)), np.zeros(len(cloud.keys))
    for position, index in zip(views.anchors, cloud.index, strict=True):
        known = index >= 0
        confidence = views.reconstruction.confidence[position][:: views.stride, :: views.stride]
        doubt = noise.doubt(views.view(position).depth[known], confidence[known])
        total += np.bincount(index[known], doubt, minlength=len(total))
        count += np.bincount(index[known], minlength=len(total))
    return np.asarray(total / np.maximum(count, 1.0), np.float32)


def without_depth_bends(
    surface: ChunkSurface, cut: CloudCut, planes: Sequence[Plane], doubt: NDArray[np.float32], s: DepthErrorSettings
) -> CloudCut:
    """Return the cut with patches of walls and floors joined to them: segments in the plane of a structure within the
    depth error `doubt` (N,), without a border in the pictures.
    """
    structure = cut.verdicts.structure > 0.5
    held = np.append(structure, False)[cut.labels]
    bounding = [p for p in planes if held[p.members].mean() > 0.5]
    steps = rim_steps(surface, cut, s.reach_px)
    into = np.arange(len(structure) + 1)
    order = np.argsort(cut.labels, kind="stable")
    bounds = np.searchsorted(cut.labels[order], np.arange(len(structure) + 1))
    for number in np.flatnonzero(~structure & (steps < s.step)).tolist():
        mine = order[bounds[number] : bounds[number + 1]]
        reach, points = s.deviations * doubt[mine] + surface.cloud.voxel, surface.cloud.points[mine]
        share = [float(np.mean(np.abs(p.height(points)) < reach)) for p in bounding]
        if share and max(share) >= s.within:
            owners = cut.labels[bounding[int(np.argmax(share))].members]
            into[number] = np.bincount(owners[np.append(structure, False)[owners]]).argmax()
    into[-1] = -1
    labels = np.asarray(into[cut.labels], np.int32)
    left = np.bincount(labels[labels >= 0], minlength=len(structure)) > 0
    return CloudCut(labels, cut.verdicts).only(left)


def rim_steps(surface: ChunkSurface, cut: CloudCut, reach_px: int) -> NDArray[np.float64]:
    """Return the median step of colour across the rim of each object, where beyond it is structure or nothing known.
    Infinite where nothing is. Shape (T,).
    """
    count = len(cut.verdicts.structure)
    structure, owner = np.append(cut.verdicts.structure > 0.5, True), [np.zeros(0, np.int64)]
    step = [np.zeros(0, np.float32)]
    for index, lab in zip(surface.cloud.index, surface.view_lab, strict=True):
        image = np.append(cut.labels, -1)[index]
        for axis in (0, 1):
            one, two = ([slice(None), slice(None)] for _ in range(2))
            one[axis], two[axis] = slice(None, -reach_px), slice(reach_px, None)
            for here, there in ((tuple(one), tuple(two)), (tuple(two), tuple(one))):
                rim = ~structure[image[here]] & structure[image[there]]
                owner.append(image[here][rim].astype(np.int64))
                step.append(np.linalg.norm(lab[here][rim] - lab[there][rim], axis=1))
    owners, steps = np.concatenate(owner), np.concatenate(step)
    out = np.full(count, np.inf)
    order = np.lexsort((steps, owners))
    bounds = np.searchsorted(owners[order], np.arange(count + 1))
    seen = np.flatnonzero(np.diff(bounds))
    out[seen] = steps[order[(bounds[seen] + bounds[seen + 1]) // 2]]
    return out


def without_slivers(
    cloud: Cloud, cut: CloudCut, doubt: NDArray[np.float32], s: DepthErrorSettings, most: float
) -> CloudCut:
    """Return the cut in which segments narrower than their depth error (N,) are whole with at most `most`."""
    whole = cut.verdicts.whole.copy()
    for number in np.flatnonzero((cut.verdicts.structure <= 0.5) & (whole > most)).tolist():
        mine = np.flatnonzero(cut.labels == number)
        second = float(np.linalg.eigvalsh(np.cov(cloud.points[mine].T))[1]) if len(mine) > 2 else 0.0
        if second < (s.least_spread * float(np.median(doubt[mine]))) ** 2:
            whole[number] = most
    return replace(cut, verdicts=replace(cut.verdicts, whole=whole))
