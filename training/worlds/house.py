"""Walks through a house that others furnished: `aws-robomaker-small-house-world` (MIT-0), read from its folder.

To test with, never to train on, and never copied into the project.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from copy import copy
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.simulation.walk import PathSettings, camera_path
from list3r.simulation.worlds.world import Stop
from training.worlds.collada import TexturedMesh, read_collada
from training.worlds.film import Film, Truth, Visit
from training.worlds.mesh import turn
from training.worlds.render import Caster, Hits, Light, Renderer
from training.worlds.sensors import drift_field, read

STRUCTURE = ("HouseWallB", "RoomWall", "RoomCeiling", "FloorB")
GRAY = np.full((4, 4, 3), 150, np.uint8)
_STILL = np.zeros(3)


class _House:
    """Meshes in the world, whose they are, and what they are called."""

    def __init__(self, folder: Path) -> None:
        world = ET.parse(folder / "worlds" / "small_house.world").getroot()
        self.meshes: list[TexturedMesh] = []
        self.owner: list[int] = []
        self.things: list[Truth] = []
        for model in world.iterfind(".//model"):
            uri = model.findtext("include/uri", "")
            place = folder / "models" / uri.removeprefix("model://")
            if not uri or not place.is_dir():
                continue
            x, y, z, roll, pitch, yaw = (float(v) for v in model.findtext("pose", "0 0 0 0 0 0").split())
            name = re.sub(r"_\d+", "", uri.rpartition("residential_")[2])
            number = len(self.things) + 1
            for file in _visuals(folder, place):
                for mesh in read_collada(file):
                    points = mesh.vertices @ turn(yaw, pitch, roll).T + np.array([x, y, z])
                    self.meshes.append(TexturedMesh(points, mesh.triangles, mesh.uv, mesh.image))
                    self.owner.append(number)
            self.things.append(Truth(number, name, name, name, any(s in name for s in STRUCTURE)))

    def changed(self, shifts: Mapping[int, NDArray[np.float64] | None]) -> _House:
        """Return the house with things elsewhere, or away where the shift is None."""
        out = copy(self)
        kept = [(m, k) for m, k in zip(self.meshes, self.owner, strict=True) if shifts.get(k, _STILL) is not None]
        out.meshes = [TexturedMesh(m.vertices + shifts.get(k, _STILL), m.triangles, m.uv, m.image) for m, k in kept]
        out.owner = [k for _, k in kept]
        return out

    def extents(self) -> dict[int, NDArray[np.float64]]:
        """Return lower and upper corners of the things that are no structure. Shapes (2, 3)."""
        out = {}
        for thing in self.things:
            points = [m.vertices for m, k in zip(self.meshes, self.owner, strict=True) if k == thing.id]
            if points and not thing.structure:
                every = np.concatenate(points)
                out[thing.id] = np.stack([every.min(axis=0), every.max(axis=0)])
        return out


def _visuals(folder: Path, place: Path) -> list[Path]:
    """The files that a model shows."""
    root = ET.parse(place / "model.sdf").getroot()
    named = [u.text or "" for u in root.iterfind(".//visual//mesh/uri")]
    files = [folder / "models" / n.strip().removeprefix("model://") for n in named]
    return [f for f in files if f.exists()]


class _TexturePainter:
    """Colours hits by the pictures of their meshes."""

    def __init__(self, meshes: list[TexturedMesh]) -> None:
        self._meshes = meshes
        self._images = [_picture(m.image) for m in meshes]

    def color(self, hit: Hits) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return RGB in [0, 255] (N, 3) and the share of failing depth (N,)."""
        out = np.full((len(hit.mesh), 3), 150, np.float32)
        for number in np.unique(hit.mesh).tolist():
            mine = np.flatnonzero(hit.mesh == number)
            corners = self._meshes[number].uv[hit.triangle[mine]]
            u, v = hit.uv[mine, 0:1], hit.uv[mine, 1:2]
            at = corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v
            image = self._images[number]
            rows = ((1.0 - at[:, 1]) % 1.0 * (image.shape[0] - 1)).astype(int)
            columns = (at[:, 0] % 1.0 * (image.shape[1] - 1)).astype(int)
            out[mine] = image[rows, columns]
        return out, np.zeros(len(hit.mesh), np.float32)


@lru_cache(maxsize=128)
def _picture(path: Path | None) -> NDArray[np.uint8]:
    image: Any = cv2.imread(str(path)) if path is not None and path.exists() else None
    if image is None:
        return GRAY
    scale = min(1.0, 512 / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small[..., ::-1], np.uint8)


@lru_cache(maxsize=1)
def _loaded(folder: Path) -> tuple[_House, Caster]:
    house = _House(folder)
    return house, Caster([(m.vertices, m.triangles) for m in house.meshes])


def house_extents(folder: Path) -> dict[int, NDArray[np.float64]]:
    """Return the corners of the things of the house by id; see `_House.extents`."""
    return _loaded(folder)[0].extents()


def film_house(
    folder: Path, seed: int, sensor: str, frames: int = 30, every: int = 2, visit: Visit | None = None
) -> Film:
    """Return a walk of a seed through the house, of which every n-th frame is filmed."""
    house, caster = _loaded(folder)
    visit = visit or Visit()
    rng = np.random.default_rng([seed, 17])
    camera = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
    walk = PathSettings(fps=12.0 / every)
    time_s, poses = camera_path(visit.tour(_stops(house, caster, rng)), frames, walk, seed + visit.number)
    if visit.shifts:
        house = house.changed(visit.shifts)
        caster = Caster([(m.vertices, m.triangles) for m in house.meshes])
    light = Light(
        poses[frames // 2, :3, 3].astype(np.float32) + np.array([0, 0, 0.5], np.float32),
        0.5,
        0.45,
        np.ones(3, np.float32),
    )
    renderer = Renderer(caster, _TexturePainter(house.meshes), np.array(house.owner), light, camera)
    drift = drift_field((240, 320), rng)
    shown = []
    for pose in poses:
        picture = renderer.render(pose)
        drift = (0.985 * drift + 0.17 * drift_field((240, 320), rng)).astype(np.float32)
        shown.append((picture, read(picture, sensor, rng, drift)))
    color, depth = np.stack([r.color for _, r in shown]), np.stack([r.depth for _, r in shown])
    true_depth, ids = np.stack([p.depth for p, _ in shown]), np.stack([p.ids.astype(np.uint16) for p, _ in shown])
    return Film(camera, sensor, time_s, poses, color, depth, true_depth, ids, tuple(house.things))


def _stops(house: _House, caster: Caster, rng: np.random.Generator) -> tuple[Stop, ...]:
    """Places inside with free sight of one another, and things to look at from there."""
    middles = []
    for thing in house.things:
        if not thing.structure:
            points = [m.vertices for m, o in zip(house.meshes, house.owner, strict=True) if o == thing.id]
            if points:
                middles.append(np.concatenate(points).mean(axis=0))
    points = np.concatenate([m.vertices for m in house.meshes])
    low, high = np.quantile(points[:, :2], [0.01, 0.99], axis=0)
    stops: list[Stop] = []
    eye: NDArray[np.float32] | None = None
    bearing = rng.uniform(0, 2 * np.pi)
    for _ in range(4000):
        if len(stops) == 5:
            break
        if eye is None:
            trial = np.append(rng.uniform(low, high), rng.uniform(1.2, 1.6)).astype(np.float32)
        else:
            trial = (eye + np.append(rng.normal(0, 0.4, 2), 0.0)).astype(np.float32)
        if not _free(caster, trial) or (eye is not None and not _sees(caster, eye, trial)):
            continue
        seen = [m for m in middles if 0.8 < np.linalg.norm(m[:2] - trial[:2]) < 3.2 and _sees(caster, trial, m, 0.75)]
        turns = [abs((np.arctan2(*(m - trial)[[1, 0]]) - bearing + np.pi) % (2 * np.pi) - np.pi) for m in seen]
        if not seen or (stops and min(turns) > 1.2):
            continue
        goal = seen[int(np.argmin(turns))] if stops else seen[int(rng.integers(len(seen)))]
        bearing = float(np.arctan2(*(goal - trial)[[1, 0]])) + rng.uniform(0.3, 0.8)
        stops.append(Stop(tuple(trial.tolist()), tuple(goal.tolist())))
        eye = trial
    return tuple(stops)


def _free(caster: Caster, eye: NDArray[np.float32]) -> bool:
    """True for a place in a room: a floor below, a ceiling above, nothing within 35 cm around."""
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    round_ = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    rays = np.concatenate([[[0, 0, -1.0], [0, 0, 1.0]], round_]).astype(np.float32)
    _, known, length = caster.cast(eye, rays)
    return bool(known.all() and 0.9 < length[0] < 1.8 and length[1] < 2.5 and length[2:].min() > 0.35)


def _sees(caster: Caster, eye: NDArray[np.float32], goal: NDArray[np.generic], share: float = 1.0) -> bool:
    """True where nothing stands in the first `share` of the way."""
    ray = (np.asarray(goal) - eye).astype(np.float32)[None]
    _, known, length = caster.cast(eye, ray)
    return bool(not known[0] or length[0] > share)
