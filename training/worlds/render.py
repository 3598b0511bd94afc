"""Pictures of a world: colour, depth and the thing in every pixel, by casting rays on triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from training.worlds.materials import MaterialTable
from training.worlds.room import Placed

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Picture:
    """What a perfect camera sees. All images share their shape (H, W)."""

    color: Floats
    """RGB in [0, 255]. Shape (H, W, 3)."""
    depth: Floats
    """Along the camera's z, metres, 0 where there is nothing. Shape (H, W)."""
    ids: NDArray[np.int32]
    """Id of the thing, 0 for none. Shape (H, W)."""
    cosine: Floats
    """Of the angle between ray and surface. Shape (H, W)."""
    glass: Floats
    """Share of depth readings that fail. Shape (H, W)."""


class Painter(Protocol):
    """Colours the points that rays hit."""

    def color(self, hit: Hits) -> tuple[Floats, Floats]:
        """Return RGB in [0, 255] (N, 3) and the share of failing depth (N,)."""
        ...


@dataclass(frozen=True)
class Hits:
    """Where rays met triangles, N of them."""

    mesh: NDArray[np.int64]
    """Number of the mesh, in order of adding. Shape (N,)."""
    triangle: NDArray[np.int64]
    uv: Floats
    """Barycentric coordinates. Shape (N, 2)."""
    points: Floats
    """World, metres. Shape (N, 3)."""
    normals: Floats
    """Unit, world. Shape (N, 3)."""


class Caster:
    """Rays on triangles, by Open3D."""

    def __init__(self, meshes: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]]) -> None:
        import open3d

        self._o3d: Any = open3d
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        for vertices, triangles in meshes:
            self._scene.add_triangles(
                open3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
                open3d.core.Tensor(np.ascontiguousarray(triangles, np.uint32)),
            )

    def cast(self, origin: Floats, rays: Floats) -> tuple[Hits, NDArray[np.bool_], Floats]:
        """Return hits, which rays hit, and lengths in units of the rays. Shapes (3,) or (N, 3), (N, 3)."""
        start = np.broadcast_to(origin, rays.shape)
        both = np.concatenate([start, rays], axis=1).astype(np.float32)
        answer = self._scene.cast_rays(self._o3d.core.Tensor(np.ascontiguousarray(both)), nthreads=1)
        length = answer["t_hit"].numpy()
        known = np.isfinite(length)
        normal = answer["primitive_normals"].numpy()[known]
        normal = normal * -np.sign((normal * rays[known]).sum(axis=1, keepdims=True))
        points = (start[known] + rays[known] * length[known, None]).astype(np.float32)
        hits = Hits(
            answer["geometry_ids"].numpy()[known].astype(np.int64),
            answer["primitive_ids"].numpy()[known].astype(np.int64),
            answer["primitive_uvs"].numpy()[known],
            points,
            normal.astype(np.float32),
        )
        return hits, known, length

    def shaded(self, points: Floats, normals: Floats, lamp: Floats) -> NDArray[np.bool_]:
        """Return true for points that something hides from a lamp. Shapes (N, 3), (N, 3), (3,)."""
        start = points + 0.004 * normals
        rays = np.concatenate([start, lamp - start], axis=1).astype(np.float32)
        hidden = self._scene.test_occlusions(self._o3d.core.Tensor(np.ascontiguousarray(rays)), 0.0, 1.0, nthreads=1)
        return np.asarray(hidden.numpy(), bool)


class SolidPainter:
    """Colours things by their solid textures."""

    def __init__(self, things: Sequence[Placed], seed: int) -> None:
        materials = [material for thing in things for _, material in thing.parts]
        self._table = MaterialTable(materials, seed)
        owner = [k for k, thing in enumerate(things) for _ in thing.parts]
        self._T_thing_world = np.linalg.inv(np.stack([things[k].T_world_thing for k in owner])).astype(np.float32)

    def color(self, hit: Hits) -> tuple[Floats, Floats]:
        """Return RGB in [0, 255] (N, 3) and the share of failing depth (N,)."""
        T = self._T_thing_world[hit.mesh]
        local = np.einsum("nij,nj->ni", T[:, :3, :3], hit.points) + T[:, :3, 3]
        normal = np.einsum("nij,nj->ni", T[:, :3, :3], hit.normals)
        return self._table.color(hit.mesh, local, normal), self._table.glass[hit.mesh]


@dataclass(frozen=True)
class Light:
    """A lamp and what comes from everywhere."""

    position: Floats
    """World, metres. Shape (3,)."""
    ambient: float
    strength: float
    tint: Floats
    """RGB factors. Shape (3,)."""


def random_light(size: tuple[float, float, float], rng: np.random.Generator) -> Light:
    """Return the light of a room: by day through a window or by a lamp."""
    w, deep, h = size
    position = np.array(
        [rng.uniform(0.2, w - 0.2), rng.uniform(0.2, deep - 0.2), h * rng.uniform(0.75, 0.98)], np.float32
    )
    tint = np.array([1.0, rng.uniform(0.88, 1.0), rng.uniform(0.7, 1.05)], np.float32)
    return Light(position, float(rng.uniform(0.35, 0.65)), float(rng.uniform(0.4, 0.9)), tint)


class Renderer:
    """Pictures of things with a light."""

    def __init__(
        self, caster: Caster, painter: Painter, owner: NDArray[np.int64], light: Light, camera: Camera
    ) -> None:
        self.caster, self.painter, self.owner, self.light, self.camera = caster, painter, owner, light, camera
        u = (np.arange(camera.width) - camera.cx) / camera.fx
        v = (np.arange(camera.height) - camera.cy) / camera.fy
        x, y = np.meshgrid(u, v)
        self.rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)

    def render(self, T_world_cam: NDArray[np.float64]) -> Picture:
        """Return what the camera at a pose (4, 4) sees."""
        shape = (self.camera.height, self.camera.width)
        origin = T_world_cam[:3, 3].astype(np.float32)
        rays = self.rays @ T_world_cam[:3, :3].T.astype(np.float32)
        hits, known, length = self.caster.cast(origin, rays)
        albedo, failing = self.painter.color(hits)
        out = {"color": np.zeros((len(known), 3), np.float32), "ids": np.zeros(len(known), np.int32)}
        out["color"][known] = np.clip(self.lit(albedo, hits), 0, 255)
        out["ids"][known] = self.owner[hits.mesh]
        depth, cosine, glass = (np.zeros(len(known), np.float32) for _ in range(3))
        depth[known] = length[known]
        unit = rays[known] / np.linalg.norm(rays[known], axis=1, keepdims=True)
        cosine[known] = np.abs((unit * hits.normals).sum(axis=1))
        glass[known] = failing
        images = [a.reshape(shape) for a in (depth, out["ids"], cosine, glass)]
        return Picture(out["color"].reshape(*shape, 3), images[0], images[1], images[2], images[3])

    def lit(self, albedo: Floats, hits: Hits, *, shadows: bool = True) -> Floats:
        """Return colours (N, 3) as the light shows them."""
        to_lamp = self.light.position - hits.points
        distance = np.linalg.norm(to_lamp, axis=1)
        direct = np.clip((to_lamp * hits.normals).sum(axis=1) / np.maximum(distance, 1e-3), 0, 1)
        if shadows:
            direct = np.where(self.caster.shaded(hits.points, hits.normals, self.light.position), 0.0, direct)
        shade = self.light.ambient * (0.8 + 0.2 * hits.normals[:, 2])
        shade = shade + self.light.strength * direct * 4.0 / (2.0 + distance)
        return np.asarray(albedo * shade[:, None].astype(np.float32) * self.light.tint, np.float32)


def world_renderer(things: Sequence[Placed], size: tuple[float, float, float], camera: Camera, seed: int) -> Renderer:
    """Return the renderer of a furnished room."""
    meshes, owner = [], []
    for thing in things:
        for mesh, _ in thing.parts:
            T = thing.T_world_thing
            meshes.append((mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.triangles))
            owner.append(thing.id)
    light = random_light(size, np.random.default_rng([seed, 5]))
    return Renderer(Caster(meshes), SolidPainter(things, seed), np.array(owner), light, camera)
