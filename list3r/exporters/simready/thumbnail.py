"""A small picture of a mesh, drawn from an oblique view without a graphics card."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

_SIDE_PX = 256
_OVERSAMPLING = 2
_LIGHT = np.array([0.4, -0.5, 0.77])
_PAPER = (245, 245, 245)


def thumbnail(vertices: NDArray[np.float64], faces: NDArray[np.int64], rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture of 256 x 256 px, from the front, a little from the right and above. Shape (256, 256, 3).

    Faces are shaded by their slope and drawn from far to near. The mesh is closed and its faces point outward, so back
    faces are hidden.
    """
    right, back = np.array([0.8, 0.6, 0.0]), np.array([-0.5, 0.67, -0.55])
    back /= np.linalg.norm(back)
    up = np.cross(right, back)
    flat = np.stack([vertices @ right, vertices @ up], axis=1)
    middle, span = (flat.min(axis=0) + flat.max(axis=0)) / 2, max(float(np.ptp(flat, axis=0).max()), 1e-9)
    side = _OVERSAMPLING * _SIDE_PX
    px = (flat - middle) * (0.88 * side / span) * [1, -1] + side / 2
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    towards = np.flatnonzero(normal @ back < 0)
    towards = towards[np.argsort(-(vertices @ back)[faces[towards]].mean(axis=1), kind="stable")]
    shade = 0.55 + 0.45 * np.clip(normal[towards] @ _LIGHT, 0, 1)
    colors = (rgb[faces[towards]].mean(axis=1) * shade[:, None]).astype(np.uint8)
    image = Image.new("RGB", (side, side), _PAPER)
    draw = ImageDraw.Draw(image)
    for corners, color in zip(px[faces[towards]].reshape(-1, 6).tolist(), colors.tolist(), strict=True):
        draw.polygon(corners, fill=tuple(color))
    return np.asarray(image.reduce(_OVERSAMPLING))
