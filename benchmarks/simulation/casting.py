"""Depth and ids of many frames, without colour: the rays of the renderer, all solids of a frame in one sweep."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.simulation.rendering.projection import NEAR_M, SolidScene, screen_rectangles
from list3r.simulation.worlds.objects import BOX, CYLINDER, SPHERE, SimulatedObject, Solids

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

_FIRST = 24
"""Solids of a frame's first sweep, the nearest large ones, which occlude others in the second sweep."""


class Caster:
    """Casts depth and ids for one camera; objects that move are put in their places through `scene`."""

    def __init__(self, fixed: Sequence[SimulatedObject], camera: Camera, moving: Sequence[SimulatedObject] = ()):
        self._camera = camera
        self.scene = SolidScene(fixed, moving)
        self._solids = self.scene.solids
        x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)
        y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)
        self._x = np.tile(x, camera.height)
        self._y = np.repeat(y, camera.width)

    def cast(self, T_world_cam: Array) -> tuple[Floats, NDArray[np.int32]]:
        """Depth along z, metres, 0 where nothing is hit, and ids, both (H, W)."""
        nearest, rects = screen_rectangles(self.scene.corners, T_world_cam, self._camera)
        area = np.maximum(rects[:, 2] - rects[:, 0], 0) * np.maximum(rects[:, 3] - rects[:, 1], 0)
        order = np.argsort(nearest, kind="stable")
        order = order[area[order] > 0]
        rank = np.empty(len(area), np.int64)
        rank[order] = np.arange(len(order))
        depth = np.full(self._camera.width * self._camera.height, np.inf, np.float32)
        solid = np.full(len(depth), -1, np.int64)
        gain = area[order] / (nearest[order] + 0.3)
        first = np.zeros(len(order), bool)
        first[np.argsort(-gain, kind="stable")[:_FIRST]] = True
        frame = self._local_frame(T_world_cam)
        for chosen in (order[first], order[~first]):
            self._sweep(chosen, rects, nearest, frame, rank, depth, solid)
        shape = (self._camera.height, self._camera.width)
        hit = solid >= 0
        ids = np.where(hit, self._solids.object_id[solid], 0).astype(np.int32)
        return np.where(hit, depth, 0).astype(np.float32).reshape(shape), ids.reshape(shape)

    def _local_frame(self, T_world_cam: Array) -> tuple[Floats, Floats]:
        """R_local_cam (N, 3, 3) and the camera's centre in each solid's frame (N, 3)."""
        to_local = _to_local(self._solids.yaw)
        rotation = (to_local @ T_world_cam[:3, :3]).astype(np.float32)
        offset = T_world_cam[:3, 3] - self._solids.center
        return rotation, np.einsum("nij,nj->ni", to_local, offset).astype(np.float32)

    def _sweep(
        self,
        chosen: Ints,
        rects: Ints,
        nearest: Array,
        frame: tuple[Floats, Floats],
        rank: Ints,
        depth: Floats,
        solid: Ints,
    ) -> None:
        """Meet all rays in the rectangles of the chosen solids and keep the nearest, in place."""
        if not len(chosen):
            return
        pixel, which = _pixels(rects[chosen], self._camera.width)
        n = chosen[which]
        open_ = nearest.astype(np.float32)[n] < depth[pixel]
        pixel, n = pixel[open_], n[open_]
        kind = self._solids.kind[n]
        found = np.full(len(n), np.inf, np.float32)
        for code, hit in ((BOX, _hit_boxes), (CYLINDER, _hit_cylinders), (SPHERE, _hit_spheres)):
            at = np.flatnonzero(kind == code) if code != BOX or (kind != BOX).any() else np.arange(len(n))
            if len(at):
                found[at] = hit(self._rays(frame, n[at], pixel[at]), self._solids, n[at])
        closer = np.flatnonzero(found < depth[pixel])
        pixel, n, found = pixel[closer], n[closer], found[closer]
        order = np.lexsort((rank[n], found))[::-1]
        depth[pixel[order]] = found[order]
        solid[pixel[order]] = n[order]

    def _rays(self, frame: tuple[Floats, Floats], n: Ints, pixel: Ints) -> tuple[list[Floats], list[Floats]]:
        x, y = self._x[pixel], self._y[pixel]
        rotation, origin = frame[0].reshape(-1, 9), frame[1]
        rays = []
        for k in range(3):
            rays.append(rotation[:, 3 * k][n] * x + (rotation[:, 3 * k + 1][n] * y + rotation[:, 3 * k + 2][n]))
        return [origin[:, k][n] for k in range(3)], rays


def _to_local(yaw: Array) -> Array:
    """R_local_world of turns about z (N,). Shape (N, 3, 3)."""
    cos, sin, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    return np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)


def _pixels(rects: Ints, width: int) -> tuple[Ints, Ints]:
    """All pixels of all rectangles: flat pixel numbers and the number of the rectangle, each (P,)."""
    wide, high = rects[:, 2] - rects[:, 0], rects[:, 3] - rects[:, 1]
    count = wide * high
    which = np.repeat(np.arange(len(rects)), count)
    inner = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    row, column = np.divmod(inner, wide[which])
    return (rects[which, 1] + row) * width + rects[which, 0] + column, which


def _hit_boxes(lines: tuple[list[Floats], list[Floats]], solids: Solids, n: Ints) -> Floats:
    """Slab test (Kay and Kajiya, 1986)."""
    enter = np.full(len(n), NEAR_M, np.float32)
    leave = np.full(len(n), np.inf, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        for k, (o, d) in enumerate(zip(*lines, strict=True)):
            h = solids.half[:, k].astype(np.float32)[n]
            inverse = np.float32(1.0) / d
            a, b = (-h - o) * inverse, (h - o) * inverse
            np.maximum(enter, np.minimum(a, b), out=enter)
            np.minimum(leave, np.maximum(a, b), out=leave)
    return np.where(enter <= leave, enter, np.inf).astype(np.float32)


def _hit_cylinders(lines: tuple[list[Floats], list[Floats]], solids: Solids, n: Ints) -> Floats:
    """Wall from outside or, where the top is open, from inside; then the caps."""
    (ox, oy, oz), (dx, dy, dz) = lines
    radius, h, open_top = solids.half[n, 0].astype(np.float32), solids.half[n, 2].astype(np.float32), solids.open_top[n]
    best = np.full(len(n), np.inf, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = dx * dx + dy * dy, ox * dx + oy * dy
        root = np.sqrt(b * b - a * (ox * ox + oy * oy - radius * radius))
        for sign in (-1.0, 1.0):
            t = (-b + np.float32(sign) * root) / a
            good = (np.abs(oz + t * dz) <= h) & (t > NEAR_M) & (t < best)
            best = np.where(good & open_top if sign > 0 else good, t, best)
        for sign in (-1.0, 1.0):
            t = (np.float32(sign) * h - oz) / dz
            good = ((ox + t * dx) ** 2 + (oy + t * dy) ** 2 <= radius * radius) & (t > NEAR_M) & (t < best)
            best = np.where(good & ~open_top if sign > 0 else good, t, best)
    return np.asarray(best, dtype=np.float32)


def _hit_spheres(lines: tuple[list[Floats], list[Floats]], solids: Solids, n: Ints) -> Floats:
    """Nearest root, or the nearest on the lower half."""
    (ox, oy, oz), (dx, dy, dz) = lines
    radius, open_top = solids.half[n, 0].astype(np.float32), solids.open_top[n]
    best = np.full(len(n), np.inf, np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = dx * dx + dy * dy + dz * dz
        b = ox * dx + oy * dy + oz * dz
        root = np.sqrt(b * b - a * (ox * ox + oy * oy + oz * oz - radius * radius))
        for sign in (-1.0, 1.0):
            t = (-b + np.float32(sign) * root) / a
            good = (t > NEAR_M) & (t < best) & (~open_top | (oz + t * dz <= 0))
            best = np.where(good & open_top if sign > 0 else good, t, best)
    return np.asarray(best, dtype=np.float32)
