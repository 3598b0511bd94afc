"""The discoverer whose weights are our own: trained networks over pieces of the chunk's cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from list3r.instances.geometric.cloud import Cloud, build_cloud
from list3r.instances.geometric.discovery import GeometricDiscoverer
from list3r.instances.geometric.features import object_feature
from list3r.instances.geometric.planes import Plane, find_planes
from list3r.instances.geometric.segments import Segment, Segmentation
from list3r.instances.geometric.surfaces import estimate_up
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.learned.cut import CloudCut, CutSettings, cut_cloud
from list3r.instances.learned.graph import Surroundings
from list3r.instances.learned.network import Weights
from list3r.instances.learned.weights import load_weights
from list3r.instances.settings import InstanceSettings

FLAT = 0.85
"""Share of a thing's voxels near its plane from which it is a flat surface."""


@dataclass(frozen=True)
class LearnedSettings:
    """What is listed, and where agglomeration stops."""

    least_confidence: float = 0.35
    """Things that are less probably one whole are scraps and not proposed; chosen on worlds for training, where recall
    and precision meet near it."""
    cut: CutSettings = field(default_factory=CutSettings)


class LearnedDiscoverer(GeometricDiscoverer):
    """Proposes the things of the chunk's fused cloud as masks on an anchor, cut by the trained networks."""

    def __init__(
        self,
        settings: InstanceSettings | None = None,
        weights: Path | None = None,
        learned: LearnedSettings | None = None,
    ) -> None:
        super().__init__(settings)
        self._learned = learned or LearnedSettings()
        self._weights: Weights = load_weights(weights)

    def _segment(self, views: ChunkViews) -> tuple[Cloud, Segmentation, NDArray[np.float32]]:
        settings = self.settings.segment
        shown = [views.view(p) for p in views.anchors]
        cloud = build_cloud(shown, settings.voxel_m * views.unit)
        poses = views.reconstruction.T_chunk_cam[views.reconstruction.posed]
        planes = find_planes(cloud, settings.plane_area_m2 * views.unit**2, views.unit)
        up = estimate_up(planes, poses)
        height = float(np.median(poses[:, :3, 3] @ up))
        around = Surroundings(up, views.unit, height, views.reconstruction.depth_noise is not None)
        cut = cut_cloud(cloud, shown, around, self._weights, self._learned.cut)
        sure = confidence(cut, self._weights)
        listed = (sure >= self._learned.least_confidence) | (cut.structure > 0.5)
        labels, segments, features = _described(
            cloud, *_walls_apart(cloud, cut.only(listed), sure[listed], planes), up, views.unit
        )
        return cloud, Segmentation(labels, tuple(segments), up), features


def confidence(cut: CloudCut, weights: Weights) -> NDArray[np.float32]:
    """Return the probability that each thing is one whole, by a logistic regression fitted in training. Shape (T,)."""
    x = (cut.features - weights["confidence.mean"]) / weights["confidence.std"]
    full = np.concatenate([x, x**2, np.ones((len(x), 1), np.float32)], axis=1)
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(full @ weights["confidence.weight"], -20, 20))), np.float32)


def _walls_apart(
    cloud: Cloud, cut: CloudCut, sure: NDArray[np.float32], planes: Sequence[Plane]
) -> tuple[CloudCut, NDArray[np.float32]]:
    """The cut with structure of several planes (walls round a corner) as one thing for each, and their confidence."""
    labels, origin = cut.labels.copy(), list(range(len(sure)))
    for number in np.flatnonzero(cut.structure > 0.5).tolist():
        mine = np.flatnonzero(cut.labels == number)
        faces = _faces(cloud, mine, planes)
        if len(faces) > 1:
            height = np.stack([np.abs(cloud.points[mine] @ f[:3] + f[3]) for f in faces])
            nearest = height.argmin(axis=0)
            for k in range(1, len(faces)):
                labels[mine[nearest == k]] = len(origin)
                origin.append(number)
    rows = np.array(origin, np.int64)
    return CloudCut(labels, cut.structure[rows], cut.names[rows], cut.features[rows]), sure[rows]


def _faces(cloud: Cloud, mine: NDArray[np.int64], planes: Sequence[Plane]) -> list[NDArray[np.float64]]:
    """Planes of which each holds a tenth of some voxels, none twice. Shape (4,) each."""
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


def _described(
    cloud: Cloud, cut: CloudCut, sure: NDArray[np.float32], up: NDArray[np.float64], unit: float
) -> tuple[NDArray[np.int32], list[Segment], NDArray[np.float32]]:
    """Labels from 1 (0 for none), what each segment is, and its feature."""
    rgb = np.clip(np.rint(cloud.rgb), 0, 255).astype(np.uint8)
    order = np.argsort(cut.labels, kind="stable")
    bounds = np.searchsorted(cut.labels[order], np.arange(len(cut.structure) + 1))
    segments, features = [], np.zeros((len(cut.structure), 64), np.float32)
    for number in range(len(cut.structure)):
        mine = order[bounds[number] : bounds[number + 1]]
        structure = bool(cut.structure[number] > 0.5)
        features[number] = object_feature(cloud.points[mine], rgb[mine], up, unit)
        plane = _plane_of(cloud, mine, unit)
        kind = "surface" if structure and plane is not None else "thing"
        segments.append(Segment(kind, plane, structure, float(sure[number]) if not structure else 0.95))
    return np.asarray(cut.labels + 1, np.int32), segments, features


def _plane_of(cloud: Cloud, mine: NDArray[np.int64], unit: float) -> NDArray[np.float64] | None:
    """Plane through the voxels of a flat thing, its normal towards the cameras, else None. Shape (4,)."""
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
