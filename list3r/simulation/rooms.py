"""Furnished rooms of several kinds, each in its own coordinates, so that one room can stand in a building twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from list3r.simulation import furniture as f
from list3r.simulation.layout import FABRICS, WOODS, Placer, Room
from list3r.simulation.materials import Material
from list3r.simulation.things import Thing

HALF_WALL_M = 0.05
"""Every room has its own half of each wall."""
DOOR_WIDTH_M = 0.95
DOOR_HEIGHT_M = 2.05
HEIGHT_M = 2.5
_HERE = Room(0.0, 1.0, 1.0, False)
"""Coordinates as they are: the frame of a group, or of a room."""
_SIDES = ("south", "east", "north", "west")


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
    """What a room is to be."""

    kind: str
    """A key of `KINDS`."""
    width: float
    depth: float
    doors: tuple[Door, ...]
    clutter: float = 1.0
    """Share of the small things that are put in."""
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
    """What a building has bought many of: these things look alike wherever they stand."""

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
    """Puts groups of things into one room: along its walls or in the open, never in a doorway."""

    p: Placer
    plan: RoomPlan
    catalogue: Catalogue
    taken: list[tuple[float, float, float, float]]
    """Footprints x0, y0, x1, y1 that are not free."""
    walls: dict[str, int]

    def along_wall(self, group: Callable[[Furnisher], tuple[float, float]], sides: tuple[str, ...] = _SIDES) -> bool:
        """Build a group with its back to a wall; false when there is no room for it, and then nothing is built."""
        first = len(self.p.things)
        width, depth = group(self)
        for _ in range(40):
            side = sides[self.p.rng.integers(len(sides))]
            long = self.plan.width if side in ("south", "north") else self.plan.depth
            if long < width + 0.04:
                continue
            at = float(self.p.rng.uniform(width / 2 + 0.02, long - width / 2 - 0.02))
            x, y, yaw = self._against(side, at, 0.01)
            if self._claim(_footprint(x, y, yaw, width, depth)):
                self._move(first, x, y, yaw)
                return True
        del self.p.things[first:]
        return False

    def in_the_open(self, group: Callable[[Furnisher], tuple[float, float]], off_m: float = 0.6) -> bool:
        """Build a group near the middle of the room."""
        first = len(self.p.things)
        width, depth = group(self)
        for k in range(40):
            yaw = float(self.p.rng.integers(4)) * 90.0
            off = self.p.rng.uniform(-off_m, off_m, 2) * (1 + k / 20)
            x, y = float(self.plan.width / 2 + off[0]), float(self.plan.depth / 2 + off[1])
            turned = np.deg2rad(yaw)
            back = (x + np.sin(turned) * depth / 2, y - np.cos(turned) * depth / 2)
            spot = _footprint(*back, yaw, width, depth)
            inside = spot[0] > 0.5 and spot[1] > 0.5
            inside = inside and spot[2] < self.plan.width - 0.5 and spot[3] < self.plan.depth - 0.5
            if inside and self._claim(spot):
                self._move(first, *back, yaw)
                return True
        del self.p.things[first:]
        return False

    def on_wall(self, label: str, parts: f.Parts, width: float, z: float, sides: tuple[str, ...] = _SIDES) -> None:
        """Hang something on a wall beside the doors."""
        for _ in range(20):
            side = sides[self.p.rng.integers(len(sides))]
            long = self.plan.width if side in ("south", "north") else self.plan.depth
            if long < width + 0.2:
                continue
            at = float(self.p.rng.uniform(width / 2 + 0.1, long - width / 2 - 0.1))
            if any(d.side == side and abs(d.at - at) < (width + DOOR_WIDTH_M) / 2 + 0.15 for d in self.plan.doors):
                continue
            x, y, yaw = self._against(side, at, 0.0)
            spot = (side, at - width / 2, at + width / 2)
            if any(s == side and a < spot[2] and spot[1] < b for s, a, b in self._hung):
                continue
            self._hung.append(spot)
            self.p.add(_HERE, label, parts, x, y, yaw, z=z, attached=self.walls[side])
            return

    def __post_init__(self) -> None:
        self._hung: list[tuple[str, float, float]] = []

    def _against(self, side: str, at: float, gap: float) -> tuple[float, float, float]:
        """Place and yaw (degrees) of what has its back to a wall."""
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
        self.p.things[first:] = [moved(t, x, y, np.deg2rad(yaw_deg)) for t in self.p.things[first:]]


def moved(thing: Thing, x: float, y: float, yaw: float, id_offset: int = 0) -> Thing:
    """The thing after a turn about the origin and a shift; its id and those it names rise by `id_offset`."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    px, py, pz = thing.position
    at = (x + c * px - s * py, y + s * px + c * py, pz)
    support, container, attached = (
        None if other is None else other + id_offset for other in (thing.support, thing.container, thing.attached)
    )
    return replace(
        thing,
        id=thing.id + id_offset,
        position=at,
        yaw=float(thing.yaw + yaw),
        support=support,
        container=container,
        attached=attached,
    )


def _footprint(x: float, y: float, yaw_deg: float, width: float, depth: float) -> tuple[float, float, float, float]:
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    corners = [(i * width / 2, j * depth) for i in (-1, 1) for j in (0, 1)]
    xs, ys = [x + c * a - s * b for a, b in corners], [y + s * a + c * b for a, b in corners]
    return float(min(xs)), float(min(ys)), float(max(xs)), float(max(ys))


# ------------------------------------------------------------------------------------------------ the shell


def make_room(p: Placer, plan: RoomPlan, catalogue: Catalogue) -> tuple[Thing, ...]:
    """All things of a room in its own coordinates: x from 0 to width, y from 0 to depth; ids from 1, the floor first.

    Colours, sizes and places are drawn from the placer's generator; its list of things must be empty.
    """
    assert not p.things
    walls = _shell(p, plan)
    clear = []
    for door in plan.doors:
        reach = 0.35 if door.closed else 1.0
        x, y, yaw = Furnisher(p, plan, catalogue, [], walls)._against(door.side, door.at, 0.0)
        clear.append(_footprint(x, y, yaw, DOOR_WIDTH_M + 0.1, min(reach, plan.depth - 0.05)))
        if door.closed:
            p.add(_HERE, "door", catalogue.leaf, x, y, yaw, attached=walls[door.side])
        else:
            p.add(_HERE, "door frame", _frame(p), x, y, yaw, attached=walls[door.side])
    furnisher = Furnisher(p, plan, catalogue, clear, walls)
    KINDS[plan.kind](furnisher)
    return tuple(p.things)


def _shell(p: Placer, plan: RoomPlan) -> dict[str, int]:
    """Floor, ceiling and four walls with their openings; ids of the walls by side."""
    w, d, t = plan.width, plan.depth, HALF_WALL_M
    low, high = WOODS[int(p.rng.integers(len(WOODS)))]
    kind = ("wood", "checker", "fabric")[int(p.rng.integers(3))]
    boards = Material(kind, low, high, float(p.rng.uniform(0.9, 1.4)), int(p.rng.integers(1 << 16)))
    size = (w + 2 * t, d + 2 * t, 2 * t)
    p.add_structure("floor", f.flat(size, (w / 2, d / 2, -t), boards))
    roof = Material("plaster", (236, 234, 228), (222, 220, 214), 1.5, int(p.rng.integers(1 << 16)))
    p.add_structure("ceiling", f.flat(size, (w / 2, d / 2, HEIGHT_M + t), roof))
    paint = _paint(p)
    walls = {}
    for side in _SIDES:
        openings = [door.at for door in plan.doors if door.side == side and not door.closed]
        walls[side] = p.add_structure("wall", _wall(plan, side, openings, paint)).id
    return walls


def _paint(p: Placer) -> Material:
    tints = ((222, 210, 188), (196, 208, 214), (206, 214, 196), (224, 202, 192), (212, 206, 216))
    r, g, b = tints[int(p.rng.integers(len(tints)))]
    return Material("plaster", (r, g, b), (r - 46, g - 44, b - 40), 1.3, int(p.rng.integers(1 << 16)))


def _wall(plan: RoomPlan, side: str, openings: list[float], paint: Material) -> f.Parts:
    """Slabs between the openings and above them."""
    lengthwise = side in ("south", "north")
    long = plan.width if lengthwise else plan.depth
    edges, parts = [-HALF_WALL_M if lengthwise else 0.0, long + (HALF_WALL_M if lengthwise else 0.0)], []
    spans, start = [], edges[0]
    for at in sorted(openings):
        spans.append((start, at - DOOR_WIDTH_M / 2, 0.0))
        spans.append((at - DOOR_WIDTH_M / 2, at + DOOR_WIDTH_M / 2, DOOR_HEIGHT_M))
        start = at + DOOR_WIDTH_M / 2
    spans.append((start, edges[1], 0.0))
    across = {
        "south": -HALF_WALL_M / 2,
        "north": plan.depth + HALF_WALL_M / 2,
        "west": -HALF_WALL_M / 2,
        "east": plan.width + HALF_WALL_M / 2,
    }[side]
    for a, b, base in spans:
        middle, size, z = (a + b) / 2, b - a, (base + HEIGHT_M) / 2
        if lengthwise:
            parts.append(f.block((size, HALF_WALL_M, HEIGHT_M - base), (middle, across, z), paint))
        else:
            parts.append(f.block((HALF_WALL_M, size, HEIGHT_M - base), (across, middle, z), paint))
    return tuple(parts)


def _frame(p: Placer) -> f.Parts:
    """Posts and lintel about an opening, of which half the wall's thickness is this room's."""
    trim, wide, deep = p.wood(0.7), DOOR_WIDTH_M, HALF_WALL_M + 0.02
    y = -HALF_WALL_M / 2 + 0.01
    posts = [f.block((0.07, deep, DOOR_HEIGHT_M), (s * (wide / 2 + 0.02), y, DOOR_HEIGHT_M / 2), trim) for s in (-1, 1)]
    return (*posts, f.block((wide + 0.11, deep, 0.07), (0, y, DOOR_HEIGHT_M + 0.02), trim))


# ------------------------------------------------------------------------------------------------ groups
# Each builds things about its own origin, back at y = 0, front towards +y, and returns its footprint (width, depth).


def _some(g: Furnisher, *kinds: str) -> tuple[str, ...]:
    return tuple(kind for kind in kinds if g.p.rng.uniform() < g.plan.clutter)


def _cabinet_group(
    label: str, width: float, depth: float, height: float, *tops: str
) -> Callable[..., tuple[float, float]]:
    def build(g: Furnisher) -> tuple[float, float]:
        w, h = width * g.p.rng.uniform(0.9, 1.1), height * g.p.rng.uniform(0.92, 1.08)
        parts = f.cabinet((w, depth, h), g.p.wood(), g.p.wood(0.6), max(1, round(w / 0.5)))
        body = g.p.add(_HERE, label, parts, 0.0, depth / 2, on=1)
        g.p.scatter(_HERE, body, _some(g, *tops), w, depth)
        return w, depth

    return build


def _shelf_group(g: Furnisher) -> tuple[float, float]:
    height, boards, w, d = float(g.p.rng.uniform(1.3, 1.9)), 4, float(g.p.rng.uniform(0.75, 1.0)), 0.32
    shelf = g.p.add(_HERE, "bookshelf", f.shelf((w, d, height), g.p.wood(), boards), 0.0, d / 2, on=1)
    for level in f.shelf_boards(height, boards)[:-1]:
        for x in (-w / 4, w / 4):
            if g.p.rng.uniform() > 0.85 * g.plan.clutter:
                continue
            what = ("books", "box", "vase", "mug")[int(g.p.rng.choice(4, p=[0.5, 0.2, 0.15, 0.15]))]
            if what == "books":
                count = int(g.p.rng.integers(3, 7))
                parts = f.book_row(tuple(g.p.bright("stripes", 0.4) for _ in range(count)))
            else:
                parts = g.p.small(what)[0]
            g.p.add(_HERE, what, parts, x, d / 2 + 0.02, z=level, on=shelf.id, inside=shelf.id)
    return w, d


def _sofa_group(g: Furnisher) -> tuple[float, float]:
    """Sofa with cushions, low table and rug before it."""
    w = float(g.p.rng.uniform(1.6, 2.0))
    fabric = Material("checker", *FABRICS[g.p.rng.integers(len(FABRICS))], 0.9, int(g.p.rng.integers(1 << 16)))
    g.p.add(_HERE, "rug", f.flat((1.5, 1.3, 0.012), (0, 0, 0.006), fabric), 0.0, 1.5, on=1)
    sofa = g.p.add(_HERE, "sofa", f.sofa(w, g.p.fabric(), g.p.fabric("stripes")), 0.0, 0.45, on=1)
    pillow = f.flat((0.42, 0.16, 0.36), (0, 0, 0.18), g.p.bright("dots", 0.5))
    for x in (-0.45, 0.5):
        at = x + float(g.p.rng.uniform(-0.1, 0.1))
        g.p.add(_HERE, "cushion", pillow, at, 0.36, float(g.p.rng.uniform(-15, 15)), z=0.44, on=sofa.id)
    size = (float(g.p.rng.uniform(0.8, 1.0)), 0.55, 0.42)
    table = g.p.add(_HERE, "table", f.table(size, g.p.wood(1.2), 0.05), 0.0, 1.5, on=1)
    g.p.scatter(_HERE, table, _some(g, "book", "mug", "bowl"), size[0], size[1])
    return w, 1.85


def _tv_group(g: Furnisher) -> tuple[float, float]:
    w = float(g.p.rng.uniform(1.2, 1.6))
    board = g.p.add(_HERE, "cabinet", f.cabinet((w, 0.42, 0.5), g.p.wood(), g.p.wood(0.6), 3), 0.0, 0.21, on=1)
    dark = Material("plain", (30, 30, 34), (60, 62, 68), 0.4)
    g.p.add(_HERE, "television", f.monitor(0.9, dark, g.p.bright("print", 0.8)), 0.0, 0.2, z=0.5, on=board.id)
    return w, 0.42


def _dining_group(g: Furnisher) -> tuple[float, float]:
    """A table with equal chairs round it."""
    w, d = float(g.p.rng.uniform(1.2, 1.6)), float(g.p.rng.uniform(0.8, 0.95))
    y = d / 2 + 0.42
    table = g.p.add(_HERE, "table", f.table((w, d, 0.74), g.p.wood(1.2)), 0.0, y, on=1)
    g.p.scatter(_HERE, table, _some(g, "bowl", "mug", "mug", "vase", "book", "box"), w, d)
    for x in (-w / 4, w / 4):
        for side in (-1, 1):
            turn = (0 if side < 0 else 180) + float(g.p.rng.uniform(-15, 15))
            g.p.add(_HERE, "chair", g.catalogue.chair, x, y + side * (d / 2 + 0.12), turn, on=1)
    return w, d + 0.84


def _desk_group(g: Furnisher) -> tuple[float, float]:
    """Desk, screen, chair and small things; the models are those of the building."""
    desk = g.p.add(_HERE, "desk", g.catalogue.desk, 0.0, 0.35, on=1)
    width = float(desk.box().size[0])
    g.p.add(_HERE, "monitor", g.catalogue.monitor, float(g.p.rng.uniform(-0.2, 0.2)), 0.18, z=0.74, on=desk.id)
    g.p.scatter(_HERE, desk, _some(g, "book", "mug", "box"), width, 0.66, keep_xy=0.28)
    x, turn = float(g.p.rng.uniform(-0.15, 0.15)), 180 + float(g.p.rng.uniform(-40, 40))
    g.p.add(_HERE, "office chair", g.catalogue.office_chair, x, 0.95, turn, on=1)
    return width, 1.25


def _bed_group(g: Furnisher) -> tuple[float, float]:
    """Bed between two equal night tables with lamps."""
    w = float(g.p.rng.uniform(1.3, 1.6))
    linen = Material("fabric", (206, 206, 214), (240, 240, 244), 0.5, int(g.p.rng.integers(1 << 16)))
    bed = g.p.add(_HERE, "bed", f.bed(w, 2.0, g.p.wood(), linen, g.p.fabric("checker")), 0.0, 1.0, on=1)
    pillow, night = f.flat((0.55, 0.36, 0.12), (0, 0, 0.06), g.p.fabric("stripes")), None
    for x in (-w / 4, w / 4):
        g.p.add(_HERE, "pillow", pillow, x, 0.3, float(g.p.rng.uniform(-8, 8)), z=0.46, on=bed.id)
    night = f.cabinet((0.44, 0.42, 0.5), g.p.wood(), g.p.wood(0.5), 1)
    dark, glow = Material("plain", (40, 40, 44), (70, 70, 78), 0.4), Material("plain", (236, 206, 150), (252, 236, 200))
    lamp = f.lamp(0.42, dark, glow)
    for side in (-1, 1):
        table = g.p.add(_HERE, "night table", night, side * (w / 2 + 0.25), 0.22, on=1)
        g.p.add(_HERE, "lamp", lamp, side * (w / 2 + 0.25), 0.2, z=0.5, on=table.id)
    return w + 1.0, 2.0


def _kitchen_group(g: Furnisher) -> tuple[float, float]:
    """A counter with wall cabinets above it and a refrigerator at its end."""
    w = float(min(g.p.rng.uniform(1.8, 2.6), g.plan.width - 0.9))
    pale = Material("plain", (226, 228, 230), (244, 244, 246), 0.5)
    front, body = g.p.wood(0.6), g.p.wood()
    counter = g.p.add(_HERE, "counter", f.cabinet((w, 0.6, 0.9), body, front, round(w / 0.5)), -0.32, 0.3, on=1)
    g.p.scatter(_HERE, counter, _some(g, "bowl", "vase", "box", "mug", "bowl"), w, 0.6)
    for k in range(3):
        if g.p.rng.uniform() < g.plan.clutter:
            x = -0.32 - w / 2 + 0.2 + 0.12 * k
            g.p.add(_HERE, "mug", g.catalogue.mug, x, 0.12, 90.0, z=0.9, on=counter.id)
    g.p.add(_HERE, "wall cabinet", f.cabinet((w, 0.34, 0.62), body, front, round(w / 0.5)), -0.32, 0.17, z=1.5)
    fridge = f.cabinet((0.62, 0.62, float(g.p.rng.uniform(1.5, 1.85))), pale, pale, 1)
    g.p.add(_HERE, "refrigerator", fridge, w / 2 + 0.01, 0.31, on=1)
    return w + 0.66, 0.62


def _meeting_group(g: Furnisher) -> tuple[float, float]:
    """A long table with rows of equal chairs."""
    seats = 3 if max(g.plan.width, g.plan.depth) < 4.6 else 4
    w, d = 0.62 * seats + 0.2, 1.0
    y = d / 2 + 0.5
    table = g.p.add(_HERE, "table", f.table((w, d, 0.74), g.p.wood(1.2), 0.07), 0.0, y, on=1)
    g.p.scatter(_HERE, table, _some(g, "mug", "book", "vase", "mug"), w, d)
    for k in range(seats):
        for side in (-1, 1):
            x, turn = (k - (seats - 1) / 2) * 0.62, (0 if side < 0 else 180) + float(g.p.rng.uniform(-12, 12))
            g.p.add(_HERE, "chair", g.catalogue.chair, x, y + side * (d / 2 + 0.16), turn, on=1)
    return w, d + 1.0


def _plant_group(g: Furnisher) -> tuple[float, float]:
    leaf = Material("dots", (44, 98, 48), (98, 158, 76), 0.35, int(g.p.rng.integers(1 << 16)))
    g.p.add(_HERE, "plant", f.plant(g.p.bright("stripes", 0.5), leaf), 0.0, 0.24, float(g.p.rng.uniform(0, 360)), on=1)
    return 0.48, 0.48


def _basket_group(g: Furnisher) -> tuple[float, float]:
    basket = g.p.add(_HERE, "basket", f.basket(0.18, 0.28, g.p.bright("checker", 0.4)), 0.0, 0.2, on=1)
    g.p.add(_HERE, "ball", f.ball(0.12, g.p.bright("dots", 0.4)), 0.0, 0.2, z=0.06, on=basket.id, inside=basket.id)
    return 0.4, 0.4


def _armchair_group(g: Furnisher) -> tuple[float, float]:
    g.p.add(_HERE, "armchair", f.sofa(0.9, g.p.fabric(), g.p.fabric()), 0.0, 0.5, float(g.p.rng.uniform(-20, 20)), on=1)
    return 1.0, 0.95


def _cartons_group(g: Furnisher) -> tuple[float, float]:
    """Equal cartons in a stack beside one on the floor."""
    low = g.p.add(_HERE, "carton", g.catalogue.carton, -0.2, 0.2, float(g.p.rng.uniform(-8, 8)), on=1)
    turn = float(g.p.rng.uniform(-20, 20))
    g.p.add(_HERE, "carton", g.catalogue.carton, -0.2, 0.2, turn, z=0.261, on=low.id)
    g.p.add(_HERE, "carton", g.catalogue.carton, 0.22, 0.2, float(g.p.rng.uniform(-8, 8)), on=1)
    return 0.85, 0.42


def _bench_group(g: Furnisher) -> tuple[float, float]:
    g.p.add(_HERE, "bench", f.table((1.1, 0.36, 0.45), g.p.wood(), 0.06), 0.0, 0.18, on=1)
    return 1.1, 0.36


# ------------------------------------------------------------------------------------------------ kinds of rooms


def _decorate(g: Furnisher, pictures: int) -> None:
    for _ in range(g.plan.windows):
        w, trim = float(g.p.rng.uniform(0.9, 1.4)), g.p.wood(0.5)
        pane = Material("plain", (176, 204, 232), (226, 238, 248), 1.0, int(g.p.rng.integers(1 << 16)))
        parts = (
            f.block((w, 0.05, 1.1), (0, 0.025, 0.55), trim),
            f.block((w - 0.12, 0.01, 0.98), (0, 0.05, 0.55), pane),
        )
        g.on_wall("window", parts, w, 0.95, ("north",))
    for _ in range(pictures):
        w, h = float(g.p.rng.uniform(0.5, 0.85)), float(g.p.rng.uniform(0.4, 0.6))
        frame = f.block((w, 0.03, h), (0, 0.015, h / 2), g.p.wood(0.4))
        sheet = f.block((w - 0.08, 0.004, h - 0.08), (0, 0.032, h / 2), g.p.bright("print", 0.9))
        g.on_wall("picture", (frame, sheet), w, float(g.p.rng.uniform(1.2, 1.4)))


def _living(g: Furnisher) -> None:
    g.along_wall(_sofa_group)
    g.along_wall(_tv_group)
    if min(g.plan.width, g.plan.depth) > 4.2:
        g.in_the_open(_dining_group)
    g.along_wall(_shelf_group)
    g.along_wall(_armchair_group)
    g.along_wall(_cabinet_group("cabinet", 1.0, 0.44, 0.86, "vase", "box", "ball"))
    g.along_wall(_plant_group)
    g.along_wall(_basket_group)
    _decorate(g, 3)


def _bedroom(g: Furnisher) -> None:
    g.along_wall(_bed_group)
    g.along_wall(_cabinet_group("wardrobe", 1.2, 0.56, 1.7, "box"))
    g.along_wall(_cabinet_group("cabinet", 0.8, 0.44, 0.8, "bowl", "box", "vase"))
    g.along_wall(_desk_group)
    g.along_wall(_basket_group)
    g.along_wall(_plant_group)
    _decorate(g, 3)


def _office(g: Furnisher) -> None:
    for _ in range(2 + int(g.plan.width * g.plan.depth > 16)):
        g.along_wall(_desk_group)
    g.along_wall(_shelf_group)
    g.along_wall(_cabinet_group("cabinet", 0.9, 0.44, 1.1, "box", "vase", "book"))
    g.along_wall(_plant_group)
    g.along_wall(_cartons_group)
    _decorate(g, 2)


def _kitchen(g: Furnisher) -> None:
    g.along_wall(_kitchen_group)
    g.in_the_open(_dining_group)
    g.along_wall(_cabinet_group("cabinet", 1.0, 0.44, 0.9, "bowl", "mug", "vase", "box"))
    g.along_wall(_shelf_group)
    g.along_wall(_basket_group)
    _decorate(g, 2)


def _meeting(g: Furnisher) -> None:
    g.in_the_open(_meeting_group, 0.2)
    board = f.flat((1.6, 0.03, 1.0), (0, 0.015, 0.5), Material("plain", (236, 238, 240), (248, 248, 250), 0.8))
    g.on_wall("whiteboard", board, 1.6, 0.95)
    g.along_wall(_tv_group)
    g.along_wall(_plant_group)
    g.along_wall(_cabinet_group("cabinet", 1.0, 0.42, 0.8, "mug", "box", "vase"))
    _decorate(g, 2)


def _storage(g: Furnisher) -> None:
    for _ in range(3):
        g.along_wall(_shelf_group)
    for _ in range(3):
        g.along_wall(_cartons_group)
    g.along_wall(_cabinet_group("cabinet", 1.1, 0.5, 1.2, "box", "box", "ball", "vase"))
    g.along_wall(_basket_group)
    _decorate(g, 0)


def _empty(g: Furnisher) -> None:
    """Two or three things in a bare room."""
    groups = [_plant_group, _bench_group, _armchair_group, _basket_group, _cartons_group]
    groups.append(_cabinet_group("cabinet", 0.9, 0.44, 0.8, "box"))
    order = g.p.rng.permutation(len(groups))
    for k in order[: int(g.p.rng.integers(2, 4))]:
        g.along_wall(groups[k])
    _decorate(g, 1)


def _corridor(g: Furnisher) -> None:
    """Little on the walls and less on the floor, in step with its length."""
    length = max(g.plan.width, g.plan.depth)
    for _ in range(round(length / 9 * g.plan.clutter)):
        group = (_plant_group, _bench_group, _basket_group)[int(g.p.rng.integers(3))]
        g.along_wall(group, ("north", "south"))
    red = Material("plain", (196, 40, 36), (224, 80, 70), 0.3)
    bottle = (f.pillar(0.08, 0.5, (0, 0.1, 0), red), f.pillar(0.03, 0.1, (0, 0.1, 0.5), red))
    for _ in range(max(1, round(length / 12))):
        g.on_wall("extinguisher", bottle, 0.2, 0.9, ("north", "south"))
    _decorate(g, round(length / 5 * g.plan.clutter))


KINDS: dict[str, Callable[[Furnisher], None]] = {
    "living room": _living,
    "bedroom": _bedroom,
    "office": _office,
    "kitchen": _kitchen,
    "meeting room": _meeting,
    "storage": _storage,
    "empty": _empty,
    "corridor": _corridor,
}
