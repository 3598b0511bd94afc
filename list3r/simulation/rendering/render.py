"""Ray casting of a world: colour, depth and object id of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.simulation.rendering.projection import NEAR_M, SolidScene, screen_rectangles
from list3r.simulation.rendering.shading import ContactShadows, Lighting, TextureAtlas, illumination, surface
from list3r.simulation.worlds.objects import BOX, CYLINDER, SimulatedObject, stack_solids
from list3r.simulation.worlds.world import SimulatedWorld

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_SUBPIXELS = np.array([[-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]], np.float32)
"""Offsets of the rays within an edge pixel, px: the rotated grid."""


@dataclass(frozen=True)
class RenderedFrame:
    """The image of a perfect camera."""

    color: Floats
    """RGB in [0, 255]. Shape (H, W, 3)."""
    depth: Floats
    """Along the camera's z, metres, 0 where nothing is hit. Shape (H, W)."""
    ids: NDArray[np.int32]
    """Id of the object, 0 for nothing. Shape (H, W)."""
    incidence: Floats
    """Cosine between the ray and the surface's normal, in [0, 1]. Shape (H, W)."""


class Renderer:
    """Draws a world with one camera. Solids are culled by the rectangle of their corners and drawn near to far.

    Objects in `moving` are put in their places through `scene` before a frame is rendered; they cast no shadow.
    """

    def __init__(
        self,
        world: SimulatedWorld,
        camera: Camera,
        moving: Sequence[SimulatedObject] = (),
        lighting: Lighting | None = None,
    ) -> None:
        self._world, self._lighting = world, lighting or Lighting()
        self._camera = camera
        self.scene = SolidScene(world.objects, moving)
        self._solids = self.scene.solids
        self._atlas = TextureAtlas(self._solids)
        self._shadows = ContactShadows(world, stack_solids(world.objects))
        self._x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)
        self._y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)

    def render(self, T_world_cam: Array) -> RenderedFrame:
        """Return the picture from a pose. Shape (4, 4)."""
        rects = screen_rectangles(self.scene.corners, T_world_cam, self._camera)
        depth, solid = self._cast(T_world_cam, *rects)
        shape = depth.shape
        hit = np.flatnonzero(solid.ravel() >= 0)
        row, column = np.divmod(hit, shape[1])
        seen = solid.ravel()[hit]
        shaded, cosine = self._shade(T_world_cam, seen, depth.ravel()[hit], self._x[column], self._y[row])
        color, ids = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.int32)
        incidence = np.zeros(shape, np.float32)
        color.reshape(-1, 3)[hit] = shaded
        ids.ravel()[hit], incidence.ravel()[hit] = self._solids.object_id[seen], cosine
        self._smooth_edges(T_world_cam, solid, rects[1], color)
        return RenderedFrame(color, np.where(solid >= 0, depth, 0).astype(np.float32), ids, incidence)

    def _shade(
        self, T_world_cam: Array, solid: NDArray[np.int64], z: Floats, x: Floats, y: Floats
    ) -> tuple[Floats, Floats]:
        """Colour (N, 3) and cosine of incidence (N,) where rays (x, y, 1) meet solids at depth z, all (N,)."""
        rotation, eye = T_world_cam[:3, :3].astype(np.float32), T_world_cam[:3, 3].astype(np.float32)
        rays = np.stack([x, y, np.ones_like(x)], axis=1) @ rotation.T
        points = eye + z[:, None] * rays
        toward = -rays / np.linalg.norm(rays, axis=1)[:, None]
        normals, u, v = surface(self._solids, solid, points, toward)
        cosine = np.einsum("nk,nk->n", normals, toward)
        footprint = z / np.float32(self._camera.fx) / np.sqrt(np.maximum(cosine, 0.05))
        albedo = self._atlas.sample(self._solids.material[solid], u, v, footprint)
        shade = self._shadows.factor(points, normals[:, 2] > 0.9)
        light = illumination(self._world, points, normals, self._lighting) * shade[:, None]
        return np.minimum(albedo * light, 255), cosine

    def _cast(self, T_world_cam: Array, nearest: Array, rects: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64]]:
        """Depth (inf where nothing is hit) and number of the nearest solid (-1 for none) of every pixel."""
        camera = self._camera
        depth = np.full((camera.height, camera.width), np.inf, np.float32)
        solid = np.full((camera.height, camera.width), -1, np.int64)
        for n in np.argsort(nearest, kind="stable"):
            left, top, right, bottom = rects[n]
            if right <= left or bottom <= top:
                continue
            window = (slice(top, bottom), slice(left, right))
            before = depth[window]
            if before.max() <= nearest[n]:
                continue
            found = self._intersect(int(n), T_world_cam, self._x[None, left:right], self._y[top:bottom, None])
            closer = found < before
            depth[window] = np.where(closer, found, before)
            solid[window][closer] = n
        return depth, solid

    def _smooth_edges(
        self, T_world_cam: Array, solid: NDArray[np.int64], rects: NDArray[np.int64], color: Floats
    ) -> None:
        """Give pixels between two solids the mean of four rays, in place; only solids in view are met again."""
        edge = np.zeros(solid.shape, bool)
        for near, far in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
            differs = solid[near] != solid[far]
            edge[near] |= differs
            edge[far] |= differs
        row, column = np.nonzero(edge)
        if not len(row):
            return
        x = (self._x[column][:, None] + _SUBPIXELS[:, 0] / np.float32(self._camera.fx)).astype(np.float32)
        y = (self._y[row][:, None] + _SUBPIXELS[:, 1] / np.float32(self._camera.fy)).astype(np.float32)
        depth, hit = np.full(x.shape, np.inf, np.float32), np.full(x.shape, -1, np.int64)
        for n in np.unique(solid[solid >= 0]):
            left, top, right, bottom = rects[n]
            rows = slice(*np.searchsorted(row, [top - 1, bottom + 1]))
            chosen = rows.start + np.flatnonzero((column[rows] >= left - 1) & (column[rows] <= right))
            found = self._intersect(int(n), T_world_cam, x[chosen], y[chosen])
            closer = found < depth[chosen]
            depth[chosen] = np.where(closer, found, depth[chosen])
            hit[chosen] = np.where(closer, n, hit[chosen])
        shades = np.zeros((hit.size, 3), np.float32)
        full = np.flatnonzero(hit.ravel() >= 0)
        shades[full], _ = self._shade(
            T_world_cam, hit.ravel()[full], depth.ravel()[full], x.ravel()[full], y.ravel()[full]
        )
        color[row, column] = shades.reshape(-1, len(_SUBPIXELS), 3).mean(axis=1)

    def _intersect(self, n: int, T_world_cam: Array, x: Floats, y: Floats) -> Floats:
        """Depth at which rays (x, y, 1) meet solid `n`, inf where they miss; x and y are broadcast."""
        solids = self._solids
        c, s = np.cos(solids.yaw[n]), np.sin(solids.yaw[n])
        to_local = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        rotation = (to_local @ T_world_cam[:3, :3]).astype(np.float32)
        origin = (to_local @ (T_world_cam[:3, 3] - solids.center[n])).astype(np.float32)
        rays = [r[0] * x + (r[1] * y + r[2]) for r in rotation]
        half = solids.half[n].astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            if solids.kind[n] == BOX:
                return _hit_box(origin, rays, half)
            if solids.kind[n] == CYLINDER:
                return _hit_cylinder(origin, rays, half, bool(solids.open_top[n]))
            return _hit_sphere(origin, rays, float(half[0]), bool(solids.open_top[n]))


def _hit_box(origin: Floats, rays: list[Floats], half: Floats) -> Floats:
    """Slab test (Kay and Kajiya, 1986)."""
    enter = np.full(rays[0].shape, NEAR_M, np.float32)
    leave = np.full(rays[0].shape, np.inf, np.float32)
    for o, d, h in zip(origin, rays, half, strict=True):
        inverse = 1.0 / d
        a, b = (-h - o) * inverse, (h - o) * inverse
        np.maximum(enter, np.minimum(a, b), out=enter)
        np.minimum(leave, np.maximum(a, b), out=leave)
    return np.where(enter <= leave, enter, np.inf).astype(np.float32)


def _hit_cylinder(origin: Floats, rays: list[Floats], half: Floats, open_top: bool) -> Floats:
    """Wall from outside or, where the top is open, from inside; then the caps."""
    (dx, dy, dz), (ox, oy, oz), radius, h = rays, origin, half[0], half[2]
    a, b = dx * dx + dy * dy, ox * dx + oy * dy
    root = np.sqrt(b * b - a * (ox * ox + oy * oy - radius * radius))
    best = np.full(dx.shape, np.inf, np.float32)
    for sign in (-1.0, 1.0) if open_top else (-1.0,):
        t = (-b + sign * root) / a
        good = (np.abs(oz + t * dz) <= h) & (t > NEAR_M)
        best = np.where(good & (t < best), t, best)
    for level in (-h,) if open_top else (-h, h):
        t = (level - oz) / dz
        good = ((ox + t * dx) ** 2 + (oy + t * dy) ** 2 <= radius * radius) & (t > NEAR_M)
        best = np.where(good & (t < best), t, best)
    return np.asarray(best, dtype=np.float32)


def _hit_sphere(origin: Floats, rays: list[Floats], radius: float, open_top: bool) -> Floats:
    """Nearest root, or the nearest on the lower half."""
    dx, dy, dz = rays
    a = dx * dx + dy * dy + dz * dz
    b = origin[0] * dx + origin[1] * dy + origin[2] * dz
    root = np.sqrt(b * b - a * (float(origin @ origin) - radius * radius))
    best = np.full(dx.shape, np.inf, np.float32)
    for sign in (-1.0, 1.0) if open_top else (-1.0,):
        t = (-b + sign * root) / a
        good = t > NEAR_M
        if open_top:
            good &= origin[2] + t * dz <= 0
        best = np.where(good & (t < best), t, best)
    return np.asarray(best, dtype=np.float32)
