"""From the overlapping soft masks of a network to the candidates of an anchor frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.instances.base import Proposals
from list3r.instances.geometric.fusion import View
from list3r.instances.geometric.views import ChunkViews
from list3r.instances.settings import CandidateSettings


@dataclass(frozen=True)
class SoftMasks:
    """A network's output for one picture, N masks."""

    probability: NDArray[np.float32]
    """In [0, 1] at each pixel. Shape (N, H, W)."""
    score: NDArray[np.float32]
    """In [0, 1]. Shape (N,)."""
    features: NDArray[np.float32]
    """Shape (N, D), any length."""
    names: tuple[str, ...] = ()
    """Class name of each mask, empty where the network has none."""


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
    labels = without_spill(labels, views.view(position), views.stride)
    features = _unit(masks.features[kept])
    structure = np.array([bool(masks.names) and bounds_the_room(masks.names[n]) for n in kept], bool)
    plane = np.full((len(kept), 4), np.nan)
    for k in range(len(kept)):
        if structure[k] or not masks.names:  # a mask with the name of an object is no floor or wall
            plane[k] = plane_of_mask(labels == k + 1, views, position, chosen.flat_rms)
    names = tuple(masks.names[n] for n in kept) if masks.names else None
    return Proposals(position, labels, score[kept], features, plane, structure=structure, names=names)


BORDER = 2
"""Pixels of the working size along the border of a mask that may belong to the background."""


def without_spill(labels: NDArray[np.int32], view: View, stride: int) -> NDArray[np.int32]:
    """Labels (H, W) without pixels near a mask's border that differ in depth from its inside.

    Edges of colour and of depth are never on the same pixel; otherwise every object would own a rim of the wall behind.
    Masks too small to have an inside stay as they are.
    """
    small = np.ascontiguousarray(labels[::stride, ::stride])
    keep = np.ones(small.shape, bool)
    ring = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
    for number in np.unique(small[small > 0]).tolist():
        mask = small == number
        inside = cv2.erode(mask.astype(np.uint8), ring, borderType=cv2.BORDER_REPLICATE) > 0
        inside &= view.depth > 0
        if inside.sum() < 12:
            continue
        _, at = cv2.distanceTransformWithLabels(
            (~inside).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        depth_of = np.zeros(int(at.max()) + 1, np.float32)
        depth_of[at[inside]] = view.depth[inside]
        step = np.abs(view.depth - depth_of[at])
        steep = 6.0 * view.reading + 4.0 * BORDER * view.depth / view.camera.fx
        keep &= ~(mask & ~inside & ((step > steep) | (view.depth <= 0)))
    full = np.repeat(np.repeat(keep, stride, axis=0), stride, axis=1)[: labels.shape[0], : labels.shape[1]]
    return np.where(full, labels, 0).astype(np.int32)


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
