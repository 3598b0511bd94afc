"""Puts groups of objects into a room: along its walls or in the open, never in a doorway."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.layout import Placer, SimulatedRoom
from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.objects import SimulatedObject

HALF_WALL_M = 0.05
"""Every room has its own half of each wall."""
DOOR_WIDTH_M = 0.95
DOOR_HEIGHT_M = 2.05
HEIGHT_M = 2.5
HERE = SimulatedRoom(0.0, 1.0, 1.0, False)
"""Coordinates as they are: the frame of a group, or of a room."""
SIDES = ("south", "east", "north", "west")


@dataclass(frozen=True)
class Door:
    """An opening in a wall of a room."""

    side: str
    """south (y = 0), east, north or west."""
    at: float
    """Middle of the opening along the wall, metres from the room's origin."""
    closed: bool = False
    """A door leaf instead of a way through."""


@dataclass(frozen=True)
class RoomPlan:
    """Specification of a room."""

    kind: str
    """A key of `rooms.KINDS`."""
    width: float
    depth: float
    doors: tuple[Door, ...]
    clutter: float = 1.0
    """Share of the small objects that are put in."""
    windows: int = 1


def door_middle(plan: RoomPlan, door: Door) -> tuple[float, float]:
    """The middle of an opening on the outer face of its wall, in the room's coordinates."""
    t = HALF_WALL_M
    return {
        "south": (door.at, -t),
        "north": (door.at, plan.depth + t),
        "west": (-t, door.at),
        "east": (plan.width + t, door.at),
    }[door.side]


@dataclass(frozen=True)
class Catalogue:
    """Models that a building has many of: these objects have one appearance everywhere."""

    chair: f.Parts
    office_chair: f.Parts
    desk: f.Parts
    monitor: f.Parts
    mug: f.Parts
    carton: f.Parts
    leaf: f.Parts
    """A closed door."""


def make_catalogue(p: Placer) -> Catalogue:
    """The models that repeat in a building."""
    rng = p.rng
    dark = Material("plain", (36, 38, 42), (70, 72, 78), 0.4)
    leaf = f.block((DOOR_WIDTH_M, 0.03, DOOR_HEIGHT_M), (0, 0.015, DOOR_HEIGHT_M / 2), p.wood(0.9))
    knob = f.globe(0.03, (DOOR_WIDTH_M / 2 - 0.08, 0.06, 1.0), dark)
    return Catalogue(
        chair=f.chair(p.wood(), p.fabric(), float(rng.uniform(0.42, 0.46))),
        office_chair=_office_chair(dark, p.fabric()),
        desk=f.table((float(rng.uniform(1.2, 1.4)), 0.68, 0.74), p.wood(1.1), 0.05),
        monitor=f.monitor(float(rng.uniform(0.46, 0.56)), dark, p.bright("print", 0.6)),
        mug=p.small("mug")[0],
        carton=f.carton((0.36, 0.28, 0.26), Material("plain", (176, 132, 88), (214, 176, 130), 0.3), p.wood(0.3)),
        leaf=(leaf, knob),
    )


def _office_chair(metal: Material, cloth: Material) -> f.Parts:
    star = [f.block((0.56, 0.05, 0.05), (0, 0, 0.04), metal, k * np.pi / 3) for k in range(3)]
    return (
        *star,
        f.pillar(0.03, 0.36, (0, 0, 0.06), metal),
        f.block((0.48, 0.46, 0.07), (0, 0, 0.455), cloth),
        f.block((0.44, 0.05, 0.46), (0, -0.22, 0.78), cloth),
    )


@dataclass
class Furnisher:
    """Puts groups of objects into one room: along its walls or in the open, never in a doorway."""

    p: Placer
    plan: RoomPlan
    catalogue: Catalogue
    taken: list[tuple[float, float, float, float]]
    """Footprints x0, y0, x1, y1 that are not free."""
    walls: dict[str, int]

    def along_wall(self, group: Callable[[Furnisher], tuple[float, float]], sides: tuple[str, ...] = SIDES) -> bool:
        """Build a group with its back to a wall; false when there is no room for it, and then nothing is built."""
        first = len(self.p.objects)
        width, depth = group(self)
        for _ in range(40):
            side = sides[self.p.rng.integers(len(sides))]
            long = self.plan.width if side in ("south", "north") else self.plan.depth
            if long < width + 0.04:
                continue
            at = float(self.p.rng.uniform(width / 2 + 0.02, long - width / 2 - 0.02))
            x, y, yaw = self.against(side, at, 0.01)
            if self._claim(footprint(x, y, yaw, width, depth)):
                self._move(first, x, y, yaw)
                return True
        del self.p.objects[first:]
        return False

    def in_the_open(self, group: Callable[[Furnisher], tuple[float, float]], off_m: float = 0.6) -> bool:
        """Build a group near the middle of the room."""
        first = len(self.p.objects)
        width, depth = group(self)
        for k in range(40):
            yaw = float(self.p.rng.integers(4)) * 90.0
            off = self.p.rng.uniform(-off_m, off_m, 2) * (1 + k / 20)
            x, y = float(self.plan.width / 2 + off[0]), float(self.plan.depth / 2 + off[1])
            turned = np.deg2rad(yaw)
            back = (x + np.sin(turned) * depth / 2, y - np.cos(turned) * depth / 2)
            spot = footprint(*back, yaw, width, depth)
            inside = spot[0] > 0.5 and spot[1] > 0.5
            inside = inside and spot[2] < self.plan.width - 0.5 and spot[3] < self.plan.depth - 0.5
            if inside and self._claim(spot):
                self._move(first, *back, yaw)
                return True
        del self.p.objects[first:]
        return False

    def on_wall(self, label: str, parts: f.Parts, width: float, z: float, sides: tuple[str, ...] = SIDES) -> None:
        """Hang something on a wall next to the doors."""
        for _ in range(20):
            side = sides[self.p.rng.integers(len(sides))]
            long = self.plan.width if side in ("south", "north") else self.plan.depth
            if long < width + 0.2:
                continue
            at = float(self.p.rng.uniform(width / 2 + 0.1, long - width / 2 - 0.1))
            if any(d.side == side and abs(d.at - at) < (width + DOOR_WIDTH_M) / 2 + 0.15 for d in self.plan.doors):
                continue
            x, y, yaw = self.against(side, at, 0.0)
            spot = (side, at - width / 2, at + width / 2)
            if any(s == side and a < spot[2] and spot[1] < b for s, a, b in self._hung):
                continue
            self._hung.append(spot)
            self.p.add(HERE, label, parts, x, y, yaw, z=z, attached=self.walls[side])
            return

    def __post_init__(self) -> None:
        self._hung: list[tuple[str, float, float]] = []

    def against(self, side: str, at: float, gap: float) -> tuple[float, float, float]:
        """Place and yaw (degrees) of an object with its back to a wall."""
        w, d = self.plan.width, self.plan.depth
        return {
            "south": (at, gap, 0.0),
            "north": (at, d - gap, 180.0),
            "west": (gap, at, -90.0),
            "east": (w - gap, at, 90.0),
        }[side]

    def _claim(self, spot: tuple[float, float, float, float]) -> bool:
        if any(
            spot[0] < b[2] + 0.06 and b[0] < spot[2] + 0.06 and spot[1] < b[3] + 0.06 and b[1] < spot[3] + 0.06
            for b in self.taken
        ):
            return False
        self.taken.append(spot)
        return True

    def _move(self, first: int, x: float, y: float, yaw_deg: float) -> None:
        self.p.objects[first:] = [moved(t, x, y, np.deg2rad(yaw_deg)) for t in self.p.objects[first:]]


def moved(obj: SimulatedObject, x: float, y: float, yaw: float, id_offset: int = 0) -> SimulatedObject:
    """The object after a turn about the origin and a shift; its id and the ids it refers to rise by `id_offset`."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    px, py, pz = obj.position
    at = (x + c * px - s * py, y + s * px + c * py, pz)
    support, container, attached = (
        None if other is None else other + id_offset for other in (obj.support, obj.container, obj.attached)
    )
    return replace(
        obj,
        id=obj.id + id_offset,
        position=at,
        yaw=float(obj.yaw + yaw),
        support=support,
        container=container,
        attached=attached,
    )


def footprint(x: float, y: float, yaw_deg: float, width: float, depth: float) -> tuple[float, float, float, float]:
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    corners = [(i * width / 2, j * depth) for i in (-1, 1) for j in (0, 1)]
    xs, ys = [x + c * a - s * b for a, b in corners], [y + s * a + c * b for a, b in corners]
    return float(min(xs)), float(min(ys)), float(max(xs)), float(max(ys))
