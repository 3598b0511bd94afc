"""Furnished rooms of several kinds, each in its own coordinates, so that one room can be in a building twice."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.simulation import furniture_groups as groups
from benchmarks.simulation.furnisher import (
    DOOR_HEIGHT_M,
    DOOR_WIDTH_M,
    HALF_WALL_M,
    HEIGHT_M,
    HERE,
    SIDES,
    Catalogue,
    Furnisher,
    RoomPlan,
    footprint,
)
from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.layout import WOODS, Placer, wall_paint
from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.objects import SimulatedObject


def make_room(p: Placer, plan: RoomPlan, catalogue: Catalogue) -> tuple[SimulatedObject, ...]:
    """All objects of a room in its own coordinates: x from 0 to width, y from 0 to depth; ids from 1, the floor first.

    Colours, sizes and places are drawn from the placer's generator; its list of objects must be empty.
    """
    assert not p.objects
    walls = _shell(p, plan)
    clear = []
    for door in plan.doors:
        reach = 0.35 if door.closed else 1.0
        x, y, yaw = Furnisher(p, plan, catalogue, [], walls).against(door.side, door.at, 0.0)
        clear.append(footprint(x, y, yaw, DOOR_WIDTH_M + 0.1, min(reach, plan.depth - 0.05)))
        if door.closed:
            p.add(HERE, "door", catalogue.leaf, x, y, yaw, attached=walls[door.side])
        else:
            p.add(HERE, "door frame", _frame(p), x, y, yaw, attached=walls[door.side])
    furnisher = Furnisher(p, plan, catalogue, clear, walls)
    KINDS[plan.kind](furnisher)
    return tuple(p.objects)


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
    paint = wall_paint(p)
    walls = {}
    for side in SIDES:
        openings = [door.at for door in plan.doors if door.side == side and not door.closed]
        walls[side] = p.add_structure("wall", _wall(plan, side, openings, paint)).id
    return walls


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
    """Posts and lintel about an opening, in this room's half of the wall."""
    trim, wide, deep = p.wood(0.7), DOOR_WIDTH_M, HALF_WALL_M + 0.02
    y = -HALF_WALL_M / 2 + 0.01
    posts = [f.block((0.07, deep, DOOR_HEIGHT_M), (s * (wide / 2 + 0.02), y, DOOR_HEIGHT_M / 2), trim) for s in (-1, 1)]
    return (*posts, f.block((wide + 0.11, deep, 0.07), (0, y, DOOR_HEIGHT_M + 0.02), trim))


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
    g.along_wall(groups.sofa_group)
    g.along_wall(groups.tv_group)
    if min(g.plan.width, g.plan.depth) > 4.2:
        g.in_the_open(groups.dining_group)
    g.along_wall(groups.shelf_group)
    g.along_wall(groups.armchair_group)
    g.along_wall(groups.cabinet_group("cabinet", 1.0, 0.44, 0.86, "vase", "box", "ball"))
    g.along_wall(groups.plant_group)
    g.along_wall(groups.basket_group)
    _decorate(g, 3)


def _bedroom(g: Furnisher) -> None:
    g.along_wall(groups.bed_group)
    g.along_wall(groups.cabinet_group("wardrobe", 1.2, 0.56, 1.7, "box"))
    g.along_wall(groups.cabinet_group("cabinet", 0.8, 0.44, 0.8, "bowl", "box", "vase"))
    g.along_wall(groups.desk_group)
    g.along_wall(groups.basket_group)
    g.along_wall(groups.plant_group)
    _decorate(g, 3)


def _office(g: Furnisher) -> None:
    for _ in range(2 + int(g.plan.width * g.plan.depth > 16)):
        g.along_wall(groups.desk_group)
    g.along_wall(groups.shelf_group)
    g.along_wall(groups.cabinet_group("cabinet", 0.9, 0.44, 1.1, "box", "vase", "book"))
    g.along_wall(groups.plant_group)
    g.along_wall(groups.cartons_group)
    _decorate(g, 2)


def _kitchen(g: Furnisher) -> None:
    g.along_wall(groups.kitchen_group)
    g.in_the_open(groups.dining_group)
    g.along_wall(groups.cabinet_group("cabinet", 1.0, 0.44, 0.9, "bowl", "mug", "vase", "box"))
    g.along_wall(groups.shelf_group)
    g.along_wall(groups.basket_group)
    _decorate(g, 2)


def _meeting(g: Furnisher) -> None:
    g.in_the_open(groups.meeting_group, 0.2)
    board = f.flat((1.6, 0.03, 1.0), (0, 0.015, 0.5), Material("plain", (236, 238, 240), (248, 248, 250), 0.8))
    g.on_wall("whiteboard", board, 1.6, 0.95)
    g.along_wall(groups.tv_group)
    g.along_wall(groups.plant_group)
    g.along_wall(groups.cabinet_group("cabinet", 1.0, 0.42, 0.8, "mug", "box", "vase"))
    _decorate(g, 2)


def _storage(g: Furnisher) -> None:
    for _ in range(3):
        g.along_wall(groups.shelf_group)
    for _ in range(3):
        g.along_wall(groups.cartons_group)
    g.along_wall(groups.cabinet_group("cabinet", 1.1, 0.5, 1.2, "box", "box", "ball", "vase"))
    g.along_wall(groups.basket_group)
    _decorate(g, 0)


def _empty(g: Furnisher) -> None:
    """Two or three objects in a bare room."""
    low = groups.cabinet_group("cabinet", 0.9, 0.44, 0.8, "box")
    known = (groups.plant_group, groups.bench_group, groups.armchair_group, groups.basket_group, groups.cartons_group)
    choice = [*known, low]
    order = g.p.rng.permutation(len(choice))
    for k in order[: int(g.p.rng.integers(2, 4))]:
        g.along_wall(choice[k])
    _decorate(g, 1)


def _corridor(g: Furnisher) -> None:
    """Little on the walls and less on the floor, in step with its length."""
    length = max(g.plan.width, g.plan.depth)
    for _ in range(round(length / 9 * g.plan.clutter)):
        what = (groups.plant_group, groups.bench_group, groups.basket_group)[int(g.p.rng.integers(3))]
        g.along_wall(what, ("north", "south"))
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
