"""A walk through a world: poses of a hand-held camera, its readings, and the truth of every pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera, Frame
from list3r.memory.core.geometry import rotation_exp
from list3r.reconstruction.base import Reconstruction
from list3r.simulation.walk import PathSettings, camera_path
from list3r.simulation.worlds.world import Stop
from training.worlds.catalogue import BUILT_IN, KINDS
from training.worlds.furnish import World, make_world
from training.worlds.looks import exposed, with_looks
from training.worlds.render import world_renderer
from training.worlds.room import Placed, Room
from training.worlds.sensors import HELD_OUT_SENSORS, SENSORS, depth_noise, drift_field, read


@dataclass(frozen=True)
class Truth:
    """What is known of a thing."""

    id: int
    kind: str
    label: str
    family: str
    structure: bool


@dataclass(frozen=True)
class Film:
    """A filmed world, F frames."""

    camera: Camera
    sensor: str
    time_s: NDArray[np.float64]
    """Shape (F,)."""
    T_world_cam: NDArray[np.float64]
    """True poses. Shape (F, 4, 4)."""
    color: NDArray[np.uint8]
    """RGB. Shape (F, H, W, 3)."""
    depth: NDArray[np.float32]
    """As read, metres, 0 where unknown. Shape (F, H, W)."""
    true_depth: NDArray[np.float32]
    """Without noise and holes, metres. Shape (F, H, W)."""
    ids: NDArray[np.uint16]
    """True thing of each pixel, 0 for none. Shape (F, H, W)."""
    things: tuple[Truth, ...]


@dataclass(frozen=True)
class FilmSettings:
    """What is filmed and how."""

    seed: int = 0
    held_out: bool = False
    """Families, textures and sensors that training never shows appear too."""
    fitted: bool = False
    """Rooms with what is built in, see `make_world`."""
    odd: float = 0.0
    """Share of things that no catalogue knows, see `make_world`."""
    recessed: bool = False
    """Rooms whose windows, doors and niches lie behind the face of the walls, see `make_world`."""
    frames: int = 30
    every: int = 2
    """Only every n-th frame of the walk is filmed, which is all that fusion looks at."""
    size: tuple[int, int] = (320, 240)
    sensor: str | None = None
    """None draws one."""
    far_m: float | None = None
    """From how far away things are looked at, at most; None: 2.4 m, and 3.4 m in rooms with what is built in."""
    patches: float = 0.0
    """Steps in computed depth where there is little texture, as a share of it."""
    looks: bool = False
    """Surfaces are worn, printed and glossy, and exposure changes, see `training.worlds.looks`."""


def varied(settings: FilmSettings) -> FilmSettings:
    """Return the settings of a world for training with the distance and the errors of depth drawn by its seed."""
    rng = np.random.default_rng([settings.seed, 17])
    far, patches = float(rng.uniform(2.0, 4.5)), float(rng.uniform(0.0, 0.05))
    return replace(settings, far_m=far, patches=patches if rng.random() < 0.6 else 0.0)


@dataclass(frozen=True)
class Visit:
    """A walk through a world in which things may have been put elsewhere since the first one."""

    number: int = 0
    """The camera of another visit sways otherwise and goes the other way round."""
    shifts: Mapping[int, NDArray[np.float64] | None] = field(default_factory=dict)
    """How far things were carried, metres, shape (3,), by id; None: it is not there."""

    def tour(self, stops: tuple[Stop, ...]) -> tuple[Stop, ...]:
        """Return the places that the walk passes, in its order."""
        return tuple(reversed(stops)) if self.number else stops


def make_film(settings: FilmSettings, visit: Visit | None = None) -> Film:
    """Return the walk of a seed through the world of that seed."""
    visit = visit or Visit()
    world = make_world(
        settings.seed,
        held_out=settings.held_out,
        fitted=settings.fitted,
        odd=settings.odd,
        recessed=settings.recessed,
    )
    rng = np.random.default_rng([settings.seed, 7])
    sensor = drawn_sensor(settings, rng)
    focal = settings.size[0] * rng.uniform(0.72, 0.9)
    w, h = settings.size
    camera = Camera(w, h, focal, focal, (w - 1) / 2, (h - 1) / 2)
    speed = PathSettings(fps=float(rng.uniform(9, 15)) / settings.every, speed_m_s=float(rng.uniform(0.35, 0.7)))
    stops = _stops(world, rng, settings)
    time_s, poses = camera_path(visit.tour(stops), settings.frames, speed, settings.seed + visit.number)
    placed = tuple(p for t in world.things if (p := _shifted(t, visit)) is not None)
    renderer = world_renderer(placed, world.size, camera, settings.seed)
    if settings.looks:
        renderer = with_looks(renderer, settings.seed)
    color, depth, true_depth, ids = [], [], [], []
    drift = drift_field((h, w), rng)
    for pose in poses:
        picture = renderer.render(pose)
        drift = (0.985 * drift + 0.17 * drift_field((h, w), rng)).astype(np.float32)
        reading = read(picture, sensor, rng, drift, settings.patches)
        color.append(reading.color)
        depth.append(reading.depth)
        true_depth.append(picture.depth)
        ids.append(picture.ids.astype(np.uint16))
    things = tuple(_truth(t) for t in world.things)
    images = [np.stack(part) for part in (color, depth, true_depth, ids)]
    if settings.looks:
        images[0] = exposed(images[0], rng)
    return Film(camera, sensor, time_s, poses, images[0], images[1], images[2], images[3], things)


def drawn_sensor(settings: FilmSettings, rng: np.random.Generator) -> str:
    """Return what a room is filmed with; the first thing that is drawn for a film."""
    sensors = SENSORS if settings.held_out else tuple(s for s in SENSORS if s not in HELD_OUT_SENSORS)
    return settings.sensor or str(rng.choice(sensors))


def _shifted(thing: Placed, visit: Visit) -> Placed | None:
    shift = visit.shifts.get(thing.id, np.zeros(3))
    if shift is None:
        return None
    T = thing.T_world_thing.copy()
    T[:3, 3] += shift
    return replace(thing, T_world_thing=T)


def world_extents(settings: FilmSettings) -> dict[int, NDArray[np.float64]]:
    """Return lower and upper corners of the things of a world that are no structure. Shapes (2, 3)."""
    world = make_world(settings.seed, held_out=settings.held_out, fitted=settings.fitted, odd=settings.odd)
    return {
        t.id: np.stack([t.vertices().min(axis=0), t.vertices().max(axis=0)]) for t in world.things if not t.structure
    }


def _truth(thing: Placed) -> Truth:
    return Truth(thing.id, thing.kind, thing.label, thing.family, thing.structure)


def _stops(world: World, rng: np.random.Generator, settings: FilmSettings) -> tuple[Stop, ...]:
    """Return places to look from and at: furniture round the room, from a metre or two, some of it close."""
    room: Room = world.room
    w, deep, _ = world.size
    eyes = [(x, y) for x, y in rng.uniform(0.25, np.array([w, deep]) - 0.25, (300, 2)).tolist() if room.free_eye(x, y)]
    eyes = eyes or [(w / 2, deep / 2)]
    targets = [t for t in world.things if not t.structure]
    far = 2.4
    if settings.fitted:
        far = 3.4
        targets = targets + 4 * [t for t in targets if t.kind in KINDS and KINDS[t.kind].place in BUILT_IN]
    far = settings.far_m or far
    count = max(3, settings.frames * settings.every // 14)
    start = np.array(eyes[int(rng.integers(len(eyes)))])
    bearing, stops = rng.uniform(0, 2 * np.pi), []
    heading = rng.choice([-1, 1])
    for _ in range(count):
        middle = (
            [t.vertices().mean(axis=0) for t in (targets[int(k)] for k in rng.integers(len(targets), size=6))]
            if targets
            else []
        )
        middle = middle or [np.array([w / 2, deep / 2, 0.5])]
        angle = [
            abs((np.arctan2(m[1] - start[1], m[0] - start[0]) - bearing + np.pi) % (2 * np.pi) - np.pi) for m in middle
        ]
        goal = middle[int(np.argmin(angle))]
        options = [np.array(e) for e in eyes if np.linalg.norm(np.array(e) - start) < 1.0]
        away = [abs(float(np.linalg.norm(e - goal[:2])) - rng.uniform(0.9, far)) for e in options]
        start = options[int(np.argmin(away))] if options else start
        bearing += heading * rng.uniform(0.3, 0.9)
        height = float(rng.uniform(1.1, 1.7))
        jitter = rng.normal(0, 0.15, 3)
        stops.append(
            Stop((float(start[0]), float(start[1]), min(height, world.size[2] - 0.3)), tuple((goal + jitter).tolist()))
        )
    return tuple(stops)


def reconstruction_of(film: Film, drift_m: float = 0.006, drift_deg: float = 0.15, seed: int = 0) -> Reconstruction:
    """Return a film as a reconstruction model hands it on, its poses off by a smooth drift."""
    rng = np.random.default_rng([seed, 11])
    count = len(film.time_s)
    at = np.linspace(0, 1, count)
    knots = np.linspace(0, 1, max(3, count // 12))
    wave = np.stack([np.interp(at, knots, rng.normal(size=len(knots))) for _ in range(6)], axis=1)
    T = film.T_world_cam.copy()
    T[:, :3, 3] += drift_m * wave[:, :3]
    T[:, :3, :3] = T[:, :3, :3] @ rotation_exp(np.deg2rad(drift_deg) * wave[:, 3:])
    T_chunk = np.linalg.inv(T[0]) @ T
    confidence = (film.depth > 0).astype(np.float16) * np.float16(0.8)
    return Reconstruction(
        frame_indices=np.arange(count),
        posed=np.ones(count, bool),
        T_chunk_cam=T_chunk,
        camera=film.camera,
        depth=film.depth,
        confidence=confidence,
        scale_kind="metric",
        keyframes=np.arange(0, count, 8),
        depth_noise=depth_noise(film.sensor),
    )


def frames_of(film: Film) -> list[Frame]:
    """Return the frames as a source hands them out."""
    return [Frame(k, float(t), film.color[k], film.depth[k], None) for k, t in enumerate(film.time_s.tolist())]
