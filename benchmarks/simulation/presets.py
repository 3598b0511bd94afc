"""Videos by name: kind of building, way through it, movers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.buildings import BuildingSettings, appearance_classes, make_building
from benchmarks.simulation.casting import Caster
from benchmarks.simulation.covisibility import Views, shared_view
from benchmarks.simulation.movers import make_movers
from benchmarks.simulation.routes import Director, FreeMap, View, mapped_view
from benchmarks.simulation.takes import Shot, Take
from benchmarks.simulation.video import MoverTruth, SimulatedVideo
from list3r.frames.base import Camera
from list3r.memory.core.errors import OptionError
from list3r.simulation.walk import PathSettings, viewing_poses
from list3r.simulation.worlds.world import Stop

Array = NDArray[np.float64]

_FURNISHED = ("living room", "bedroom", "office", "kitchen", "meeting room", "storage")
_FPS = 12.5
_BEFORE_CUT = (1, 10, 20)
"""Frames before a cut that must share nothing with the view after it."""


_SOMETIMES_FAST = ("loop", "kidnap", "twins")
"""Presets with a camera that turns nearly twice as fast in every third seed."""


def preset_names() -> tuple[str, ...]:
    """Names that `make_video` knows."""
    return tuple(_PRESETS)


def make_shot(preset: str, seed: int, movers: bool = True) -> Shot:
    """The building, the way and the movers of a preset; all are drawn from the seed.

    Raises `OptionError` for a preset that does not exist.
    """
    if preset not in _PRESETS:
        raise OptionError(f"no preset {preset!r}: one of {', '.join(_PRESETS)}")
    rng = np.random.default_rng([seed, 31, list(_PRESETS).index(preset)])
    settings, film, pace = _PRESETS[preset]
    building = make_building(settings(rng), int(rng.integers(1 << 31)))
    building = replace(building, world=replace(building.world, seed=seed))
    path = replace(
        pace, speed_m_s=pace.speed_m_s * rng.uniform(0.85, 1.15), turn_deg_s=pace.turn_deg_s * rng.uniform(0.8, 1.3)
    )
    if preset in _SOMETIMES_FAST and rng.uniform() < 0.35:
        path = replace(path, turn_deg_s=1.9 * path.turn_deg_s)
    take = Take(building, FreeMap(building), rng, path, float(rng.uniform(1.35, 1.6)))
    film(take)
    poses = np.concatenate(take.poses)
    cuts = tuple(int(c) for c in np.cumsum([len(p) for p in take.poses])[:-1])
    time_s = np.arange(len(poses)) / take.path.fps
    moving = make_movers(building, take.free, poses, take.path.fps, rng) if preset == "dynamic" and movers else ()
    return Shot(preset, seed, building, time_s, poses, cuts, moving)


def preset_camera(size: tuple[int, int]) -> Camera:
    """The camera of a picture size: the first Kinect's field of view, 63 degrees across."""
    width, height = size
    if min(size) < 8 or max(size) > 4096:
        raise OptionError(f"picture size {width}x{height}: both must be from 8 to 4096 px")
    focal = 525.0 * width / 640
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def make_video(preset: str, seed: int, size: tuple[int, int] = (64, 48), movers: bool = True) -> SimulatedVideo:
    """Depth and ids of every frame of a preset: calm, loop, kidnap, dynamic, twins, sparse or corridor.

    Without `movers` the same way through the same building is filmed with nothing moving in it. Raises `OptionError`
    for a preset that does not exist or a size that makes no sense.
    """
    camera = preset_camera(size)
    shot = make_shot(preset, seed, movers)
    objects = shot.building.world.objects
    caster = Caster(objects, camera, [m.obj for m in shot.movers])
    depth = np.empty((len(shot.time_s), camera.height, camera.width), np.float32)
    ids = np.empty(depth.shape, np.int32)
    for k, pose in enumerate(shot.T_world_cam):
        for mover in shot.movers:
            caster.scene.place(mover.obj.id, mover.T_world_object[k])
        depth[k], ids[k] = caster.cast(pose)
    return SimulatedVideo(
        preset,
        seed,
        shot.building.world,
        camera,
        shot.time_s,
        shot.T_world_cam,
        depth,
        ids,
        shot.cuts,
        tuple(MoverTruth(m.obj.id, m.obj.label, m.T_world_object) for m in shot.movers),
        appearance_classes((*objects, *(m.obj for m in shot.movers))),
    )


# ------------------------------------------------------------------------------------------------ buildings


def _kinds(rng: np.random.Generator, count: int) -> list[str]:
    """Kinds of furnished rooms, none twice before all have been drawn."""
    drawn: list[str] = []
    while len(drawn) < count:
        drawn += [_FURNISHED[k] for k in rng.permutation(len(_FURNISHED))]
    return drawn[:count]


def _two_rooms(rng: np.random.Generator) -> BuildingSettings:
    return BuildingSettings(tuple(_kinds(rng, 2)), (), linked=True)


def _big_rooms(rng: np.random.Generator) -> BuildingSettings:
    kinds = ("living room", "meeting room", "office", "kitchen")
    north = tuple(kinds[k] for k in rng.permutation(4)[:2])
    return BuildingSettings(north, (), linked=True, width_m=(4.8, 6.0), depth_m=(4.4, 5.4))


def _ring(rng: np.random.Generator) -> BuildingSettings:
    north, south = ((3, 3), (4, 2), (3, 2), (4, 3), (4, 0), (5, 0))[int(rng.integers(6))]
    kinds = _kinds(rng, north + south)
    return BuildingSettings(tuple(kinds[:north]), tuple(kinds[north:]), linked=True)


def _floor(rng: np.random.Generator) -> BuildingSettings:
    kinds = _kinds(rng, 6)
    return BuildingSettings(tuple(kinds[:3]), tuple(kinds[3:]), linked=bool(rng.integers(2)))


def _with_twins(rng: np.random.Generator) -> BuildingSettings:
    twin, other, third = _kinds(rng, 3)
    a, b = f"{twin}#a", f"{other}#b"
    plans = [((a, third, a), ()), ((a, third), (a,)), ((a, a, third), ()), ((a, b), (b, a)), ((a, b, a), (b,))]
    north, south = plans[int(rng.integers(len(plans)))]
    return BuildingSettings(north, south)


def _bare(rng: np.random.Generator) -> BuildingSettings:
    return BuildingSettings(
        ("empty", "empty", "empty"),
        (),
        linked=True,
        width_m=(4.4, 6.4),
        depth_m=(4.2, 6.0),
        clutter=0.5,
        corridor_clutter=0.5,
    )


def _long(rng: np.random.Generator) -> BuildingSettings:
    north, south = _kinds(rng, 2)
    return BuildingSettings(
        (north,),
        (south,) if rng.integers(2) else (),
        corridor_m=(1.7, 2.4),
        corridor_clutter=0.45,
        closed_doors=9,
        length_m=float(rng.uniform(21, 27)),
    )


# ------------------------------------------------------------------------------------------------ ways


def _film_calm(take: Take) -> None:
    rooms = take.building.north[: int(take.rng.integers(1, 3))]
    director, frames = take.director(), int(take.rng.integers(820, 1000))
    k = 0
    while director.seconds() * take.path.fps < frames:
        room = rooms[(k // 3) % len(rooms)]
        director.film(director.plan_views(room, 1, 150.0))
        k += 1
    take.shoot(director, frames)


def _film_loop(take: Take) -> None:
    """Through one row of rooms, back through the other and the corridor, then once more where the way began."""
    rows = [take.building.north, take.building.south]
    if take.rng.integers(2) and rows[1]:
        rows.reverse()
    there, back = rows[0], rows[1][::-1]
    if take.rng.integers(2):
        there, back = rows[0][::-1], rows[1]
    director, frames = take.director(), int(take.rng.integers(1120, 1280))
    director.film(director.plan_views(there[0], 2, 120.0))
    for room in (*there[1:], *back):
        director.film(director.plan_views(room, 1, 90.0))
    if not back:
        director.walk_to(there[-1].doorways[0])
        director.walk_to(there[0].doorways[0])
    director.film(director.plan_views(there[0], 1, 120.0))
    take.fit(director, round(frames * take.rng.uniform(0.74, 0.82)))
    director.film(director.plan_views(there[0], 1, 120.0))
    for room in there[1:]:
        director.film(director.plan_views(room, 2, 120.0))
    take.shoot(director, frames)


def _film_kidnap(take: Take) -> None:
    """Rooms in turn; then the picture jumps to a place that was filmed long before."""
    rooms = take.building.north + take.building.south
    rooms = tuple(rooms[k] for k in take.rng.permutation(len(rooms)))
    frames, first = int(take.rng.integers(1020, 1220)), int(take.rng.integers(470, 690))
    lengths = [first, frames - first]
    if take.rng.uniform() < 0.4 and frames - first > 400:
        second = int(take.rng.integers(190, frames - first - 170))
        lengths = [first, second, frames - first - second]
    director, k = take.director(), 0
    for run, length in enumerate(lengths):
        if run:
            director = _jump(take)
        while director.seconds() * take.path.fps < length:
            director.film(director.plan_views(rooms[k % len(rooms)], 2, 140.0))
            k += 1
        take.shoot(director, length)


def _jump(take: Take) -> Director:
    """A director who begins near a view filmed at least 250 frames ago that shares nothing with the present view."""
    poses = np.concatenate(take.poses)
    glimpse = _Glimpse(take)
    now = poses[[-k for k in _BEFORE_CUT]]
    director, best = take.director(), None
    for frame in take.rng.permutation(len(poses) - 250):
        view = _near_view(take, director, poses, int(frame))
        if view is None:
            continue
        then = _looking_at((*view.xy, take.eye_m), view.targets[0])[None]
        if glimpse.common(then, now, 180.0).max() > 0:
            continue
        best = best or view
        if glimpse.common(then, poses[[frame]], 60.0)[0, 0] > 0.4:
            best = view
            break
    assert best is not None, "some room other than the present one has been filmed"
    room = take.building.room_at(*best.xy)
    assert room is not None
    director.look(best)
    director.film(director.plan_views(room, 1, 140.0))
    return director


class _Glimpse:
    """Small pictures of a building, to find overlapping views."""

    def __init__(self, take: Take) -> None:
        self._camera = preset_camera((32, 24))
        self._caster = Caster(take.building.world.objects, self._camera)

    def common(self, T_world_a: Array, T_world_b: Array, most_deg: float) -> NDArray[np.float32]:
        """Share of the picture that views have in common, the lesser of both directions. Shape (A, B)."""
        a, b = (
            Views(np.stack([self._caster.cast(T)[0] for T in poses]), poses, self._camera)
            for poses in (T_world_a, T_world_b)
        )
        return np.minimum(shared_view(a, b, most_deg), shared_view(b, a, most_deg).T)


def _near_view(take: Take, director: Director, poses: Array, frame: int) -> View | None:
    """A view of a frame's target from another place in its room; None in corridors and doorways."""
    room = take.building.room_at(*poses[frame, :2, 3])
    if room is None or room.kind == "corridor":
        return None
    later = [min(frame + k, len(poses) - 1) for k in (0, 12, 24)]
    seen = [_looked_at(poses[g], room.x0, room.x1, room.y0, room.y1) for g in later]
    places = director.free.open_places(room, 0.35)
    gap = np.linalg.norm(places - poses[frame, :2, 3], axis=1)
    good = places[(gap > 0.3) & (gap < 1.3) & (np.linalg.norm(places - np.array(seen[0][:2]), axis=1) > 1.2)]
    if not len(good):
        return None
    spot = good[take.rng.integers(len(good))]
    return View((float(spot[0]), float(spot[1])), tuple(seen))


def _looked_at(pose: Array, x0: float, x1: float, y0: float, y1: float) -> tuple[float, float, float]:
    """Where the middle of the picture meets the walls of a room, at most 3 m away."""
    eye, forward = pose[:3, 3], pose[:3, 2]
    reach = [3.0]
    for axis, (low, high) in enumerate(((x0, x1), (y0, y1))):
        if abs(forward[axis]) > 1e-6:
            reach.append(float(((high if forward[axis] > 0 else low) - eye[axis]) / forward[axis]))
    point = eye + max(min(reach), 0.5) * forward
    return float(point[0]), float(point[1]), float(point[2])


def _film_dynamic(take: Take) -> None:
    director, frames, k = take.director(), int(take.rng.integers(900, 1060)), 0
    while director.seconds() * take.path.fps < frames:
        room = take.building.north[(k // 3) % 2]
        director.film(director.plan_views(room, 1, 130.0), look_round=0.15)
        k += 1
    take.shoot(director, frames)


def _film_twins(take: Take) -> None:
    """A room, its twin in the same way, the others, and truly back to the first."""
    rooms = take.building.north + take.building.south
    pairs = [(a, b) for a in rooms for b in rooms if a.twin and a.twin == b.twin and a.x0 <= b.x0 and a is not b]
    pairs = [(a, b) if take.rng.integers(2) else (b, a) for a, b in pairs[:2]]
    director, frames = take.director(), int(take.rng.integers(1060, 1260))
    begun = None
    for a, b in pairs:
        views = director.plan_views(a, 2 if len(pairs) == 1 else 1, 140.0)
        begun = begun or views
        director.film(views)
        director.film([mapped_view(v, a, b) for v in views])
    for room in rooms:
        if not room.twin:
            director.film(director.plan_views(room, 1, 120.0))
    assert begun is not None
    director.film(begun)
    take.fit(director, round(frames * take.rng.uniform(0.86, 0.96)))
    director.film(director.plan_views(pairs[0][0], 2, 120.0))
    take.shoot(director, frames)


def _film_sparse(take: Take) -> None:
    rooms = take.building.north if take.rng.integers(2) else take.building.north[::-1]
    director, frames = take.director(), int(take.rng.integers(860, 1060))
    k, order = 0, (0, 1, 2, 1, 0)
    while director.seconds() * take.path.fps < frames:
        director.film(director.plan_views(rooms[order[k % 5]], 2, 150.0))
        k += 1
    take.shoot(director, frames)


def _film_corridor(take: Take) -> None:
    """Along the corridor to its end and back."""
    corridor = take.building.corridor
    y = (corridor.y0 + corridor.y1) / 2
    ends = [corridor.x0 + 0.9, corridor.x1 - 0.9]
    if take.rng.integers(2):
        ends.reverse()
    toward = float(np.sign(ends[1] - ends[0]))
    director, frames = take.director(), int(take.rng.integers(1000, 1200))
    director.begin((ends[0], y), (ends[0] + 2.5 * toward, y, 1.0))
    director.walk_to((ends[1], y), look_round=0.2)
    side = y + (0.7 if take.rng.integers(2) else -0.7)
    director.stops.append(Stop((ends[1], y, take.eye_m), (ends[1] - 0.2 * toward, side, 1.1)))
    director.walk_to((ends[0], y), look_round=0.2)
    take.fit(director, frames)
    take.shoot(director, frames)


_Preset = tuple[Callable[[np.random.Generator], BuildingSettings], Callable[[Take], None], PathSettings]
_PRESETS: dict[str, _Preset] = {
    "calm": (_two_rooms, _film_calm, PathSettings(_FPS, 0.45, 30.0)),
    "loop": (_ring, _film_loop, PathSettings(_FPS, 0.8, 50.0)),
    "kidnap": (_floor, _film_kidnap, PathSettings(_FPS, 0.65, 45.0)),
    "dynamic": (_big_rooms, _film_dynamic, PathSettings(_FPS, 0.45, 32.0)),
    "twins": (_with_twins, _film_twins, PathSettings(_FPS, 0.65, 45.0)),
    "sparse": (_bare, _film_sparse, PathSettings(_FPS, 0.6, 38.0)),
    "corridor": (_long, _film_corridor, PathSettings(_FPS, 0.65, 45.0)),
}
"""Which building, which way, which pace at most."""


def _looking_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return T_world_cam of an upright camera at `eye` towards `target`, metres. Shape (4, 4)."""
    x, y, z = np.array(target) - np.array(eye)
    angles = [np.array([a]) for a in (np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), 0.0)]
    return np.asarray(viewing_poses(np.array([eye]), *angles)[0])
