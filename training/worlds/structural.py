"""Structure that looks like things: pillars, niches, ledges, beams, steps, half walls, walls with openings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from training.worlds.draft import Draft
from training.worlds.materials import Material, Palette
from training.worlds.mesh import Mesh, box, cylinder
from training.worlds.room import Placed, Room, flat_pose

FIRST_WALL = 2
"""Place of the first wall among the things of a room, after floor and ceiling."""


@dataclass(frozen=True)
class Niche:
    """A recess of a wall, open to the room."""

    wall: int
    along: float
    """Middle along the wall, metres."""
    width: float
    height: float
    depth: float
    """From its back to the wall's new front."""


@dataclass(frozen=True)
class Opening:
    """A rectangle cut out of a wall, seen from the room."""

    wall: int
    along: float
    """Middle along the wall, metres."""
    width: float
    low: float
    """Height of its lower edge, metres."""
    top: float
    depth: float
    """How far back what closes it lies behind the face of the wall, metres."""


def free_opening(room: Room, name: str) -> Opening | None:
    """Return a bare rectangle of a wall for a window or niche, a "door", a "shelf" or a "wide" window, and take it."""
    rng, high = room.rng, room.size[2]
    number = int(rng.integers(4))
    length = room.wall_length(number)
    width = float(rng.uniform(0.5, 2.4))
    low, top = float(rng.uniform(0.25, 1.1)), float(rng.uniform(1.7, high - 0.1))
    if name == "door" or (name == "shelf" and rng.random() < 0.5):
        low, top = 0.0, float(rng.uniform(1.95, min(2.4, high - 0.05)))
        width = float(rng.uniform(0.75, 2.2))
    if name == "wide":
        low, width = float(rng.uniform(0.0, 1.0)), length - float(rng.uniform(0.05, 0.8))
        top = high - float(rng.uniform(0.03, 0.4))
    if width > length - 0.04:
        return None
    along = float(rng.uniform(width / 2 + 0.02, length - width / 2 - 0.02))
    span = along - width / 2, along + width / 2
    if not room.wall_free(number, span, (0.0, high)):
        return None
    room.wall_free(number, span, (low, top), take=True)
    depth = rng.uniform(0.15, 0.5) if name == "shelf" else rng.uniform(0.03, 0.4) ** 1.3
    return Opening(number, along, width, low, top, float(depth))


def wall_behind(room: Room, opening: Opening, material: Material) -> None:
    """Close an opening with wall."""
    mesh = box((opening.width, 0.1, opening.top - opening.low))
    pose = room.wall_pose(opening.wall, opening.along, -opening.depth - 0.05, opening.low)
    room.things.append(
        Placed(len(room.things) + 1, "wall", "wall", "structure", ((mesh, material),), pose, structure=True)
    )


def open_walls(room: Room, openings: Sequence[Opening]) -> None:
    """Cut openings, apart from each other along each wall, out of the walls of a room."""
    high = room.size[2]
    for number in sorted({o.wall for o in openings}):
        here = sorted((o for o in openings if o.wall == number), key=lambda o: o.along)
        thick, edge = max(o.depth for o in here), 0.0
        pieces = []
        for o in here:
            low, upper = o.along - o.width / 2, o.along + o.width / 2
            pieces += [(edge, low, 0.0, high), (low, upper, 0.0, o.low), (low, upper, o.top, high)]
            edge = upper
        pieces.append((edge, room.wall_length(number), 0.0, high))
        whole = room.things[FIRST_WALL + number]
        for a, b, z, end in pieces:
            if b - a < 1e-6 or end - z < 1e-6:
                continue
            pose = room.wall_pose(number, (a + b) / 2, -thick / 2, z)
            part = replace(whole, parts=((box((b - a, thick, end - z)), whole.parts[0][1]),), T_world_thing=pose)
            if room.things[FIRST_WALL + number] is whole:
                room.things[FIRST_WALL + number] = part
            else:
                room.things.append(replace(part, id=len(room.things) + 1))


def build_structure(room: Room, palette: Palette, wall: Material) -> list[Niche]:
    """Put structure of several kinds into an empty room, and return the niches that it leaves."""
    rng = room.rng
    niches = [n for n in (_niche(room, wall, palette) for _ in range(int(rng.integers(0, 3)))) if n is not None]
    for build, share in ((_pillar, 0.3), (_pilaster, 0.35), (_beam, 0.3), (_step, 0.2), (_half_wall, 0.2)):
        if rng.random() < share:
            build(room, wall if rng.random() < 0.7 else palette.wall())
    return niches


def _stand(room: Room, mesh: Mesh, material: Material, pose: NDArray[np.float64], label: str = "wall") -> bool:
    """Add a piece of structure where nothing stands yet."""
    draft = Draft(room.rng, Palette(room.rng, held_out=False))
    draft.add(mesh, material)
    if not room.fits(draft, pose):
        return False
    room.place(label, label, "structure", draft, pose)
    last = room.things.pop()
    room.things.append(Placed(last.id, label, label, "structure", last.parts, last.T_world_thing, True))
    return True


def _niche(room: Room, wall: Material, palette: Palette) -> Niche | None:
    """Line a wall with a second one before it that leaves a recess."""
    rng, number = room.rng, int(room.rng.integers(4))
    length, high = room.wall_length(number), room.size[2]
    depth, width = float(rng.uniform(0.12, 0.6)), float(rng.uniform(0.7, min(2.6, length - 0.9)))
    top = high - 0.02 if rng.random() < 0.35 else float(rng.uniform(1.6, high - 0.15))
    middle = float(rng.uniform(width / 2 + 0.25, length - width / 2 - 0.25))
    low, upper = middle - width / 2, middle + width / 2
    if not room.wall_free(number, (0.0, length), (0.0, high)):
        return None
    pieces = [(low / 2, low, 0.0, high), ((upper + length) / 2, length - upper, 0.0, high)]
    if top < high - 0.05:
        pieces.append((middle, width, top, high))
    for x, w, z, end in pieces:
        mesh = box((w - 0.004, depth - 0.004, end - z - 0.004), (0, 0, 0))
        if not _stand(room, mesh, wall, room.wall_pose(number, x, depth / 2, z + 0.002)):
            return None
        room.wall_free(number, (x - w / 2, x + w / 2), (z, end), take=True)
    return Niche(number, middle, width, top, depth)


def _pillar(room: Room, wall: Material) -> None:
    """A pillar, round or square, free in the room."""
    rng, (w, deep, h) = room.rng, room.size
    side = float(rng.uniform(0.18, 0.5))
    mesh = cylinder(side / 2, h - 0.01, sides=24) if rng.random() < 0.4 else box((side, side, h - 0.01))
    spot = flat_pose(float(rng.uniform(0.8, w - 0.8)), float(rng.uniform(0.8, deep - 0.8)), float(rng.normal(0, 0.02)))
    _stand(room, mesh, wall, spot)


def _pilaster(room: Room, wall: Material) -> None:
    """A chimney breast or half a pillar at a wall."""
    rng, number, h = room.rng, int(room.rng.integers(4)), room.size[2]
    width, depth = float(rng.uniform(0.25, 1.4)), float(rng.uniform(0.08, 0.5))
    x = float(rng.uniform(width / 2 + 0.02, room.wall_length(number) - width / 2 - 0.02))
    if room.wall_free(number, (x - width / 2, x + width / 2), (0, h)):
        mesh = box((width, depth - 0.004, h - 0.01))
        if _stand(room, mesh, wall, room.wall_pose(number, x, depth / 2)):
            room.wall_free(number, (x - width / 2, x + width / 2), (0, h), take=True)


def _beam(room: Room, wall: Material) -> None:
    """A beam below the ceiling, across the room or along a wall."""
    rng, (w, deep, h) = room.rng, room.size
    tall, thick = float(rng.uniform(0.12, 0.35)), float(rng.uniform(0.12, 0.5))
    at = float(rng.uniform(thick / 2 + 0.01, deep - thick / 2 - 0.01))
    if rng.random() < 0.5:
        at = thick / 2 + 0.003
    _stand(room, box((w - 0.01, thick, tall)), wall, flat_pose(w / 2, at, 0.0, h - tall - 0.005), "ceiling")


def _step(room: Room, wall: Material) -> None:
    """A step in the floor along a wall."""
    rng, (w, deep, _) = room.rng, room.size
    tall, wide = float(rng.uniform(0.08, 0.22)), float(rng.uniform(0.4, 1.1))
    _stand(room, box((w - 0.01, wide, tall)), wall, flat_pose(w / 2, deep - wide / 2 - 0.005, 0.0), "floor")


def _half_wall(room: Room, wall: Material) -> None:
    """A wall out into the room, half as high or up to the ceiling."""
    rng, number, h = room.rng, int(room.rng.integers(4)), room.size[2]
    thick, out = float(rng.uniform(0.08, 0.2)), float(rng.uniform(0.5, 1.2))
    tall = h - 0.01 if rng.random() < 0.5 else float(rng.uniform(0.85, 1.3))
    x = float(rng.uniform(0.6, room.wall_length(number) - 0.6))
    if room.wall_free(number, (x - thick / 2, x + thick / 2), (0, h)):
        mesh = box((thick, out, tall))
        if _stand(room, mesh, wall, room.wall_pose(number, x, out / 2 + 0.003)):
            room.wall_free(number, (x - thick / 2, x + thick / 2), (0, h), take=True)
