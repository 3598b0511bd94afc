"""A phone's walk with stretches without visual cues: a bare wall, a quick turn, no light. They were chosen before any
build, as typical of a walk through a home: someone turns to a wall and is close before it, turns away quickly in lamp
light, and for a moment holds a finger over the lens (or walks through a dark corridor). The given poses go on through
all of it with their drift, as inertial odometry does; their jump falls to the end of the turn away from the wall, the
dark comes after it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Camera
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.rendering.projection import SolidScene
from list3r.simulation.rendering.render import Renderer
from list3r.simulation.walk import viewing_poses

Array = NDArray[np.float64]

WALKED, WALL, TURN, DARK, LOWERED = "walked", "wall", "turn", "dark", "lowered"


@dataclass(frozen=True)
class BlindSettings:
    """Where the camera cannot be tracked visually."""

    wall_at: float = 0.3
    """Share of the walk after which the camera turns to the nearest bare wall and comes back."""
    wall_s: float = 1.5
    """Time before the wall, which fills the picture."""
    wall_m: float = 0.5
    """Distance from it."""
    along_m: float = 0.3
    """Way along it in that time."""
    turn_deg_s: float = 180.0
    """Fastest rate of the turns to the wall and back."""
    step_m_s: float = 1.5
    """Fastest pace of the way to the wall and back."""
    onward: int = 0
    """Frames of the walk that the way back from the wall leaves out, by a free way: it is not where it left."""
    exposure_s: float = 1.0 / 30.0
    """Of each picture in lamp light, over which turns are drawn out."""
    dark_at: float = 0.75
    """Share of the walk after which pictures are black and depth is missing."""
    dark_s: float = 1.0


@dataclass(frozen=True)
class BlindWalk:
    """A walk with its blind stretches."""

    time_s: Array
    """Shape (F,)."""
    T_world_cam: Array
    """Shape (F, 4, 4)."""
    stretch: tuple[str, ...]
    """Of each frame: walked, wall, turn or dark; of a phone that is lowered, lowered."""
    exposure_s: float = 0.0
    """Time over which pictures of turns are drawn out."""


def blind_walk(walk: WalkSettings, blind: BlindSettings) -> BlindWalk:
    """Return the walk with a detour to a bare wall, and with dark frames. The rest of the way stays as it was."""
    _, poses = walk.poses()
    fps, at = walk.path.fps, round(blind.wall_at * len(poses))
    here, on = poses[at], at + blind.onward
    scene = SolidScene(walk.world().objects)
    ends = _bare_wall(walk, scene, here, blind)
    before_wall = _between(*ends, round(blind.wall_s * fps))
    there, back = (_quick(a, b, fps, blind) for a, b in ((here, ends[0]), (ends[1], poses[on])))
    detour = np.concatenate([there, before_wall, back])
    names = [TURN] * len(there) + [WALL] * len(before_wall) + [TURN] * len(back)
    dark_from = round(blind.dark_at * len(poses))
    rest = [DARK if 0 <= k - dark_from < round(blind.dark_s * fps) else WALKED for k in range(on + 1, len(poses))]
    T = np.concatenate([poses[: at + 1], detour, poses[on + 1 :]])
    return BlindWalk(np.arange(len(T)) / fps, T, (*[WALKED] * (at + 1), *names, *rest), blind.exposure_s)


def exposed(T_world_cam: Array, k: int, fps: float, exposure_s: float, count: int = 7) -> list[Array]:
    """Return the poses during the exposure of frame k. Shape (4, 4) each."""
    before, T, after = (T_world_cam[min(max(j, 0), len(T_world_cam) - 1)] for j in (k - 1, k, k + 1))
    shares = np.linspace(-0.5, 0.5, count) * exposure_s * fps
    return [_mixed(T, before if s < 0 else after, abs(s)) for s in shares]


def _bare_wall(walk: WalkSettings, scene: SolidScene, here: Array, blind: BlindSettings) -> tuple[Array, Array]:
    """Return the first and last pose before the wall: the nearest ones that see nothing but it, by a free way."""
    world, camera = walk.world(), Camera(*(side // 8 for side in walk.size), *_small(walk.camera()))
    renderer, eye = Renderer(world, camera), here[:3, 3]
    walls = {t.id for t in world.objects if t.structure == "wall"}
    room = min(world.rooms, key=lambda r: abs((r.x0 + r.x1) / 2 - eye[0]))
    off = blind.wall_m
    sides = [((0.0, -1.0), -90.0), ((0.0, 1.0), 90.0), ((-1.0, 0.0), 180.0), ((1.0, 0.0), 0.0)]
    found = []
    for (way, yaw_deg), share in product(sides, np.arange(0.1, 0.91, 0.05)):
        along = np.array([-way[1], way[0], 0.0])
        x = room.x0 + share * (room.x1 - room.x0) if way[0] == 0 else (room.x0 + off if way[0] < 0 else room.x1 - off)
        y = share * room.depth if way[1] == 0 else (off if way[1] < 0 else room.depth - off)
        places = [np.array([x, y, eye[2]]) + s * blind.along_m * along for s in (-0.5, 0.5)]
        T = viewing_poses(np.array(places), *(np.array([a, a]) for a in (np.radians(yaw_deg), 0.0, 0.0)))
        seen = {int(i) for pose in T for i in np.unique(renderer.render(pose).ids)}
        if len(seen) == 1 and seen <= walls and all(_free(scene, eye, place) for place in places):
            found.append((float(np.linalg.norm(places[0] - eye)), len(found), T))
    if not found:
        raise ValueError(f"walk of seed {walk.seed}: no bare wall can be reached to turn aside to")
    _, _, T = min(found, key=lambda row: row[:2])
    return T[0], T[1]


def _free(scene: SolidScene, start: Array, end: Array) -> bool:
    """Whether nothing is on the straight way."""
    low, high = scene.corners.min(axis=1) - 0.05, scene.corners.max(axis=1) + 0.05
    points = start + np.linspace(0, 1, 40)[:, None] * (end - start)
    inside = (points[:, None] > low) & (points[:, None] < high)
    return not inside.all(axis=2).any()


def _small(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx / 8, camera.fy / 8, camera.cx / 8, camera.cy / 8


def _quick(start: Array, end: Array, fps: float, blind: BlindSettings) -> Array:
    """Poses between two, both excluded: it speeds up, and slows down. Shape (F, 4, 4)."""
    turn = np.degrees(abs(_turned(_angles(end)[0] - _angles(start)[0])))
    way = float(np.linalg.norm(end[:3, 3] - start[:3, 3]))
    lasts_s = 1.5 * max(turn / blind.turn_deg_s, way / blind.step_m_s)
    share = np.linspace(0.0, 1.0, round(lasts_s * fps) + 1)[1:-1]
    return np.array([_mixed(start, end, s) for s in 3 * share**2 - 2 * share**3]).reshape(-1, 4, 4)


def _between(start: Array, end: Array, count: int) -> Array:
    return np.array([_mixed(start, end, s) for s in np.linspace(0.0, 1.0, count)])


def _mixed(start: Array, end: Array, share: float) -> Array:
    """Return the pose at a share of the way, turned as a person turns: by yaw, pitch and roll. Shape (4, 4)."""
    a, b = _angles(start), _angles(end)
    place = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
    return np.asarray(viewing_poses(place[None], *(np.array([v]) for v in a + share * _turned(b - a)))[0])


def _angles(T_world_cam: Array) -> Array:
    """Yaw, pitch and roll of `viewing_poses`, radians. Shape (3,)."""
    forward = T_world_cam[:3, 2]
    yaw, pitch = np.arctan2(forward[1], forward[0]), np.arcsin(np.clip(forward[2], -1.0, 1.0))
    level = viewing_poses(np.zeros((1, 3)), np.array([yaw]), np.array([pitch]), np.zeros(1))[0]
    right = T_world_cam[:3, 0]
    return np.array([yaw, pitch, np.arctan2(right @ level[:3, 1], right @ level[:3, 0])])


def _turned(angle: Array) -> Array:
    """Return angles brought to (-pi, pi]."""
    return np.asarray(-((np.pi - angle) % (2 * np.pi) - np.pi))
