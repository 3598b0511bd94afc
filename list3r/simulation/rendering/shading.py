"""Light and surfaces: the colours of the visible points of a world."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.simulation.worlds.layout import SimulatedRoom
from list3r.simulation.worlds.materials import TEXTURE_PX, bake, mip_levels
from list3r.simulation.worlds.objects import BOX, Solids
from list3r.simulation.worlds.world import HEIGHT_M, SimulatedWorld

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Lighting:
    """The lamps of the rooms."""

    sky: float = 0.5
    """Light from everywhere, such as by day through windows."""
    lamp: float = 0.75
    """Light of each lamp at its foot."""
    aside: float = 0.0
    """How far lamps hang from the middle of their room toward a corner, as a share of the way."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of red, green and blue."""


EVENING = Lighting(sky=0.16, lamp=0.85, aside=0.6, tint=(1.0, 0.86, 0.66))
"""Dim from outside, a warm lamp near a corner."""

_CELL_M = 0.02
_MARGIN_M = 0.3
_LEVELS = 6
_LAMP_M = 5.0
"""Length of room that one lamp lights."""


class TextureAtlas:
    """All materials of a world as image pyramids, in one array a level."""

    def __init__(self, solids: Solids) -> None:
        tiles = [mip_levels(bake(material), _LEVELS) for material in solids.materials]
        self._levels = [np.stack([tile[k] for tile in tiles]) for k in range(_LEVELS)]
        self._tile_m = np.array([material.tile_m for material in solids.materials], np.float32)

    def sample(self, material: NDArray[np.int64], u_m: Floats, v_m: Floats, footprint_m: Floats) -> Floats:
        """Colour at surface coordinates in metres, bilinear in the mip level that matches the pixel's footprint.

        All arguments have shape (N,); the result (N, 3), RGB in [0, 255].
        """
        tile = self._tile_m[material]
        texels = np.maximum(footprint_m / tile * TEXTURE_PX, 1.0)
        level = np.minimum(np.log2(texels) + 0.3, _LEVELS - 1).astype(np.int8)
        out = np.empty((len(material), 3), np.float32)
        for k in range(_LEVELS):
            chosen = np.flatnonzero(level == k)
            if len(chosen):
                t = tile[chosen]
                out[chosen] = self._bilinear(k, material[chosen], u_m[chosen] / t, v_m[chosen] / t)
        return out

    def _bilinear(self, k: int, material: NDArray[np.int64], u: Floats, v: Floats) -> Floats:
        size = TEXTURE_PX >> k
        x, y = u * size - 0.5, v * size - 0.5
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        i, j = x0.astype(np.int64) & (size - 1), y0.astype(np.int64) & (size - 1)
        i1, j1 = (i + 1) & (size - 1), (j + 1) & (size - 1)
        flat = self._levels[k].reshape(-1, 3)
        base, base1 = (material * size + j) * size, (material * size + j1) * size
        upper = flat[base + i] * (1 - fx) + flat[base + i1] * fx
        lower = flat[base1 + i] * (1 - fx) + flat[base1 + i1] * fx
        return np.asarray(upper * (1 - fy) + lower * fy)


class ContactShadows:
    """Soft darkness on floors and table tops under and around objects on them or low above them."""

    def __init__(self, world: SimulatedWorld, solids: Solids) -> None:
        supports = {t.support for t in world.objects if t.support is not None and t.container is None}
        tops = {0.0} | {
            round(float(t.box().center[2] + t.box().size[2] / 2), 3)
            for t in world.objects
            if t.id in supports and t.structure is None
        }
        self._heights = np.array(sorted(tops))
        low = np.array([min(room.x0 for room in world.rooms), min(room.y0 for room in world.rooms)])
        high = np.array([max(r.x1 for r in world.rooms), max(r.y0 + r.depth for r in world.rooms)])
        self._origin = low - _MARGIN_M
        corners = solids.corners()
        reach = high - low + 2 * _MARGIN_M
        shape = tuple(np.ceil(reach[::-1] / _CELL_M).astype(int))
        self._maps = np.stack([self._bake(corners, float(h), shape) for h in self._heights])

    def _bake(self, corners: NDArray[np.float64], height: float, shape: tuple[int, ...]) -> Floats:
        dark = np.zeros(shape, np.float32)
        bottom, top = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)
        casting = np.flatnonzero((bottom > height - 0.05) & (top > height + 0.015) & (bottom < height + 1.0))
        for n in casting[np.argsort(-bottom[casting], kind="stable")]:
            ground = (corners[n, ::2, :2] - self._origin) / _CELL_M
            hull = cv2.convexHull(ground.astype(np.float32)).astype(np.int32)
            strength = float(np.exp(-max(bottom[n] - height, 0.0) / 0.5))
            cv2.fillConvexPoly(dark, hull, strength)
        near, far = cv2.GaussianBlur(dark, (0, 0), 1.5), cv2.GaussianBlur(dark, (0, 0), 7.0)
        return np.asarray(1.0 - 0.30 * near - 0.32 * far, dtype=np.float32)

    def factor(self, points: Floats, facing_up: NDArray[np.bool_]) -> Floats:
        """Brightness factor of surface points. Shapes (N, 3), (N,) -> (N,)."""
        out = np.ones(len(points), np.float32)
        level = np.abs(points[:, 2, None] - self._heights[None].astype(np.float32)).argmin(axis=1)
        near = np.abs(points[:, 2] - self._heights[level]) < 0.02
        chosen = np.flatnonzero(facing_up & near)
        cell = (points[chosen, :2] - self._origin) / _CELL_M
        inside = np.clip(cell.astype(np.int64), 0, np.array(self._maps.shape[:0:-1]) - 1)
        out[chosen] = self._maps[level[chosen], inside[:, 1], inside[:, 0]]
        return out


def surface(solids: Solids, solid: NDArray[np.int64], points: Floats, toward: Floats) -> tuple[Floats, Floats, Floats]:
    """Outward normals and surface coordinates of points on solids.

    `solid` (N,) numbers the solids, `points` (N, 3) and the unit directions `toward` the camera (N, 3) are in the
    world. Returns normals (N, 3) that face the camera, and surface coordinates u, v (N,) in metres; u runs along the
    longer side of a box's face, as the grain of wood does.
    """
    c, s = np.cos(solids.yaw)[solid].astype(np.float32), np.sin(solids.yaw)[solid].astype(np.float32)
    offset = points - solids.center.astype(np.float32)[solid]
    x, y, z = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]
    half = solids.half.astype(np.float32)[solid]
    kind = solids.kind[solid]
    normal = np.zeros_like(points)
    axis = np.argmax(np.abs(np.stack([x, y, z], 1)) - half, axis=1)
    u, v = np.where(axis == 0, y, x), np.where(axis == 2, y, z)
    across, along = np.where(axis == 0, half[:, 1], half[:, 0]), np.where(axis == 2, half[:, 1], half[:, 2])
    u, v = np.where(along > across, v, u), np.where(along > across, u, v)
    rows = np.arange(len(solid))
    normal[rows, axis] = np.sign(np.stack([x, y, z], 1)[rows, axis])
    round_ = kind != BOX
    cap = (kind == 1) & (np.abs(np.abs(z) - half[:, 2]) < 1e-4)
    side = np.flatnonzero(round_ & ~cap)
    if len(side):
        flat = np.where(kind[side] == 1, 0.0, z[side])
        body = np.stack([x[side], y[side], flat], 1)
        normal[side] = body / np.maximum(np.linalg.norm(body, axis=1), 1e-6)[:, None]
        u[side], v[side] = np.arctan2(y[side], x[side]) * half[side, 0], z[side]
    lid = np.flatnonzero(cap)
    normal[lid] = np.stack([np.zeros(len(lid)), np.zeros(len(lid)), np.sign(z[lid])], 1)
    u[lid], v[lid] = x[lid], y[lid]
    world = np.stack([c * normal[:, 0] - s * normal[:, 1], s * normal[:, 0] + c * normal[:, 1], normal[:, 2]], 1)
    flip = np.einsum("nk,nk->n", world, toward) < 0
    world[flip] *= -1
    return world.astype(np.float32), u.astype(np.float32), v.astype(np.float32)


def _lamps(room: SimulatedRoom, aside: float) -> list[Floats]:
    """One lamp in the middle of a room or to the side of it, several in a row where it is long."""
    count = max(1, round((room.x1 - room.x0) / _LAMP_M))
    share = (np.arange(count) + 0.5 * (1 + aside)) / count
    y, z = room.y0 + room.depth / 2 * (1 + aside), HEIGHT_M - 0.15
    return [np.array([room.x0 + s * (room.x1 - room.x0), y, z], np.float32) for s in share]


def illumination(world: SimulatedWorld, points: Floats, normals: Floats, lighting: Lighting) -> Floats:
    """Light on surface points: sky from above, lamps under each ceiling, gloom near the skirting. Shape (N, 3)."""
    light = np.float32(lighting.sky) + np.float32(0.24 * lighting.sky) * normals[:, 2]
    for room, lamp in [(r, each) for r in world.rooms for each in _lamps(r, lighting.aside)]:
        inside = (points[:, 0] > room.x0 - 0.06) & (points[:, 0] < room.x1 + 0.06)
        inside &= (points[:, 1] > room.y0 - 0.06) & (points[:, 1] < room.y0 + room.depth + 0.06)
        ray = lamp - points
        distance = np.linalg.norm(ray, axis=1)
        cosine = np.einsum("nk,nk->n", ray, normals) / np.maximum(distance, 1e-3)
        wrapped = np.maximum((cosine + 0.25) / 1.25, 0.0)
        light += np.where(inside, 1.0, 0.15) * wrapped * lighting.lamp / (1 + (distance / 2.6) ** 2)
    upright = np.abs(normals[:, 2]) < 0.5
    gloom = 1 - 0.22 * np.exp(-np.maximum(points[:, 2], 0) / 0.12) * upright
    return np.asarray((light * gloom)[:, None] * np.array(lighting.tint), dtype=np.float32)
