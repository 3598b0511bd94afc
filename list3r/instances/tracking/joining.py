"""Candidates of several anchors that are views of one object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet

from list3r.instances.base import Proposals
from list3r.instances.geometric.fusion import View, intrinsics_of
from list3r.instances.geometric.kernels import propagate_labels
from list3r.instances.geometric.views import ChunkViews

MIN_OVERLAP = 0.4
"""IoU, over the surface that both anchors see, from which two candidates are one object."""


def join_candidates(views: ChunkViews, proposals: Sequence[Proposals]) -> list[NDArray[np.int64]]:
    """The instance of each candidate of each anchor, numbered from 0 in order of first sight.

    Candidates with a common identity are one; the others are joined best overlap first, and never two of one anchor.
    """
    offsets = np.cumsum([0] + [len(p.score) for p in proposals])
    sets = DisjointSet(range(int(offsets[-1])))
    anchor = np.repeat(np.arange(len(proposals)), [len(p.score) for p in proposals])
    if all(p.identity is not None for p in proposals):
        known = np.concatenate([p.identity for p in proposals if p.identity is not None] or [np.zeros(0, np.int64)])
        first: dict[int, int] = {}
        for node, identity in enumerate(known.tolist()):
            sets.merge(first.setdefault(identity, node), node)
    else:
        for _, a, b in sorted(_overlaps(views, proposals, offsets), key=lambda e: (-e[0], e[1], e[2])):
            if set(anchor[list(sets.subset(a))].tolist()).isdisjoint(anchor[list(sets.subset(b))].tolist()):
                sets.merge(a, b)
    number: dict[int, int] = {}
    joined = np.array([number.setdefault(sets[n], len(number)) for n in range(int(offsets[-1]))], np.int64)
    return [joined[offsets[a] : offsets[a + 1]] for a in range(len(proposals))]


def _overlaps(
    views: ChunkViews, proposals: Sequence[Proposals], offsets: NDArray[np.int64]
) -> list[tuple[float, int, int]]:
    """(overlap over union, node, node) of candidates of different anchors that see the same surface."""
    edges = []
    for a in range(len(proposals)):
        for b in range(a + 1, len(proposals)):
            table = _shared(views, proposals[a], proposals[b]) + _shared(views, proposals[b], proposals[a]).T
            inter = table[1:, 1:]
            union = table[1:].sum(axis=1)[:, None] + table[:, 1:].sum(axis=0)[None] - inter
            for n, m in np.argwhere(inter > np.maximum(MIN_OVERLAP * union, 30)):
                edges.append((float(inter[n, m] / union[n, m]), int(offsets[a] + n), int(offsets[b] + m)))
    return edges


def _shared(views: ChunkViews, source: Proposals, target: Proposals) -> NDArray[np.int64]:
    """Pixels of the source that see a surface of the target, by candidate in both (0 is none). Shape (N+1, M+1)."""
    a, b = views.view(source.position), views.view(target.position)
    label, agrees = transfer_labels(views, target.labels[:: views.stride, :: views.stride], b, a)
    mine = source.labels[:: views.stride, :: views.stride]
    width = len(target.score) + 1
    codes = mine[agrees].astype(np.int64) * width + label[agrees]
    return np.bincount(codes, minlength=(len(source.score) + 1) * width).reshape(-1, width)


def transfer_labels(
    views: ChunkViews, labels: NDArray[np.int32], source: View, target: View
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Labels of the source view as the target view sees them, and where both see the same surface. Shape (h, w)."""
    moved = np.linalg.inv(source.T_chunk_cam) @ target.T_chunk_cam
    return warp_labels(views, labels, source, target.depth, moved)


def warp_labels(
    views: ChunkViews,
    labels: NDArray[np.int32],
    source: View,
    depth: NDArray[np.float32],
    T_source_cam: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Labels of the source view looked up from a depth image of another camera. Shape (h, w) each."""
    camera = intrinsics_of(views.camera)
    return propagate_labels(
        np.ascontiguousarray(depth),
        camera,
        np.ascontiguousarray(T_source_cam, np.float32),
        (source.depth, np.ascontiguousarray(labels, np.int32)),
        (*views.noise_law, np.float32(0.005 * views.unit)),
    )
