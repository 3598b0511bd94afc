"""The default discoverer: networks of our own over pieces of the chunk's cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.base import Proposals
from list3r.instances.geometric.cloud import Cloud, build_cloud
from list3r.instances.geometric.cuts import CloudDiscoverer, Segment, Segmentation
from list3r.instances.geometric.features import object_feature
from list3r.instances.geometric.planes import Plane, estimate_up, find_planes
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.learned.cut import CloudCut, CutSettings, cut_cloud
from list3r.instances.learned.depth_errors import DepthErrorSettings, voxel_doubt, without_depth_bends, without_slivers
from list3r.instances.learned.graph import ChunkSurface, Surroundings, chunk_surface
from list3r.instances.learned.verdicts import SegmentVerdicts, names_of
from list3r.instances.learned.weights import load_weights
from list3r.instances.settings import InstanceSettings
from list3r.reconstruction.base import Reconstruction

Features = NDArray[np.float32]
"""Unit features of T objects. Shape (T, D)."""
OFF_WALL = 4.0
"""Voxels, added to three deviations of depth, beyond which a point is not on the plane of a wall or floor."""
MOST_NAMES = 8
"""Names kept per object at most,"""
LEAST_NAME = 0.01
"""and how probable they are at least."""
FLAT = 0.85
"""Share of an object's voxels near its plane from which it is a flat surface."""


@dataclass(frozen=True)
class LearnedSettings:
    """Thresholds for listing an object and for agglomeration."""

    least_confidence: float = 0.6
    """Segments that are less probably whole have low confidence: kept, not listed. On left-out worlds recall and
    precision are equal near it."""
    least_confidence_computed: float = 0.4
    """... where depth was computed from pictures; anything from 0.3 to 0.5 does as well on left-out rooms
    (research/discovery 0201)."""
    least_whole: float = 0.1
    """Objects that are less probably one whole are not even kept."""
    plane_area_m2: float = 0.25
    """Smallest flat surface searched for, to estimate gravity and to separate structure."""
    cut: CutSettings = field(default_factory=CutSettings)
    depth_errors: DepthErrorSettings = field(default_factory=DepthErrorSettings)
    """Of computed depth."""


class LearnedDiscoverer(CloudDiscoverer):
    """Proposes the objects of the chunk's fused cloud as masks on an anchor, cut by the trained networks."""

    def __init__(
        self,
        settings: InstanceSettings | None = None,
        weights: Path | None = None,
        learned: LearnedSettings | None = None,
    ) -> None:
        super().__init__(settings)
        self._learned = learned or LearnedSettings()
        self._weights = {sensed: load_weights(weights, sensed=sensed) for sensed in (True, False)}
        self._low_confidence: tuple[Segmentation, Features] | None = None

    def __call__(self, frames: Sequence[Frame], reconstruction: Reconstruction, position: int) -> Proposals:
        """Propose masks on the frame at `position`, best first, with the probability that each is one whole object."""
        found = super().__call__(frames, reconstruction, position)
        unsure = None if (cut := self._low_confidence) is None else self.propose(reconstruction, position, *cut)
        return replace(found, whole=found.score, low_confidence=unsure)

    def _segment(self, views: ChunkViews) -> tuple[Cloud, Segmentation, Features]:
        settings = self.settings.segment
        shown = [views.view(p) for p in views.anchors]
        computed = views.reconstruction.depth_noise is not None
        sensed = not computed and views.reconstruction.scale_kind == "metric"
        weights = self._weights[sensed]
        cloud = build_cloud(shown, settings.grain_m(sensed=sensed) * views.unit)
        poses = views.reconstruction.T_chunk_cam[views.reconstruction.posed]
        planes = find_planes(cloud, self._learned.plane_area_m2 * views.unit**2, views.unit)
        up = estimate_up(planes, poses)
        height = float(np.median(poses[:, :3, 3] @ up))
        if not len(cloud.keys):
            self._low_confidence = None
            return cloud, Segmentation(np.zeros(0, np.int32), (), up), np.zeros((0, 64), np.float32)
        around = Surroundings(up, views.unit, height, computed)
        surface = chunk_surface(cloud, shown, around)
        cut = cut_cloud(surface, weights, self._learned.cut)
        if around.computed:
            cut = self._as_sure_as_depth(views, surface, cut, planes)
        least = self._learned.least_confidence_computed if computed else self._learned.least_confidence
        listed = (cut.verdicts.whole >= least) | (cut.verdicts.structure > 0.5)
        parted = _walls_apart(cloud, cut.only(listed), planes)
        names = names_of(weights)
        kept, features = _described(cloud, parted, up, views.unit, names)
        unsure = cut.only(~listed & (cut.verdicts.whole >= self._learned.least_whole))
        self._low_confidence = _described(cloud, unsure, up, views.unit, names)
        return cloud, kept, features

    def _as_sure_as_depth(
        self, views: ChunkViews, surface: ChunkSurface, cut: CloudCut, planes: Sequence[Plane]
    ) -> CloudCut:
        """The cut without segments that errors of computed depth explain."""
        s, doubt = self._learned.depth_errors, voxel_doubt(views, surface.cloud)
        cut = without_depth_bends(surface, cut, planes, doubt, s)
        return without_slivers(surface.cloud, cut, doubt, s, 0.5 * self._learned.least_confidence_computed)


def _walls_apart(cloud: Cloud, cut: CloudCut, planes: Sequence[Plane]) -> CloudCut:
    """The cut with structure of several planes (walls round a corner) split into one segment per plane. Voxels off all
    planes (a ledge, a bit of a neighbour) become unlabelled, so that walls stay flat; empty segments are dropped.
    """
    labels, origin = cut.labels.copy(), list(range(len(cut.verdicts.structure)))
    for number in np.flatnonzero(cut.verdicts.structure > 0.5).tolist():
        mine = np.flatnonzero(cut.labels == number)
        faces = _faces(cloud, mine, planes)
        if faces:
            height = np.stack([np.abs(cloud.points[mine] @ f[:3] + f[3]) for f in faces])
            nearest = height.argmin(axis=0)
            for k in range(1, len(faces)):
                labels[mine[nearest == k]] = len(origin)
                origin.append(number)
            labels[mine[height.min(axis=0) > OFF_WALL * cloud.voxel + 3.0 * cloud.sigma[mine]]] = -1
    parted = CloudCut(labels, cut.verdicts.rows(np.array(origin, np.int64)))
    return parted.only(np.bincount(labels[labels >= 0], minlength=len(origin)) > 0)


def _faces(cloud: Cloud, mine: NDArray[np.int64], planes: Sequence[Plane]) -> list[NDArray[np.float64]]:
    """Distinct planes that hold a tenth of some voxels each. Shape (4,) each."""
    faces: list[NDArray[np.float64]] = []
    for plane in sorted(planes, key=lambda p: -len(p.members)):
        held = np.intersect1d(plane.members, mine, assume_unique=True)
        if len(held) < 0.1 * len(mine):
            continue
        middle = cloud.points[held].mean(axis=0)
        alike = [f[:3] @ plane.normal > 0.95 and abs(f[:3] @ middle + f[3]) < 10.0 * cloud.voxel for f in faces]
        if not any(alike):
            faces.append(plane.equation)
    return faces


def named(scores: SegmentVerdicts, names: Sequence[str]) -> list[tuple[tuple[str, float], ...]]:
    """Return the likeliest names of each object with their probabilities; none for structure.

    Uncertain ones are kept: the name is decided over all chunks.
    """
    out: list[tuple[tuple[str, float], ...]] = []
    for row, structure in zip(scores.names, scores.structure, strict=True):
        best = np.argsort(-row, kind="stable")[:MOST_NAMES]
        likely = [(names[k], round(float(row[k]), 4)) for k in best if row[k] >= LEAST_NAME]
        out.append(tuple(likely) if structure <= 0.5 else ())
    return out


def _described(
    cloud: Cloud, cut: CloudCut, up: NDArray[np.float64], unit: float, names: Sequence[str]
) -> tuple[Segmentation, Features]:
    """The segments of a cut and their features."""
    rgb, count = np.clip(np.rint(cloud.rgb), 0, 255).astype(np.uint8), len(cut.verdicts.structure)
    order = np.argsort(cut.labels, kind="stable")
    bounds = np.searchsorted(cut.labels[order], np.arange(count + 1))
    segments, features, likely = [], np.zeros((count, 64), np.float32), named(cut.verdicts, names)
    for number in range(count):
        mine = order[bounds[number] : bounds[number + 1]]
        structure = bool(cut.verdicts.structure[number] > 0.5)
        features[number] = object_feature(cloud.points[mine], rgb[mine], up, unit)
        plane = _plane_of(cloud, mine, unit)
        score = 0.95 if structure else float(cut.verdicts.whole[number])
        segments.append(Segment(plane, structure, score, named=likely[number]))
    return Segmentation(np.asarray(cut.labels + 1, np.int32), tuple(segments), up), features


def _plane_of(cloud: Cloud, mine: NDArray[np.int64], unit: float) -> NDArray[np.float64] | None:
    """Plane through the voxels of a flat object, its normal towards the cameras, else None. Shape (4,)."""
    if len(mine) < 30:
        return None
    points = cloud.points[mine].astype(np.float64)
    mean = points.mean(axis=0)
    values, axes = np.linalg.eigh(np.cov((points - mean).T))
    n = axes[:, 0]
    near = np.abs((points - mean) @ n) < 2.5 * cloud.sigma[mine] + 0.012 * unit
    if near.mean() < FLAT or values[1] < 9.0 * values[0]:
        return None
    n = n if float(n @ cloud.normals[mine].astype(np.float64).sum(axis=0)) > 0 else -n
    return np.append(n, -n @ mean)
