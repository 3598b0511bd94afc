"""Merge a chunk and its neighbours in time, in its frame, as if they were one chunk.

A single chunk has few instances, most of them seen from one side, and in a symmetric room they also fit the wrong way
round. Its neighbours add instances that do not fit there, and other sides of the rest (research/association 0147).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from list3r.association.revisits.cross_check import Side
from list3r.association.revisits.instance_similarity import SimilaritySettings, instance_set
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameSamples, Support
from list3r.memory.store.tables.local_instances import LocalNode

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class NeighbourhoodSettings:
    """The neighbourhood of a chunk, and which instances of two chunks are one object."""

    chunks: int = 5
    """Most chunks, itself included; 1 takes it alone."""
    steps: int = 4
    """Most edges between neighbours in time to another chunk."""
    near: float = 1.5
    """Largest distance between the centres of two chunks, share of the typical depth."""
    apart: float = 0.5
    """Largest distance between the centres of one object in two chunks, share of its smaller diagonal."""
    log_size: float = 0.9
    """Largest difference of the logarithms of its diagonals."""
    trim: float = 0.06
    """Share of the support points left outside at either end of each axis of a box."""
    most_instances: int = 120
    """Instances of all chunks together, those seen in most frames."""


@dataclass(frozen=True)
class Neighbour:
    """One chunk of the neighbourhood of another."""

    S_here_chunk: Sim3
    """To the frame of the central chunk."""
    nodes: Sequence[LocalNode]
    side: Side


def gather(
    parts: Sequence[Neighbour], space: str, settings: NeighbourhoodSettings | None = None
) -> tuple[list[LocalNode], Side]:
    """Return the instances and the samples of several chunks in the frame of the first one.

    Frames and local ids are renumbered; instances of two chunks at one position are merged. `space` is the embedding
    space of the features.
    """
    s = settings or NeighbourhoodSettings()
    first = parts[0].side
    if len(parts) == 1:
        return list(parts[0].nodes), first
    step_frame = 1 + max(int(p.side.samples.camera_frames.max(initial=0)) for p in parts)
    step_id = 1 + max(max([n.local_id for n in p.nodes] + [int(p.side.samples.instance.max(initial=0))]) for p in parts)
    nodes: list[LocalNode] = []
    one: dict[int, int] = {}
    samples = []
    for k, part in enumerate(parts):
        here = [_moved_node(n, part.S_here_chunk, k * step_frame, k * step_id) for n in part.nodes]
        nodes = _merged(nodes, here, one, s)
        samples.append(_moved_samples(part.side.samples, part.S_here_chunk, k * step_frame, k * step_id))
    together = _joined(samples)
    known = np.arange(len(parts) * step_id)
    known[list(one)] = list(one.values())
    instance = np.where(together.instance >= 0, known[together.instance], -1).astype(np.int32)
    moving = frozenset(int(known[i + k * step_id]) for k, p in enumerate(parts) for i in p.side.moving)
    whole = replace(together, instance=instance)
    similarity = replace(SimilaritySettings(), most_instances=s.most_instances)
    return nodes, Side(whole, first.camera, instance_set(nodes, whole.T_chunk_cam, space, similarity), moving)


def _moved_node(node: LocalNode, S: Sim3, frames: int, ids: int) -> LocalNode:
    points = S.apply(node.support.points.astype(np.float64))
    plane = node.plane
    if plane is not None:  # n p + d = 0, p = R^T (p_here - t) / s
        normal = S.rotation @ plane[:3]
        plane = np.append(normal, S.scale * plane[3] - normal @ S.translation).astype(plane.dtype)
    return replace(
        node,
        local_id=node.local_id + ids,
        plane=plane,
        support=replace(node.support, points=points.astype(np.float32)),
        frames=node.frames + frames,
    )


def _moved_samples(s: FrameSamples, S: Sim3, frames: int, ids: int) -> FrameSamples:
    T = s.T_chunk_cam.copy()
    T[:, :3, :3] = S.rotation @ T[:, :3, :3]
    T[:, :3, 3] = S.apply(s.T_chunk_cam[:, :3, 3])
    return replace(
        s,
        frame=s.frame + frames,
        points=S.apply(s.points.astype(np.float64)).astype(np.float32),
        instance=np.where(s.instance >= 0, s.instance + ids, -1).astype(np.int32),
        camera_frames=s.camera_frames + frames,
        T_chunk_cam=T,
    )


def _joined(parts: Sequence[FrameSamples]) -> FrameSamples:
    return FrameSamples(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(FrameSamples)})


def _merged(
    known: list[LocalNode], fresh: Sequence[LocalNode], one: dict[int, int], s: NeighbourhoodSettings
) -> list[LocalNode]:
    """Return the known instances with the fresh ones, merged where they are one object; `one` receives their ids."""
    out = list(known)
    at = {int(j): int(i) for i, j in _matches(known, fresh, s)}
    for j, node in enumerate(fresh):
        if j in at:
            one[node.local_id] = out[at[j]].local_id
            out[at[j]] = _both(out[at[j]], node)
        else:
            out.append(node)
    return out


def _matches(known: Sequence[LocalNode], fresh: Sequence[LocalNode], s: NeighbourhoodSettings) -> Ints:
    """Return rows of the two that are one object, each at most once, nearest first. Shape (P, 2)."""
    rows_u, rows_v = ([k for k, n in enumerate(nodes) if _is_static(n)] for nodes in (known, fresh))
    if not rows_u or not rows_v:
        return np.zeros((0, 2), np.int64)
    (center_u, size_u), (center_v, size_v) = (
        _boxes([nodes[k] for k in rows], s.trim) for nodes, rows in ((known, rows_u), (fresh, rows_v))
    )
    distance = np.linalg.norm(center_u[:, None] - center_v[None], axis=-1)
    share = distance / np.maximum(s.apart * np.minimum(size_u[:, None], size_v[None]), 1e-12)
    good = (share < 1) & (np.abs(np.log(size_u[:, None] / size_v[None])) < s.log_size)
    pairs = np.argwhere(good)
    used_u: set[int] = set()
    used_v: set[int] = set()
    out = []
    for i, j in pairs[np.argsort(share[good], kind="stable")].tolist():
        if i not in used_u and j not in used_v:
            used_u.add(i)
            used_v.add(j)
            out.append((rows_u[i], rows_v[j]))
    return np.array(out, np.int64).reshape(-1, 2)


def _is_static(node: LocalNode) -> bool:
    points = node.support.points
    return not node.structure and not node.dynamic and len(points) > 0 and bool(np.isfinite(points).all())


def _boxes(nodes: Sequence[LocalNode], trim: float) -> tuple[Array, Array]:
    """Return centres (N, 3) and diagonals (N,) of axis-aligned boxes, without the outermost points."""
    low_high = np.array([np.quantile(n.support.points, [trim, 1 - trim], axis=0) for n in nodes]).reshape(-1, 2, 3)
    size = np.linalg.norm(low_high[:, 1] - low_high[:, 0], axis=1)
    return low_high.mean(axis=1), np.maximum(size, 1e-9)


def _both(a: LocalNode, b: LocalNode) -> LocalNode:
    """Merge two local instances of one object; the feature is the mean over all frames."""
    feature = a.feature
    if a.feature.shape == b.feature.shape:
        mean = a.feature * len(a.frames) + b.feature * len(b.frames)
        feature = (mean / max(float(np.linalg.norm(mean)), 1e-12)).astype(a.feature.dtype)
    both = {f.name: np.concatenate([getattr(a.support, f.name), getattr(b.support, f.name)]) for f in fields(Support)}
    return replace(
        a,
        feature=feature,
        support=Support(**both),
        frames=np.concatenate([a.frames, b.frames]),
        boxes_xyxy=np.concatenate([a.boxes_xyxy, b.boxes_xyxy]),
        areas_px=np.concatenate([a.areas_px, b.areas_px]),
        visible_fraction=np.concatenate([a.visible_fraction, b.visible_fraction]),
    )
