"""A building: rooms on both sides of a corridor, joined by doorways; two rooms may be copies of one plan (twins)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.simulation.furnisher import HALF_WALL_M, Door, RoomPlan, door_middle, make_catalogue, moved
from benchmarks.simulation.rooms import make_room
from list3r.simulation.worlds.layout import Placer, SimulatedRoom
from list3r.simulation.worlds.objects import SimulatedObject
from list3r.simulation.worlds.world import SimulatedWorld

_GAP_M = 2 * HALF_WALL_M
_LINK_AT_M = 1.1
"""Where doorways between neighbouring rooms are, metres from the corridor's wall."""


@dataclass(frozen=True)
class BuildingSettings:
    """Which rooms a building has."""

    north: tuple[str, ...]
    """Kinds of the rooms north of the corridor from west to east. Rooms of a kind with the same `#name` are twins,
    equal in everything but their place."""
    south: tuple[str, ...] = ()
    """Kinds south of the corridor; these rooms are turned by 180 degrees."""
    linked: bool = False
    """Neighbours of a row have a doorway between them."""
    corridor_m: tuple[float, float] = (1.6, 2.2)
    """Bounds of the corridor's width."""
    width_m: tuple[float, float] = (3.6, 5.0)
    """Bounds of the rooms' extent along the corridor."""
    depth_m: tuple[float, float] = (3.6, 4.8)
    """Bounds of their extent away from it."""
    clutter: float = 1.0
    corridor_clutter: float = 1.0
    closed_doors: int = 0
    """Doors on the corridor's walls that lead nowhere."""
    length_m: float = 0.0
    """Least length of the corridor."""


@dataclass(frozen=True)
class PlacedRoom:
    """A room at its place."""

    kind: str
    twin: str
    """Name that it shares with its twins, empty for none."""
    x0: float
    y0: float
    x1: float
    y1: float
    turn: float
    """Radians from the room's own axes to the world's."""
    objects: tuple[int, ...]
    """Ids."""
    doorways: tuple[tuple[float, float], ...]
    """Middles of its open doors, world."""

    def center(self) -> tuple[float, float]:
        """Middle of the floor."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    def contains(self, x: float, y: float) -> bool:
        """Whether a place is in the room."""
        return self.x0 <= x <= self.x1 and self.y0 <= y <= self.y1


@dataclass(frozen=True)
class Building:
    """A world with its rooms by name."""

    world: SimulatedWorld
    corridor: PlacedRoom
    north: tuple[PlacedRoom, ...]
    south: tuple[PlacedRoom, ...]

    def rooms(self) -> tuple[PlacedRoom, ...]:
        """All rooms, the corridor last."""
        return (*self.north, *self.south, self.corridor)

    def room_at(self, x: float, y: float) -> PlacedRoom | None:
        """The room of a place, None in a doorway."""
        return next((room for room in self.rooms() if room.contains(x, y)), None)


def make_building(settings: BuildingSettings, seed: int) -> Building:
    """The building of a seed: sizes, doors, furniture and colours are drawn from it."""
    rng = np.random.default_rng([seed, 21])
    catalogue = make_catalogue(Placer(rng))
    corridor_width = float(rng.uniform(*settings.corridor_m))
    drawn: dict[str, tuple[RoomPlan, tuple[SimulatedObject, ...]]] = {}
    objects: list[SimulatedObject] = []
    rows: list[tuple[PlacedRoom, ...]] = []
    for kinds, south in ((settings.north, False), (settings.south, True)):
        x, row = 0.0, []
        for k, name in enumerate(kinds):
            if name not in drawn or "#" not in name:
                links = (settings.linked and k > 0, settings.linked and k < len(kinds) - 1)
                plan = _plan(rng, settings, name, links[::-1] if south else links)
                drawn[name] = plan, make_room(Placer(rng), plan, catalogue)
            plan, parts = drawn[name]
            row.append(_place(objects, name, plan, parts, x, corridor_width, south))
            x += plan.width + _GAP_M
        rows.append(tuple(row))
    length = max([settings.length_m, *(room.x1 for row in rows for room in row)])
    plan = _corridor_plan(rng, settings, length, corridor_width, rows)
    corridor = _place(objects, "corridor", plan, make_room(Placer(rng), plan, catalogue), 0.0, None, False)
    rooms = tuple(SimulatedRoom(r.x0, r.x1, r.y1 - r.y0, r.turn != 0, r.y0) for row in rows for r in row)
    rooms += (SimulatedRoom(corridor.x0, corridor.x1, corridor_width, False),)
    return Building(SimulatedWorld(seed, rooms, tuple(objects), ()), corridor, rows[0], rows[1])


def _plan(rng: np.random.Generator, settings: BuildingSettings, name: str, links: tuple[bool, bool]) -> RoomPlan:
    """Size and doors; `links`: whether a doorway leads to the neighbour in the west and in the east of its own axes."""
    width, depth = float(rng.uniform(*settings.width_m)), float(rng.uniform(*settings.depth_m))
    doors = [Door("south", float(rng.uniform(0.75, width - 0.75)))]
    doors += [Door(side, _LINK_AT_M) for side, linked in zip(("west", "east"), links, strict=True) if linked]
    return RoomPlan(name.split("#")[0], width, depth, tuple(doors), settings.clutter, int(rng.integers(1, 3)))


def _corridor_plan(
    rng: np.random.Generator,
    settings: BuildingSettings,
    length: float,
    width: float,
    rows: list[tuple[PlacedRoom, ...]],
) -> RoomPlan:
    doors = [
        Door(side, x)
        for side, row in zip(("north", "south"), rows, strict=True)
        for r in row
        for x, _ in r.doorways[:1]
    ]
    for _ in range(settings.closed_doors):
        side, at = ("north", "south")[int(rng.integers(2))], float(rng.uniform(0.8, length - 0.8))
        if all(d.side != side or abs(d.at - at) > 1.4 for d in doors):
            doors.append(Door(side, at, closed=True))
    return RoomPlan("corridor", length, width, tuple(doors), settings.corridor_clutter, 0)


def _place(
    objects: list[SimulatedObject],
    name: str,
    plan: RoomPlan,
    parts: tuple[SimulatedObject, ...],
    x: float,
    corridor_width: float | None,
    south: bool,
) -> PlacedRoom:
    """Add a room's objects to the building: north of the corridor, south of it and turned, or as the corridor."""
    if corridor_width is None:
        origin, turn = (0.0, 0.0), 0.0
    elif south:
        origin, turn = (x + plan.width, -_GAP_M), float(np.pi)
    else:
        origin, turn = (x, corridor_width + _GAP_M), 0.0
    offset = len(objects)
    placed = [moved(obj, *origin, turn, offset) for obj in parts]
    objects += placed
    sign = -1.0 if south else 1.0
    corners = sorted([origin[0], origin[0] + sign * plan.width]), sorted([origin[1], origin[1] + sign * plan.depth])
    local = [door_middle(plan, door) for door in plan.doors if not door.closed]
    doorways = tuple((origin[0] + sign * a, origin[1] + sign * b) for a, b in local)
    kind, _, twin = name.partition("#")
    (x0, x1), (y0, y1) = corners
    return PlacedRoom(kind, twin, x0, y0, x1, y1, turn, tuple(t.id for t in placed), doorways)


def appearance_classes(objects: tuple[SimulatedObject, ...]) -> dict[int, int]:
    """Class of appearance of each object, from its label and parts: copies share one, wherever they are."""
    classes: dict[object, int] = {}
    return {t.id: classes.setdefault((t.label, t.parts), len(classes)) for t in objects}
