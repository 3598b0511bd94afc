"""From the overlapping soft masks of a network to the candidates of an anchor frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.instances.base import Proposals
from list3r.instances.views import ChunkViews
from list3r.memory.errors import OptionError


@dataclass(frozen=True)
class CandidateSettings:
    """Which masks of a network become candidates."""

    min_score: float = 0.3
    """Class probability (or predicted quality) times the mean probability inside the mask."""
    max_overlap: float = 0.7
    """A mask of which a larger share lies under better ones is redundant (the ratio that panoptic networks use)."""
    min_area_share: float = 0.0002
    """Of the picture: 60 pixels of 640 x 480."""
    flat_rms: float = 2.0
    """A mask is flat when its points lie off their best plane by less than this many deviations of the noise."""

    def __post_init__(self) -> None:
        if not 0.0 < self.max_overlap <= 1.0:
            raise OptionError(f"max overlap {self.max_overlap} must lie in (0, 1]")


@dataclass(frozen=True)
class SoftMasks:
    """What a network says of one picture, N masks."""

    probability: NDArray[np.float32]
    """In [0, 1] at each pixel. Shape (N, H, W)."""
    score: NDArray[np.float32]
    """In [0, 1]. Shape (N,)."""
    features: NDArray[np.float32]
    """Shape (N, D), any length."""
    names: tuple[str, ...] = ()
    """What each shows, empty where the network does not say."""


def choose_candidates(
    masks: SoftMasks, views: ChunkViews, position: int, settings: CandidateSettings | None = None
) -> Proposals:
    """Disjoint candidates on the anchor at `position`, best first; each pixel goes to the best mask that holds it."""
    chosen = settings or CandidateSettings()
    height, width = masks.probability.shape[1:]
    inside = masks.probability > 0.5
    quality = np.array([p[m].mean() if m.any() else 0.0 for p, m in zip(masks.probability, inside, strict=True)])
    score = (masks.score * quality).astype(np.float32)
    labels = np.zeros((height, width), np.int32)
    kept: list[int] = []
    for n in np.argsort(-score, kind="stable").tolist():
        area = int(inside[n].sum())
        if score[n] < chosen.min_score or area < chosen.min_area_share * height * width:
            continue
        free = inside[n] & (labels == 0)
        if free.sum() < (1.0 - chosen.max_overlap) * area or not free.any():
            continue
        kept.append(n)
        labels[free] = len(kept)
    features = _unit(masks.features[kept])
    plane = np.array([plane_of_mask(labels == k + 1, views, position, chosen.flat_rms) for k in range(len(kept))])
    structure = np.array([bool(masks.names) and bounds_the_room(masks.names[n]) for n in kept], bool)
    names = tuple(masks.names[n] for n in kept) if masks.names else None
    return Proposals(position, labels, score[kept], features, plane.reshape(-1, 4), structure=structure, names=names)


def bounds_the_room(name: str) -> bool:
    """Whether a class name is one of floor, wall and ceiling (COCO panoptic: `wall-brick`, `floor-wood`, ...)."""
    return name.lower().replace("_", "-").split("-")[0].split(" ")[0] in ("wall", "floor", "ceiling")


def _unit(features: NDArray[np.float32]) -> NDArray[np.float32]:
    length = np.linalg.norm(features, axis=1, keepdims=True)
    return np.asarray(features / np.maximum(length, 1e-9), np.float32)


def plane_of_mask(
    mask: NDArray[np.bool_], views: ChunkViews, position: int, flat_rms: float = 2.0
) -> NDArray[np.float64]:
    """Plane of a candidate in the anchor's camera, towards it; NaN when it is not flat or too little is known."""
    view = views.view(position)
    small = mask[:: views.stride, :: views.stride] & view.confirmed
    if small.sum() < 30:
        return np.full(4, np.nan)
    T_cam_chunk = np.linalg.inv(view.T_chunk_cam)
    points = view.points[small].astype(np.float64) @ T_cam_chunk[:3, :3].T + T_cam_chunk[:3, 3]
    center = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - center, full_matrices=False)
    normal = axes[2] if axes[2] @ center < 0 else -axes[2]
    off = np.abs((points - center) @ normal)
    noise = np.maximum(view.sigma[small].astype(np.float64), 1e-9)
    flat = np.sqrt(np.mean(np.square(np.minimum(off / noise, 10.0)))) < flat_rms and spread[2] < 0.05 * spread[1]
    return np.append(normal, -normal @ center) if flat else np.full(4, np.nan)
