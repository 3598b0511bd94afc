"""Videos that return to a place of changed appearance, where frame similarity fails.

Each has two runs with a cut between them. The first ends in some room, the second begins there:

- opposite: from the other end of the room in the opposite direction;
- night: the same views in another light, which changes the appearance of objects and pictures;
- alike: in one of three rooms of one plan, which differ in appearance and place of three objects each;
- moved: half of the furniture and of the small objects were moved in between, and the light changed;
- halls: large bare halls with two or three objects each;
- seasons: a kitchen in another light, by another camera of another field of view, held at another height, after half of
  the small objects were moved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.buildings import (
    Building,
    BuildingSettings,
    PlacedRoom,
    appearance_classes,
    make_building,
)
from benchmarks.simulation.casting import Caster
from benchmarks.simulation.presets import preset_camera
from benchmarks.simulation.routes import Director, FreeMap, View
from benchmarks.simulation.takes import Take
from benchmarks.simulation.video import SimulatedVideo
from list3r.frames.base import Camera
from list3r.memory.core.errors import OptionError
from list3r.simulation.walk import PathSettings
from list3r.simulation.worlds.objects import SimulatedObject
from list3r.simulation.worlds.truth import footprint_gap
from list3r.simulation.worlds.world import SimulatedWorld

Array = NDArray[np.float64]

RETURNS = ("opposite", "night", "alike", "moved", "halls", "seasons")
_KINDS = ("living room", "bedroom", "office", "kitchen", "meeting room", "storage")
_STAYS = ("door", "door frame", "window", "picture", "whiteboard", "sink", "worktop", "wardrobe", "bookshelf")
"""Kinds that are not moved."""
_LIT = ("night", "moved", "seasons")
"""Presets with another light in the second run."""


def make_return(preset: str, seed: int, size: tuple[int, int] = (64, 48)) -> SimulatedVideo:
    """Return depth and ids of every frame of a preset of `RETURNS`; all is drawn from the seed.

    Raises `OptionError` for a preset that does not exist.
    """
    take, later = film_return(preset, seed)
    return _cast(preset, seed, take, later, size)


def film_return(preset: str, seed: int) -> tuple[Take, SimulatedWorld | None]:
    """Return the building and both runs of a preset, and the world of the second run where objects were moved."""
    if preset not in RETURNS:
        raise OptionError(f"no preset {preset!r}: one of {', '.join(RETURNS)}")
    rng = np.random.default_rng([seed, 51, RETURNS.index(preset)])
    building = _building(preset, seed, rng)
    pace = PathSettings(12.5, 0.6 * rng.uniform(0.85, 1.15), 42.0 * rng.uniform(0.85, 1.2))
    take = Take(building, FreeMap(building), rng, pace, float(rng.uniform(1.35, 1.6)))
    room = building.north[0 if preset == "seasons" else int(rng.integers(len(building.north)))]
    others = [r for r in building.north + building.south if r is not room]
    others = [others[k] for k in rng.permutation(len(others))]
    _film(take, preset, room, others)
    if preset not in ("moved", "seasons"):
        return take, None
    return take, _rearranged(building.world, room, rng, floor=preset == "moved")


def _building(preset: str, seed: int, rng: np.random.Generator) -> Building:
    kinds = [_KINDS[k] for k in rng.permutation(len(_KINDS))]
    if preset == "seasons":
        kinds = ["kitchen", *(kind for kind in kinds if kind != "kitchen")]
    settings = {
        "alike": BuildingSettings((f"{kinds[0]}#a",) * 3, (kinds[1],)),
        "halls": BuildingSettings(("empty",) * 2, ("empty",), width_m=(7.0, 9.0), depth_m=(6.0, 7.5)),
    }.get(preset, BuildingSettings(tuple(kinds[:2]), tuple(kinds[2:4]), width_m=(4.0, 5.4), depth_m=(4.0, 5.0)))
    building = make_building(settings, int(rng.integers(1 << 31)))
    world = replace(building.world, seed=seed)
    if preset == "alike":
        world = _distinct(world, building.north, rng)
    return replace(building, world=world)


def _distinct(world: SimulatedWorld, rooms: tuple[PlacedRoom, ...], rng: np.random.Generator) -> SimulatedWorld:
    """Return the world with three objects of each room in colours of their own."""
    objects = {t.id: t for t in world.objects}
    for room in rooms:
        loose = [k for k in room.objects if objects[k].structure is None]
        for k in rng.permutation(len(loose))[:3]:
            obj = objects[loose[k]]
            low, high = (_rgb(rng), _rgb(rng))
            paint = replace(obj.parts[0].material, color=low, accent=high, seed=int(rng.integers(1 << 16)))
            objects[obj.id] = replace(obj, parts=tuple(replace(p, material=paint) for p in obj.parts))
    return replace(world, objects=tuple(objects[t.id] for t in world.objects))


def _rgb(rng: np.random.Generator) -> tuple[int, int, int]:
    r, g, b = (int(n) for n in rng.integers(20, 235, 3))
    return r, g, b


def _film(take: Take, preset: str, room: PlacedRoom, others: list[PlacedRoom]) -> None:
    """Film two other rooms and at last this one; cut; this one again."""
    later = take
    if preset == "seasons":
        pace = PathSettings(12.5, 0.6 * take.rng.uniform(0.85, 1.15), 42.0 * take.rng.uniform(0.85, 1.2))
        later = replace(take, path=pace, eye_m=float(take.rng.uniform(1.2, 1.7)))
    first, second = take.director(), later.director()
    for other in others[:2]:
        first.film(first.plan_views(other, 1, 130.0))
    if preset == "opposite":
        views = [_toward(first, room, 1.0) for _ in range(3)]
        first.film(views[:1], look_round=0.0)
        for view in views[1:]:
            first.look(view)
        for view in [_toward(second, room, -1.0) for _ in range(5)]:
            second.look(view)
    else:
        views = first.plan_views(room, 2, 140.0)
        first.film(views)
        second.film([_near(second, room, view) for view in (*views, views[0])])
    for run, director in ((take, first), (later, second)):
        run.shoot(director, round(director.seconds() * run.path.fps))


def _toward(director: Director, room: PlacedRoom, way: float) -> View:
    """Return a view from the door's end of a room to the other end (`way` 1), or the other way (-1)."""
    places = director.free.open_places(room, 0.3)
    half = np.array([room.x1 - room.x0, room.y1 - room.y0]) / 2
    back = -way * (places[:, 1] - room.center()[1])
    near_end = places[back >= np.quantile(back, 0.8)]
    spot = near_end[director.rng.integers(len(near_end))]
    across = np.linspace(-0.75, 0.75, 3) * half[0]
    looked = []
    for shift in across if director.rng.integers(2) else across[::-1]:
        x, y = room.center()[0] + shift, room.center()[1] + way * 0.8 * half[1]
        looked.append((float(x), float(y), float(director.rng.uniform(0.6, 1.1))))
    return View((float(spot[0]), float(spot[1])), tuple(looked))


def _near(director: Director, room: PlacedRoom, view: View) -> View:
    """Return a view of the same targets from another place near by."""
    places = director.free.open_places(room, 0.35)
    gap = np.linalg.norm(places - np.array(view.xy), axis=1)
    good = places[(gap > 0.3) & (gap < 1.2)]
    spot = good[director.rng.integers(len(good))] if len(good) else places[int(np.argmin(gap))]
    return View((float(spot[0]), float(spot[1])), view.targets)


def _rearranged(world: SimulatedWorld, room: PlacedRoom, rng: np.random.Generator, floor: bool) -> SimulatedWorld:
    """Return the world with half of the objects on a room's furniture and `floor` moved within it."""
    objects = {t.id: t for t in world.objects}
    floors = [k for k in room.objects if objects[k].structure == "floor"]
    for k in room.objects:
        obj = objects[k]
        loose = obj.structure is None and obj.attached is None and obj.container is None
        if not loose or obj.label in _STAYS or rng.random() >= 0.5:
            continue
        on_floor = obj.support is None or obj.support in floors
        if on_floor and not floor:
            continue
        carried = [t for t in objects.values() if k in (t.support, t.container)]
        carried += [t for t in objects.values() if t.container in {c.id for c in carried}]
        moved = _elsewhere(obj, objects, room, on_floor, rng)
        if moved is None:
            continue
        for t in (*carried, obj):
            objects[t.id] = _with(t, obj, moved)
    return replace(world, objects=tuple(objects[t.id] for t in world.objects))


def _elsewhere(
    obj: SimulatedObject, objects: dict[int, SimulatedObject], room: PlacedRoom, floor: bool, rng: np.random.Generator
) -> SimulatedObject | None:
    """Return the object at a free place of the room's floor or of its support, None where there is none."""
    base = None if floor or obj.support is None else objects[obj.support].box()
    rivals = [
        t.box()
        for t in (objects[k] for k in room.objects)
        if t.structure is None and t.id != obj.id and t.support == obj.support and t.container is None
    ]
    for _ in range(60):
        if base is None:
            x, y = rng.uniform((room.x0 + 0.35, room.y0 + 0.35), (room.x1 - 0.35, room.y1 - 0.35))
        else:
            x, y = (base.center + base.rotation @ (rng.uniform(-0.4, 0.4, 3) * base.size))[:2]
        tried = replace(obj, position=(float(x), float(y), obj.position[2]), yaw=float(rng.uniform(0, 2 * np.pi)))
        corners = tried.box().corners()[:, :2]
        low, high = corners.min(axis=0), corners.max(axis=0)
        inside = bool(
            (low > (room.x0 + 0.03, room.y0 + 0.03)).all() and (high < (room.x1 - 0.03, room.y1 - 0.03)).all()
        )
        if inside and all(footprint_gap(tried.box(), rival) > 0.02 for rival in rivals):
            return tried
    return None


def _with(obj: SimulatedObject, before: SimulatedObject, after: SimulatedObject) -> SimulatedObject:
    """Return an object moved with its support."""
    turn = after.yaw - before.yaw
    c, s = float(np.cos(turn)), float(np.sin(turn))
    dx, dy = obj.position[0] - before.position[0], obj.position[1] - before.position[1]
    x, y = after.position[0] + c * dx - s * dy, after.position[1] + s * dx + c * dy
    return replace(obj, position=(x, y, obj.position[2]), yaw=obj.yaw + turn)


def _cast(preset: str, seed: int, take: Take, later: SimulatedWorld | None, size: tuple[int, int]) -> SimulatedVideo:
    camera, world = preset_camera(size), take.building.world
    poses, cut = np.concatenate(take.poses), len(take.poses[0])
    depth = np.empty((len(poses), camera.height, camera.width), np.float32)
    ids = np.empty(depth.shape, np.int32)
    other = _other_camera(camera, seed) if preset == "seasons" else None
    casters = Caster(world.objects, camera), Caster((later or world).objects, other or camera)
    for k, pose in enumerate(poses):
        depth[k], ids[k] = casters[int(k >= cut)].cast(pose)
    light = (np.arange(len(poses)) >= cut).astype(np.int64) if preset in _LIT else None
    classes = appearance_classes(world.objects)
    time_s = np.arange(len(poses)) / take.path.fps
    return SimulatedVideo(
        preset, seed, world, camera, time_s, poses, depth, ids, (cut,), (), classes, light, later, other
    )


def _other_camera(camera: Camera, seed: int) -> Camera:
    """Return a camera of the same picture size that sees 70 to 85 degrees across."""
    across = np.deg2rad(np.random.default_rng([seed, 52]).uniform(70.0, 85.0))
    focal = float(camera.width / (2 * np.tan(across / 2)))
    return replace(camera, fx=focal, fy=focal)
