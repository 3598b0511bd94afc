"""A seeded world: two furnished rooms joined by a doorway, z up, metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.layout import (
    WOODS,
    Placer,
    SimulatedRoom,
    furnish_bedroom,
    furnish_living_room,
    wall_paint,
)
from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.objects import SimulatedObject, Vec3

WALL_M = 0.10
DOOR_M = (0.95, 2.05)
"""Width and height of the doorway."""
HEIGHT_M = 2.5


@dataclass(frozen=True)
class Stop:
    """The camera's position and the point it looks at, world, metres."""

    eye: Vec3
    target: Vec3


@dataclass(frozen=True)
class SimulatedWorld:
    """Rooms, objects, lamps, and a way through."""

    seed: int
    rooms: tuple[SimulatedRoom, ...]
    objects: tuple[SimulatedObject, ...]
    tour: tuple[Stop, ...]
    """A round through both rooms that comes back to where it starts."""

    def object_of(self, object_id: int) -> SimulatedObject:
        """Return the object of an id. Raises `KeyError`."""
        return {t.id: t for t in self.objects}[object_id]


def make_world(seed: int = 0) -> SimulatedWorld:
    """Return the world of a seed: sizes, colours, mirroring and small objects are drawn from it."""
    rng = np.random.default_rng([seed, 1])
    depth = 3.8
    living = SimulatedRoom(0.0, 4.0, depth, bool(rng.integers(2)))
    bedroom = SimulatedRoom(4.0 + WALL_M, 4.0 + WALL_M + 3.8, depth, bool(rng.integers(2)))
    placer = Placer(rng)
    floors, walls = _shell(placer, (living, bedroom))
    furnish_living_room(placer, living, walls[0], floors[0])
    furnish_bedroom(placer, bedroom, walls[1], floors[1])
    return SimulatedWorld(seed, (living, bedroom), tuple(placer.objects), _tour(living, bedroom))


def _shell(p: Placer, rooms: tuple[SimulatedRoom, SimulatedRoom]) -> tuple[list[int], list[dict[str, int]]]:
    """Floors, ceilings and walls; the ids of the floors and, for each room, of its walls by direction."""
    floors: list[int] = []
    walls: list[dict[str, int]] = []
    for room in rooms:
        floors.append(_floor(p, room))
        paint = wall_paint(p)
        sides = {}
        middle, width = (room.x0 + room.x1) / 2, room.x1 - room.x0 + WALL_M
        for name, y in (("south", -WALL_M / 2), ("north", room.depth + WALL_M / 2)):
            slab = f.flat((width, WALL_M, HEIGHT_M), (middle, y, HEIGHT_M / 2), paint)
            sides[name] = p.add_structure("wall", slab).id
        walls.append(sides)
        roof = Material("plaster", (236, 234, 228), (222, 220, 214), 1.5)
        slab = f.flat((width, room.depth, WALL_M), (middle, room.depth / 2, HEIGHT_M + WALL_M / 2), roof)
        p.add_structure("ceiling", slab)
    for k, (name, x) in enumerate((("west", -WALL_M / 2), ("east", rooms[1].x1 + WALL_M / 2))):
        depth = rooms[k].depth
        slab = f.flat((WALL_M, depth + 2 * WALL_M, HEIGHT_M), (x, depth / 2, HEIGHT_M / 2), wall_paint(p))
        walls[k][name] = p.add_structure("wall", slab).id
    p.add_structure("wall", _dividing_wall(p, rooms[0]))
    return floors, walls


def _floor(p: Placer, room: SimulatedRoom) -> int:
    low, high = WOODS[int(p.rng.integers(len(WOODS)))]
    boards = Material("wood", low, high, 1.1, int(p.rng.integers(1 << 16)))
    size = (room.x1 - room.x0 + WALL_M, room.depth, WALL_M)
    return p.add_structure("floor", f.flat(size, ((room.x0 + room.x1) / 2, room.depth / 2, -WALL_M / 2), boards)).id


def _dividing_wall(p: Placer, room: SimulatedRoom) -> f.Parts:
    """Return the wall with the doorway in its middle and a wooden frame round it."""
    paint, trim = wall_paint(p), p.wood(0.7)
    x, (wide, high) = room.x1 + WALL_M / 2, DOOR_M
    pier = (room.depth - wide) / 2
    posts = [
        f.block((WALL_M + 0.03, 0.07, high), (x, room.depth / 2 + s * (wide / 2 + 0.03), high / 2), trim)
        for s in (-1, 1)
    ]
    return (
        f.block((WALL_M, pier, HEIGHT_M), (x, pier / 2, HEIGHT_M / 2), paint),
        f.block((WALL_M, pier, HEIGHT_M), (x, room.depth - pier / 2, HEIGHT_M / 2), paint),
        f.block((WALL_M, wide, HEIGHT_M - high), (x, room.depth / 2, (HEIGHT_M + high) / 2), paint),
        *posts,
        f.block((WALL_M + 0.03, wide + 0.13, 0.07), (x, room.depth / 2, high + 0.03), trim),
    )


def _tour(living: SimulatedRoom, bedroom: SimulatedRoom) -> tuple[Stop, ...]:
    """Stops in room coordinates (eye x, y; target x, y, z), turned to the world."""
    first = (
        (3.0, 1.85, 3.4, 0.30, 0.55),
        (2.95, 1.75, 2.6, 0.35, 0.55),
        (2.85, 1.60, 1.4, 0.45, 0.55),
        (2.65, 1.55, 0.2, 1.50, 0.80),
        (2.45, 1.85, 1.4, 2.75, 0.72),
        (2.50, 2.00, 1.6, 2.75, 0.74),
        (2.80, 1.90, 3.2, 3.60, 0.80),
        (3.30, 1.90, 6.0, 1.90, 0.90),
    )
    second = (
        (0.45, 1.85, 1.4, 0.35, 0.70),
        (0.95, 1.60, 1.4, 0.35, 0.74),
        (1.30, 1.60, 3.3, 0.25, 0.74),
        (1.25, 1.80, 3.0, 2.30, 0.45),
        (1.35, 2.10, 3.5, 3.40, 0.55),
        (1.30, 1.90, 1.8, 3.45, 0.30),
        (1.15, 1.90, 0.7, 3.50, 1.00),
        (0.70, 1.90, -1.5, 2.30, 0.80),
    )
    third = ((3.30, 1.90, 1.6, 2.75, 0.74), (3.00, 1.80, 0.2, 1.60, 0.80), (2.90, 1.65, 1.4, 0.45, 0.55))
    stops = [(living, s) for s in first] + [(bedroom, s) for s in second] + [(living, s) for s in third]
    return tuple(_stop(room, s) for room, s in stops)


def _stop(room: SimulatedRoom, numbers: tuple[float, float, float, float, float]) -> Stop:
    ex, ey, tx, ty, tz = numbers
    eye, target = room.world_xy(ex, ey), room.world_xy(tx, ty)
    return Stop((*eye, 1.5), (*target, tz))
