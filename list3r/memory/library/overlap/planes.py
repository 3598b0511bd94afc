"""Flat surfaces of the chunks, the evidence for which way is up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import FrameSamples
from list3r.memory.store.tables.local_instances import LocalNode


@dataclass(frozen=True)
class Planes:
    """P flat surfaces in the frame of the pose graph."""

    normal: Array
    """Unit normals, towards the cameras that saw them. Shape (P, 3)."""
    center: Array
    """Centroids. Shape (P, 3)."""
    area: Array
    """Area of the convex hull of the support in the plane, square units. Shape (P,)."""
    points: Array | NDArray[np.float32]
    """A sample of all support points, of what is flat and what is not. Shape (N, 3)."""
    owner: NDArray[np.int32] | NDArray[np.int64]
    """Plane of each point, -1 for points of what is not flat. Shape (N,)."""
    faces: Array | NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3)))
    """Unit normals of a sample of all that looks flat, towards the cameras: computed depth shows few planes, and those
    bent. None of sensor depth. Shape (S, 3)."""


_FACES, _AROUND, _THIN = 1500, 30, 0.1
"""Places of a chunk that are looked at, points around each, and their least spread over the next of what is flat."""


def sampled_faces(samples: FrameSamples) -> NDArray[np.float32]:
    """Return unit normals, towards the cameras, of a sample of the flat surface that a chunk saw. Shape (S, 3)."""
    points = samples.points.astype(np.float64)
    if len(points) < 2 * _AROUND:
        return np.zeros((0, 3), np.float32)
    chosen = np.arange(0, len(points), max(1, len(points) // _FACES))
    around = points[cKDTree(points).query(points[chosen], k=_AROUND)[1]]
    around -= around.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    flat = spread[:, 0] < _THIN * spread[:, 1]
    normal, chosen = axes[flat, :, 0], chosen[flat]
    eyes = samples.T_chunk_cam[np.searchsorted(samples.camera_frames, samples.frame[chosen]), :3, 3]
    facing = np.einsum("ni,ni->n", normal, eyes - points[chosen])
    return np.asarray(normal * np.where(facing < 0, -1.0, 1.0)[:, None], np.float32)


def chunk_planes(nodes: Sequence[LocalNode], sample: int = 60) -> Planes:
    """Return the flat local instances of one chunk, and at most about `sample` points of each local instance; its
    frame.
    """
    normals: list[Array] = []
    centers, areas, points, owner = [], [], [], []
    for node in nodes:
        p = node.support.points.astype(np.float64)
        if len(p) == 0:
            continue
        points.append(node.support.points[:: max(1, len(p) // sample)])
        owner.append(np.full(len(points[-1]), -1 if node.plane is None else len(normals), np.int32))
        if node.plane is None:
            continue
        normal = node.plane[:3] / max(float(np.linalg.norm(node.plane[:3])), 1e-12)
        normals.append(normal)
        centers.append(p.mean(axis=0))
        areas.append(planar_area(p, normal))
    return Planes(
        np.array(normals).reshape(-1, 3),
        np.array(centers).reshape(-1, 3),
        np.array(areas, dtype=np.float64),
        np.concatenate(points) if points else np.zeros((0, 3), np.float32),
        np.concatenate(owner) if owner else np.zeros(0, np.int32),
    )


def place_planes(parts: Sequence[tuple[Planes, Sim3]]) -> Planes:
    """Return the planes of several chunks in one frame: each with its `S_graph_chunk`."""
    if not parts:
        return Planes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64))
    start = np.cumsum([0, *(len(p.area) for p, _ in parts)])
    return Planes(
        np.concatenate([p.normal @ S.rotation.T for p, S in parts]),
        np.concatenate([S.apply(p.center) for p, S in parts]),
        np.concatenate([p.area * float(S.scale) ** 2 for p, S in parts]),
        np.concatenate([S.apply(p.points.astype(np.float64)) for p, S in parts]),
        np.concatenate(
            [np.where(p.owner < 0, -1, p.owner.astype(np.int64) + n) for (p, _), n in zip(parts, start, strict=False)]
        ),
        np.concatenate([p.faces @ S.rotation.T for p, S in parts]),
    )


def planar_area(points: Array, normal: Array) -> float:
    """Return the area of the convex hull of points seen along a normal, square units; 0 for fewer than three."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    flat = points @ np.stack([first, np.cross(normal, first)], axis=1)
    try:
        return float(ConvexHull(flat).volume)
    except (QhullError, ValueError):
        return 0.0
