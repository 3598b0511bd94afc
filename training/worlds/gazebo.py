"""Walks through places that others furnished, read from their folders: Gazebo worlds with meshes in COLLADA.

`aws-robomaker-small-house-world` (MIT-0) is what results are tested on, the offices of
`gazebo_models_worlds_collection` (GPL-3.0) what they may be chosen on. Never to train on, and never copied.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.memory.core.errors import SourceError
from list3r.simulation.walk import PathSettings, camera_path
from list3r.simulation.worlds.world import Stop
from training.worlds.collada import TexturedMesh, read_collada
from training.worlds.film import Film, Truth, Visit
from training.worlds.mesh import turn
from training.worlds.render import Caster, Hits, Light, Renderer
from training.worlds.scans import read_scan
from training.worlds.sensors import drift_field, read

STRUCTURE = ("Wall", "Ceiling", "Floor", "Column", "ground_plane", "office_small", "office_env", "floor_")
"""Words in the names of models that bound a room; a `FloorB` is one, a `FloorLamp` would not be."""
PLANE_M = 60.0
"""Edge of what is drawn of a plane without end."""
_SCHEME = re.compile(r"^(model://|file://models/)")
_STILL = np.zeros(3)


class _House:
    """Meshes in the world, whose they are, and what they are called."""

    def __init__(self, place: Path) -> None:
        self.meshes: list[TexturedMesh] = []
        self.owner: list[int] = []
        self.things: list[Truth] = []
        if place.suffix == ".pcd":
            self.meshes, self.owner, self.things = read_scan(place)
            return
        file = place if place.is_file() else min((place / "worlds").glob("*.world"))
        world = ET.parse(file).getroot().find("world")
        assert world is not None, f"{file.name} holds no world"
        self._models = file.parent.parent / "models"
        for model in world.iterfind("model"):
            self._add(model, _state(world.find("state"), model.get("name", "")))

    def _add(self, model: ET.Element, state: ET.Element | None, T_world: NDArray[np.float64] | None = None) -> None:
        """Add a model that the world or another model holds or includes; its state tells where its links are now."""
        uri = model.findtext("include/uri", "").strip()
        T = _pose(model) if T_world is None else T_world @ _pose(model)
        if uri:
            description = self._models / _SCHEME.sub("", uri) / "model.sdf"
            if not description.exists():
                return
            found = ET.parse(description).getroot().find("model")
            if found is None:
                return
            model = found
        name = _SCHEME.sub("", uri) or re.sub(r"(_clone|_\d+)+$", "", model.get("name", ""))
        name = re.sub(r"^aws_robomaker_[a-z]+_|_\d+", "", name) if uri else name
        number = len(self.things) + 1
        now = {link.get("name"): _pose(link) for link in state.iterfind("link")} if state is not None else {}
        for link in model.iterfind("link"):
            at = now.get(link.get("name"), T @ _pose(link))
            for shown in self._shown(link):
                self.meshes.append(_moved(shown, at))
                self.owner.append(number)
        self.things.append(Truth(number, name, name, name, any(s in name for s in STRUCTURE)))
        for held in model.iterfind("model"):
            self._add(held, _state(state, held.get("name", "")), T)

    def _shown(self, link: ET.Element) -> list[TexturedMesh]:
        """What a link shows, in its frame; what it collides with where the files of that are missing."""
        for kind in ("visual", "collision"):
            out = [m for visual in link.iterfind(kind) for m in self._shape(visual)]
            if out:
                return out
        return []

    def _shape(self, visual: ET.Element) -> list[TexturedMesh]:
        geometry, look, T = visual.find("geometry"), visual.find("material"), _pose(visual)
        color = _numbers(visual.findtext("material/diffuse", ""))[:3] * 255.0
        picture = self._material(look) if look is not None else None
        if geometry is None or (mesh := geometry.find("mesh")) is None:
            return [_moved(m, T) for m in _solids(geometry, picture, color)]
        file = self._models / _SCHEME.sub("", mesh.findtext("uri", "").strip())
        scale = _numbers(mesh.findtext("scale", "1 1 1"))
        out = []
        for part in read_collada(file) if file.exists() else []:
            image = picture or (part.image if look is None else None)
            plain = (float(color[0]), float(color[1]), float(color[2])) if len(color) else part.color
            out.append(_moved(TexturedMesh(part.vertices * scale, part.triangles, part.uv, image, plain), T))
        return out

    def _material(self, look: ET.Element) -> Path | None:
        """The picture of a material that a script describes."""
        name = look.findtext("script/name", "")
        for uri in look.iterfind("script/uri"):
            folder = self._models / _SCHEME.sub("", (uri.text or "").strip())
            for script in sorted(folder.glob("*.material")) if folder.is_dir() else ():
                words = script.read_text(errors="replace").split("material " + name, 1)
                found = re.search(r"\btexture\s+(\S+)", words[-1])
                if len(words) == 2 and found:
                    return folder.parent / "textures" / found.group(1)
        return None

    def changed(self, shifts: Mapping[int, NDArray[np.float64] | None]) -> _House:
        """Return the house with things elsewhere, or away where the shift is None."""
        out = copy(self)
        kept = [(m, k) for m, k in zip(self.meshes, self.owner, strict=True) if shifts.get(k, _STILL) is not None]
        out.meshes = [replace(m, vertices=m.vertices + shifts.get(k, _STILL)) for m, k in kept]
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


def _numbers(words: str) -> NDArray[np.float64]:
    return np.array(words.split(), np.float64)


def _pose(element: ET.Element) -> NDArray[np.float64]:
    """Return the pose of an element of SDF. Shape (4, 4)."""
    words = element.findtext("pose", "").strip()
    x, y, z, roll, pitch, yaw = _numbers(words) if words else np.zeros(6)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn(yaw, pitch, roll), (x, y, z)
    return T


def _state(saved: ET.Element | None, name: str) -> ET.Element | None:
    """Return where the links of a model were when the world was saved."""
    return next((m for m in saved.iterfind("model") if m.get("name") == name), None) if saved is not None else None


def _moved(mesh: TexturedMesh, T: NDArray[np.float64]) -> TexturedMesh:
    return replace(mesh, vertices=mesh.vertices @ T[:3, :3].T + T[:3, 3])


def _solids(geometry: ET.Element | None, image: Path | None, color: NDArray[np.float64]) -> list[TexturedMesh]:
    """Return the mesh of a plane, a box or a cylinder.

    Its picture lies on every triangle by the two axes it is widest in.
    """
    import trimesh

    if geometry is not None and geometry.find("plane") is not None:
        solid = trimesh.creation.box(extents=(PLANE_M, PLANE_M, 1e-3))
    elif geometry is not None and (box := geometry.find("box")) is not None:
        solid = trimesh.creation.box(extents=_numbers(box.findtext("size", "")))
    elif geometry is not None and (tube := geometry.find("cylinder")) is not None:
        radius, length = (float(tube.findtext(k, "0")) for k in ("radius", "length"))
        solid = trimesh.creation.cylinder(radius=radius, height=length)
    else:
        return []
    points, triangles = np.asarray(solid.vertices), np.asarray(solid.faces)
    axis = np.abs(np.asarray(solid.face_normals)).argmax(axis=1)
    pair = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    uv = np.take_along_axis(points[triangles], pair[:, None, :], axis=2).astype(np.float32)
    plain = (float(color[0]), float(color[1]), float(color[2])) if len(color) else (150.0, 150.0, 150.0)
    return [TexturedMesh(points, triangles, uv, image, plain)]


class _TexturePainter:
    """Colours hits by the pictures of their meshes."""

    def __init__(self, meshes: list[TexturedMesh]) -> None:
        self._meshes = meshes
        self._images = [_picture(m.image, m.color) for m in meshes]

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


@lru_cache(maxsize=1024)
def _picture(path: Path | None, plain: tuple[float, float, float]) -> NDArray[np.uint8]:
    image: Any = cv2.imread(str(path)) if path is not None and path.exists() else None
    if image is None:
        return np.full((4, 4, 3), plain, np.uint8)
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
    """Return a walk of a seed through the house, of which every n-th frame is filmed.

    `folder` may be a file of the world, or a labelled scan (`scans`), too; then people also walk where nothing is above
    them, for lack of ceilings.
    """
    house, caster = _loaded(folder)
    visit = visit or Visit()
    rng = np.random.default_rng([seed, 17])
    camera = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
    walk = PathSettings(fps=12.0 / every)
    stops = _stops(house, caster, rng, folder.is_dir())
    if len(stops) < 2:
        raise SourceError(f"no walk with seed {seed} through {folder.name}: too few free places that see its things")
    time_s, poses = camera_path(visit.tour(stops), frames, walk, seed + visit.number)
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


def _stops(house: _House, caster: Caster, rng: np.random.Generator, roofed: bool) -> tuple[Stop, ...]:
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
        if not _free(caster, trial, roofed) or (eye is not None and not _sees(caster, eye, trial)):
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


def _free(caster: Caster, eye: NDArray[np.float32], roofed: bool) -> bool:
    """True for a place in a room: a floor below, walls around, a ceiling above if there is one, 35 cm free."""
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    round_ = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    rays = np.concatenate([[[0, 0, -1.0], [0, 0, 1.0]], round_]).astype(np.float32)
    _, known, length = caster.cast(eye, rays)
    inside = known.all() and length[1] < 2.5 if roofed else known[0]
    return bool(inside and 0.9 < length[0] < 1.8 and length[2:].min() > 0.35)


def _sees(caster: Caster, eye: NDArray[np.float32], goal: NDArray[np.generic], share: float = 1.0) -> bool:
    """True where nothing stands in the first `share` of the way."""
    ray = (np.asarray(goal) - eye).astype(np.float32)[None]
    _, known, length = caster.cast(eye, ray)
    return bool(not known[0] or length[0] > share)
