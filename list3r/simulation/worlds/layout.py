"""Where objects are: two furnished rooms in their own coordinates, with seeded sizes, colours and small objects."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.materials import Material, Rgb
from list3r.simulation.worlds.objects import SimulatedObject

WOODS: tuple[tuple[Rgb, Rgb], ...] = (
    ((112, 74, 44), (158, 110, 68)),
    ((164, 122, 78), (214, 172, 122)),
    ((84, 58, 42), (128, 92, 66)),
    ((190, 160, 120), (228, 204, 168)),
)
BRIGHT: tuple[tuple[Rgb, Rgb], ...] = (
    ((196, 52, 44), (244, 214, 190)),
    ((40, 92, 168), (206, 224, 244)),
    ((46, 134, 84), (226, 238, 196)),
    ((236, 178, 48), (150, 76, 30)),
    ((132, 72, 150), (238, 214, 240)),
    ((236, 236, 228), (70, 110, 150)),
    ((28, 140, 150), (240, 236, 210)),
    ((226, 110, 60), (250, 232, 206)),
)
FABRICS: tuple[tuple[Rgb, Rgb], ...] = (
    ((70, 92, 122), (124, 146, 176)),
    ((132, 80, 76), (190, 136, 126)),
    ((92, 112, 92), (148, 168, 142)),
    ((150, 132, 110), (206, 190, 168)),
)
SMALL_KINDS = ("mug", "box", "book", "ball", "bowl", "vase")


@dataclass(frozen=True)
class SimulatedRoom:
    """A rectangle of floor, metres, world."""

    x0: float
    x1: float
    depth: float
    """It reaches from y = y0 to y = y0 + depth."""
    mirrored: bool
    """Furniture laid out for y is set at depth - y."""
    y0: float = 0.0

    def world_xy(self, x: float, y: float) -> tuple[float, float]:
        """Room coordinates to the world."""
        return self.x0 + x, self.y0 + (self.depth - y if self.mirrored else y)


@dataclass
class Placer:
    """Collects objects with rising ids, in room coordinates."""

    rng: np.random.Generator
    objects: list[SimulatedObject] = field(default_factory=list)

    def add(
        self,
        room: SimulatedRoom,
        label: str,
        parts: f.Parts,
        x: float,
        y: float,
        yaw_deg: float = 0.0,
        *,
        z: float = 0.0,
        on: int | None = None,
        inside: int | None = None,
        attached: int | None = None,
    ) -> SimulatedObject:
        """Put an object at (x, y) of a room; `yaw_deg` turns its front from the room's +y."""
        yaw = np.deg2rad(180.0 - yaw_deg if room.mirrored else yaw_deg)
        wx, wy = room.world_xy(x, y)
        obj = SimulatedObject(len(self.objects) + 1, label, parts, (wx, wy, z), float(yaw), on, inside, attached)
        self.objects.append(obj)
        return obj

    def add_structure(self, label: str, parts: f.Parts) -> SimulatedObject:
        """Return a floor, wall or ceiling, its parts in world coordinates."""
        obj = SimulatedObject(len(self.objects) + 1, label, parts, (0.0, 0.0, 0.0), structure=label)
        self.objects.append(obj)
        return obj

    def wood(self, tile_m: float = 0.8) -> Material:
        """Return a wood drawn from the palette."""
        low, high = WOODS[self.rng.integers(len(WOODS))]
        return Material("wood", low, high, tile_m, int(self.rng.integers(1 << 16)))

    def fabric(self, kind: str = "fabric") -> Material:
        """Return a cloth drawn from the palette."""
        low, high = FABRICS[self.rng.integers(len(FABRICS))]
        return Material(kind, low, high, 0.6, int(self.rng.integers(1 << 16)))

    def bright(self, kind: str, tile_m: float) -> Material:
        """Return a vivid surface for small objects."""
        low, high = BRIGHT[self.rng.integers(len(BRIGHT))]
        return Material(kind, low, high, tile_m, int(self.rng.integers(1 << 16)))

    def small(self, kind: str) -> tuple[f.Parts, float]:
        """Return the parts of a small object and the radius that it takes up, metres."""
        rng = self.rng
        if kind == "mug":
            radius = rng.uniform(0.042, 0.05)
            return f.mug(radius, rng.uniform(0.10, 0.12), self.bright(_pick(rng, "stripes", "dots"), 0.25)), 0.075
        if kind == "box":
            size = (rng.uniform(0.16, 0.26), rng.uniform(0.12, 0.18), rng.uniform(0.10, 0.18))
            material = Material("plain", (176, 132, 88), (214, 176, 130), 0.3, int(rng.integers(1 << 16)))
            return f.carton(size, material, self.bright("stripes", 0.2)), float(np.hypot(*size[:2]) / 2)
        if kind == "book":
            size = (rng.uniform(0.18, 0.22), rng.uniform(0.24, 0.28), rng.uniform(0.05, 0.07))
            paper = Material("stripes", (236, 230, 214), (206, 198, 178), 0.05)
            return f.book(size, self.bright("print", 0.3), paper), float(np.hypot(*size[:2]) / 2)
        if kind == "ball":
            radius = rng.uniform(0.055, 0.08)
            return f.ball(radius, self.bright(_pick(rng, "checker", "dots"), 0.3)), radius
        if kind == "bowl":
            radius = rng.uniform(0.11, 0.14)
            return f.bowl(radius, self.bright("stripes", 0.4)), radius
        radius = rng.uniform(0.07, 0.085)
        return f.vase(radius, rng.uniform(0.22, 0.28), self.bright("print", 0.4)), radius

    def scatter(
        self,
        room: SimulatedRoom,
        support: SimulatedObject,
        kinds: tuple[str, ...],
        width: float,
        depth: float,
        keep_xy: float = 0.0,
    ) -> list[SimulatedObject]:
        """Small objects on the top of `support` at least 5 cm apart; the back `keep_xy` metres stay free."""
        top = support.box().center[2] + support.box().size[2] / 2
        placed: list[tuple[float, float, float]] = []
        out = []
        for kind in kinds:
            parts, radius = self.small(kind)
            spot = self._free_spot(placed, radius, width, depth, keep_xy)
            if spot is None:
                continue
            placed.append((*spot, radius))
            offset = support.rotation()[:2, :2] @ np.array(spot)
            yaw = float(self.rng.uniform(0, 2 * np.pi))
            at = (support.position[0] + float(offset[0]), support.position[1] + float(offset[1]), float(top))
            obj = SimulatedObject(len(self.objects) + 1, kind, parts, at, yaw, support.id)
            self.objects.append(obj)
            out.append(obj)
        return out

    def _free_spot(
        self, placed: list[tuple[float, float, float]], radius: float, width: float, depth: float, keep_xy: float
    ) -> tuple[float, float] | None:
        rx, ry = width / 2 - radius - 0.02, depth / 2 - radius - 0.02
        if rx <= 0 or ry - keep_xy / 2 <= 0:
            return (0.0, keep_xy / 2) if not placed else None
        for _ in range(200):
            x, y = float(self.rng.uniform(-rx, rx)), float(self.rng.uniform(-ry + keep_xy, ry))
            if all(np.hypot(x - a, y - b) > radius + r + 0.05 for a, b, r in placed):
                return x, y
        return None


def _pick(rng: np.random.Generator, *names: str) -> str:
    return names[rng.integers(len(names))]


def _fill(placer: Placer, container: SimulatedObject, parts: f.Parts, label: str, z: float) -> None:
    x, y, base = container.position
    placer.objects.append(
        SimulatedObject(len(placer.objects) + 1, label, parts, (x, y, base + z), 0.0, container.id, container.id)
    )


def furnish_living_room(p: Placer, room: SimulatedRoom, walls: dict[str, int], floor: int) -> None:
    """A room 4.0 m wide with the door on its right: dining table, sofa, shelf, sideboard."""
    rng, wide = p.rng, room.x1 - room.x0
    wood, seat = p.wood(), p.fabric()
    rug = Material("checker", *FABRICS[rng.integers(len(FABRICS))], 0.9, int(rng.integers(1 << 16)))
    p.add(room, "rug", f.flat((1.5, 1.2, 0.012), (0, 0, 0.006), rug), 2.45, 1.7, on=floor)
    w, d = rng.uniform(1.35, 1.5), rng.uniform(0.82, 0.9)
    table = p.add(room, "table", f.table((w, d, 0.74), p.wood(1.2)), 1.5, 2.75, rng.uniform(-4, 4), on=floor)
    small = p.scatter(room, table, ("bowl", "book", "box", "mug", "mug", "vase"), w, d)
    for obj in small:
        if obj.label == "bowl":
            _fill(p, obj, f.ball(0.06, p.bright("dots", 0.3)), "ball", 0.035)
    for x, y, yaw in ((1.75, 2.08, rng.uniform(-25, 25)), (0.47, 2.75, -90 + rng.uniform(-12, 12)), (1.4, 3.4, 180)):
        p.add(room, "chair", f.chair(wood, seat), x, y, yaw, on=floor)
    width = rng.uniform(1.7, 1.9)
    sofa = p.add(room, "sofa", f.sofa(width, p.fabric(), p.fabric("stripes")), 1.35, 0.46, on=floor)
    pillow = f.flat((0.42, 0.16, 0.36), (0, 0, 0.18), p.bright("dots", 0.5))
    p.add(room, "cushion", pillow, 1.35 + rng.uniform(-0.5, 0.5), 0.36, rng.uniform(-15, 15), z=0.44, on=sofa.id)
    _bookshelf(p, room, floor)
    side = p.add(room, "side table", f.table((0.46, 0.46, 0.50), p.wood(), 0.05), 2.72, 0.42, on=floor)
    p.scatter(room, side, ("book", "mug"), 0.46, 0.46)
    leaf = Material("dots", (44, 98, 48), (98, 158, 76), 0.35, int(rng.integers(1 << 16)))
    p.add(room, "plant", f.plant(p.bright("stripes", 0.5), leaf), wide - 0.42, 0.42, on=floor)
    board = f.cabinet((1.1, 0.44, 0.86), p.wood(), p.wood(0.6), 3)
    sideboard = p.add(room, "cabinet", board, wide - 0.75, room.depth - 0.23, 180, on=floor)
    p.scatter(room, sideboard, ("vase", "box", "ball"), 1.1, 0.44)
    back, front = ("south", "north") if room.mirrored else ("north", "south")
    _picture(p, room, 1.3, room.depth, 180, walls[back])
    _picture(p, room, 1.3, 0.0, 0, walls[front])
    _picture(p, room, 0.0, 2.75, -90, walls["west"])


def _bookshelf(p: Placer, room: SimulatedRoom, floor: int) -> None:
    height, boards = 1.65, 4
    shelf = p.add(room, "bookshelf", f.shelf((0.85, 0.32, height), p.wood(), boards), 0.17, 1.52, -90, on=floor)
    levels = f.shelf_boards(height, boards)
    for level, (x, what) in zip(levels[:-1] * 2, _shelf_plan(p), strict=False):
        parts, label = what
        offset = shelf.rotation()[:2, :2] @ np.array([x, 0.02])
        at = (shelf.position[0] + float(offset[0]), shelf.position[1] + float(offset[1]), level)
        p.objects.append(SimulatedObject(len(p.objects) + 1, label, parts, at, shelf.yaw, shelf.id, shelf.id))


def _shelf_plan(p: Placer) -> list[tuple[float, tuple[f.Parts, str]]]:
    def row() -> tuple[f.Parts, str]:
        return f.book_row(tuple(p.bright("stripes", 0.4) for _ in range(6))), "books"

    bin_size = (0.26, 0.24, 0.22)
    bin_parts = f.carton(bin_size, p.bright("plain", 0.4), p.bright("stripes", 0.3))
    return [
        (-0.2, row()),
        (0.2, row()),
        (-0.2, (bin_parts, "box")),
        (0.2, (p.small("vase")[0], "vase")),
        (-0.22, row()),
    ]


def _picture(p: Placer, room: SimulatedRoom, x: float, y: float, yaw_deg: float, wall: int) -> None:
    w, h = p.rng.uniform(0.6, 0.85), p.rng.uniform(0.45, 0.6)
    frame = f.block((w, 0.03, h), (0, 0.015, h / 2), p.wood(0.4))
    sheet = f.block((w - 0.08, 0.004, h - 0.08), (0, 0.032, h / 2), p.bright("print", 0.9))
    p.add(room, "picture", (frame, sheet), x, y, yaw_deg, z=1.25, attached=wall)


def furnish_bedroom(p: Placer, room: SimulatedRoom, walls: dict[str, int], floor: int) -> None:
    """A room 3.8 m wide with the door on its left: desk, bed, wardrobe, night table."""
    rng, wide = p.rng, room.x1 - room.x0
    rug = Material("stripes", *FABRICS[rng.integers(len(FABRICS))], 0.8, int(rng.integers(1 << 16)))
    p.add(room, "rug", f.flat((1.2, 1.5, 0.012), (0, 0, 0.006), rug), 1.1, 2.0, on=floor)
    width = rng.uniform(1.25, 1.4)
    desk = p.add(room, "desk", f.table((width, 0.66, 0.74), p.wood(1.1), 0.05), 1.35, 0.36, on=floor)
    p.scatter(room, desk, ("book", "mug", "box", "ball"), width, 0.66, keep_xy=0.2)
    dark = Material("plain", (36, 38, 42), (70, 72, 78), 0.4)
    screen = f.monitor(0.5, dark, p.bright("print", 0.6))
    p.add(room, "monitor", screen, 1.35, 0.14, rng.uniform(-8, 8), z=0.74, on=desk.id)
    seat = f.chair(p.wood(), p.fabric())
    p.add(room, "chair", seat, 1.35 + rng.uniform(-0.2, 0.2), 1.0, 180 + rng.uniform(-30, 30), on=floor)
    linen = Material("fabric", (206, 206, 214), (240, 240, 244), 0.5, int(rng.integers(1 << 16)))
    bed = p.add(room, "bed", f.bed(1.3, 2.0, p.wood(), linen, p.fabric("checker")), wide - 1.03, 2.3, 90, on=floor)
    pillow = f.flat((0.6, 0.36, 0.12), (0, 0, 0.06), p.fabric("stripes"))
    p.add(room, "pillow", pillow, wide - 0.32, 2.3, 90 + rng.uniform(-10, 10), z=0.46, on=bed.id)
    night = p.add(
        room, "night table", f.cabinet((0.46, 0.42, 0.5), p.wood(), p.wood(0.5), 1), wide - 0.23, 3.4, 90, on=floor
    )
    glow = Material("plain", (236, 206, 150), (252, 236, 200), 0.3)
    p.add(room, "lamp", f.lamp(0.42, dark, glow), wide - 0.17, 3.5, z=0.5, on=night.id)
    p.add(room, "box", p.small("box")[0], wide - 0.31, 3.30, rng.uniform(0, 360), z=0.5, on=night.id)
    high = f.cabinet((1.0, 0.52, 1.1), p.wood(), p.wood(0.7))
    wardrobe = p.add(room, "cabinet", high, 0.75, room.depth - 0.27, 180, on=floor)
    p.scatter(room, wardrobe, ("box", "vase"), 1.0, 0.52)
    basket = p.add(room, "basket", f.basket(0.2, 0.26, p.bright("checker", 0.4)), 1.75, room.depth - 0.35, on=floor)
    _fill(p, basket, f.ball(0.13, p.bright("dots", 0.4)), "ball", 0.05)
    low = f.cabinet((0.7, 0.42, 0.8), p.wood(), p.wood(0.5))
    chest = p.add(room, "cabinet", low, wide - 0.5, 0.23, on=floor)
    p.scatter(room, chest, ("bowl", "box"), 0.7, 0.42)
    back, front = ("south", "north") if room.mirrored else ("north", "south")
    _picture(p, room, 2.1, room.depth, 180, walls[back])
    _picture(p, room, 2.4, 0.0, 0, walls[front])
    _picture(p, room, wide, 2.3, 90, walls["east"])


def wall_paint(p: Placer) -> Material:
    """Return a pale plaster, each time another."""
    tints = ((222, 210, 188), (196, 208, 214), (206, 214, 196), (224, 202, 192), (212, 206, 216))
    r, g, b = tints[int(p.rng.integers(len(tints)))]
    return Material("plaster", (r, g, b), (r - 46, g - 44, b - 40), 1.3, int(p.rng.integers(1 << 16)))
