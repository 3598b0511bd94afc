"""A small picture of a mesh, drawn from an oblique view without a graphics card."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SIDE_PX = 256
_LIGHT = np.array([0.4, -0.5, 0.77])
_PAPER = (245, 245, 245)


def thumbnail(vertices: NDArray[np.float64], faces: NDArray[np.int64], rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture of 256 x 256 px, from the front, a little from the right and above. Shape (256, 256, 3).

    Faces are shaded by their slope and drawn as a dense set of points with a depth buffer. The mesh is closed and its
    faces look outward, so those that look away are hidden.
    """
    right, back = np.array([0.8, 0.6, 0.0]), np.array([-0.5, 0.67, -0.55])
    back /= np.linalg.norm(back)
    up = np.cross(right, back)
    flat = np.stack([vertices @ right, vertices @ up], axis=1)
    middle, span = (flat.min(axis=0) + flat.max(axis=0)) / 2, max(float(np.ptp(flat, axis=0).max()), 1e-9)
    scale = 0.88 * _SIDE_PX / span
    px = np.column_stack([(flat - middle) * scale * [1, -1] + _SIDE_PX / 2, vertices @ back])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    towards = normal @ back < 0
    faces, normal = faces[towards], normal[towards]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    shade = 0.55 + 0.45 * np.clip(normal @ _LIGHT, 0, 1)
    color = rgb[faces].mean(axis=1) * shade[:, None]
    image = np.tile(np.array(_PAPER, np.uint8), (_SIDE_PX, _SIDE_PX, 1))
    depth = np.full((_SIDE_PX, _SIDE_PX), np.inf)
    for face, at in _samples(px[faces]):
        x, y = np.floor(at[:, 0]).astype(int), np.floor(at[:, 1]).astype(int)
        order = np.argsort(-at[:, 2], kind="stable")  # the nearest last
        order = order[at[order, 2] < depth[y[order], x[order]]]
        depth[y[order], x[order]] = at[order, 2]
        image[y[order], x[order]] = color[face[order]].astype(np.uint8)
    return image


def _samples(corners: NDArray[np.float64]) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return points at most two thirds of a pixel apart on faces, with the face of each, by size of faces. Shape (F, 3,
    3).
    """
    edges = np.linalg.norm((corners - np.roll(corners, 1, axis=1))[..., :2], axis=2).max(axis=1)
    steps = np.ceil(np.clip(1.5 * edges, 1.0, 512.0)).astype(int)
    out = []
    for n in np.unique(steps).tolist():
        chosen = np.flatnonzero(steps == n)
        i, j = (v.ravel() for v in np.mgrid[: n + 1, : n + 1])
        u, v = i[i + j <= n] / n, j[i + j <= n] / n
        weights = np.stack([1 - u - v, u, v], axis=1)
        at = np.einsum("wk,fkc->fwc", weights, corners[chosen])
        out.append((np.repeat(chosen, len(weights)), at.reshape(-1, 3)))
    return out
