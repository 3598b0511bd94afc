"""A cut of the chunk's cloud into objects, rendered at each anchor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from list3r.frames.base import Frame
from list3r.instances.base import Proposals
from list3r.instances.geometric.cloud import Cloud
from list3r.instances.geometric.fusion import View
from list3r.instances.geometric.views import ChunkViews, chunk_views
from list3r.instances.settings import FEATURE_SPACE, InstanceSettings
from list3r.reconstruction.base import Reconstruction


@dataclass(frozen=True)
class Segment:
    """One object of the chunk."""

    plane: NDArray[np.float64] | None
    """Its plane in chunk coordinates where it is flat. Shape (4,)."""
    structure: bool
    """A surface that bounds the room."""
    score: float
    """How sure it is one object, in [0, 1]."""
    named: tuple[tuple[str, float], ...] = ()
    """Names that it may have, with their probabilities."""


@dataclass(frozen=True)
class Segmentation:
    """Every voxel's object."""

    labels: NDArray[np.int32]
    """0 for none, s + 1 for segment s. Shape (N,)."""
    segments: tuple[Segment, ...]
    up: NDArray[np.float64]
    """Upward direction, chunk frame. Shape (3,)."""


class CloudDiscoverer(ABC):
    """Proposes the objects of the chunk's fused cloud as masks on an anchor; subclasses segment it. The cloud of a
    chunk is segmented once, at the first anchor; the others render the same segments.
    """

    feature_space = FEATURE_SPACE

    def __init__(self, settings: InstanceSettings | None = None) -> None:
        self.settings = settings or InstanceSettings()
        self._views: ChunkViews | None = None
        self._cut: tuple[Cloud, Segmentation, NDArray[np.float32]] | None = None

    def __call__(self, frames: Sequence[Frame], reconstruction: Reconstruction, position: int) -> Proposals:
        """Propose masks on the frame at `position`, best first."""
        views = chunk_views(frames, reconstruction, self.settings)
        if views is not self._views or self._cut is None:
            self._views, self._cut = views, self._segment(views)
        return self.propose(reconstruction, position, *self._cut[1:])

    def propose(
        self, reconstruction: Reconstruction, position: int, cut: Segmentation, features: NDArray[np.float32]
    ) -> Proposals:
        """A cut of the cloud of the chunk in hand, as the frame at `position` sees it."""
        assert self._views is not None and self._cut is not None
        labels = self._label_view(self._views, position, self._cut[0], cut)
        shape = (reconstruction.camera.height, reconstruction.camera.width)
        view = self._views.view(position)
        return proposals_of(view, labels, cut, features, stride=self._views.stride, shape=shape)

    @abstractmethod
    def _segment(self, views: ChunkViews) -> tuple[Cloud, Segmentation, NDArray[np.float32]]:
        """Return the cloud of a chunk, its cut, and a feature of each segment. Shape (S, D)."""

    def _label_view(self, views: ChunkViews, position: int, cloud: Cloud, cut: Segmentation) -> NDArray[np.int32]:
        """Segment of each pixel of the view at `position`, 0 for none. Shape (h, w)."""
        if position in views.anchors:
            index = cloud.index[views.anchors.index(position)]
        else:
            index = _nearest_voxels(views.view(position), cloud)
        return np.asarray(np.append(cut.labels, 0)[index], np.int32)


def _nearest_voxels(view: View, cloud: Cloud) -> NDArray[np.int32]:
    """Voxel of the cloud nearest to each confirmed pixel of a view that is not part of it, -1 where none is near."""
    index = np.full(view.depth.shape, -1, np.int32)
    distance, nearest = cKDTree(cloud.points).query(view.points[view.confirmed], distance_upper_bound=3.0 * cloud.voxel)
    index[view.confirmed] = np.where(np.isfinite(distance), nearest, -1)
    return index


def proposals_of(
    view: View,
    labels: NDArray[np.int32],
    cut: Segmentation,
    features: NDArray[np.float32],
    *,
    stride: int,
    shape: tuple[int, int],
) -> Proposals:
    """Return the segments that a view shows as candidates; `labels` (h, w) is segment + 1 of each of its pixels."""
    count = np.bincount(labels.ravel(), minlength=len(cut.segments) + 1)[1:]
    score = np.array([segment.score for segment in cut.segments], np.float32)
    present = np.flatnonzero(count > 0)
    order = present[np.argsort(-score[present], kind="stable")]
    renumber = np.zeros(len(cut.segments) + 1, np.int32)
    renumber[order + 1] = np.arange(1, len(order) + 1)
    full = np.repeat(np.repeat(renumber[labels], stride, axis=0), stride, axis=1)[: shape[0], : shape[1]]
    planes = np.full((len(order), 4), np.nan)
    for row, number in enumerate(order):
        segment = cut.segments[number]
        if segment.plane is not None:
            planes[row] = segment.plane @ view.T_chunk_cam
    structure = np.array([cut.segments[number].structure for number in order], bool)
    named = tuple(cut.segments[number].named for number in order.tolist())
    return Proposals(
        position=view.position,
        labels=full,
        score=score[order],
        features=features[order],
        plane=planes,
        identity=order.astype(np.int64),
        structure=structure,
        named=named if any(named) else None,
    )
