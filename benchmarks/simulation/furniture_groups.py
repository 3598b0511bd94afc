"""Groups of objects that belong together: a desk with its chair and screen, a table with chairs round it.

Each function builds objects about its own origin, back at y = 0, front towards +y, and returns its footprint, width and
depth in metres.
"""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.simulation.furnisher import HERE, Furnisher
from list3r.simulation.worlds import furniture as f
from list3r.simulation.worlds.layout import FABRICS
from list3r.simulation.worlds.materials import Material


def _some(g: Furnisher, *kinds: str) -> tuple[str, ...]:
    return tuple(kind for kind in kinds if g.p.rng.uniform() < g.plan.clutter)


def cabinet_group(
    label: str, width: float, depth: float, height: float, *tops: str
) -> Callable[..., tuple[float, float]]:
    def build(g: Furnisher) -> tuple[float, float]:
        w, h = width * g.p.rng.uniform(0.9, 1.1), height * g.p.rng.uniform(0.92, 1.08)
        parts = f.cabinet((w, depth, h), g.p.wood(), g.p.wood(0.6), max(1, round(w / 0.5)))
        body = g.p.add(HERE, label, parts, 0.0, depth / 2, on=1)
        g.p.scatter(HERE, body, _some(g, *tops), w, depth)
        return w, depth

    return build


def shelf_group(g: Furnisher) -> tuple[float, float]:
    height, boards, w, d = float(g.p.rng.uniform(1.3, 1.9)), 4, float(g.p.rng.uniform(0.75, 1.0)), 0.32
    shelf = g.p.add(HERE, "bookshelf", f.shelf((w, d, height), g.p.wood(), boards), 0.0, d / 2, on=1)
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
            g.p.add(HERE, what, parts, x, d / 2 + 0.02, z=level, on=shelf.id, inside=shelf.id)
    return w, d


def sofa_group(g: Furnisher) -> tuple[float, float]:
    """Sofa with cushions, low table and rug before it."""
    w = float(g.p.rng.uniform(1.6, 2.0))
    fabric = Material("checker", *FABRICS[g.p.rng.integers(len(FABRICS))], 0.9, int(g.p.rng.integers(1 << 16)))
    g.p.add(HERE, "rug", f.flat((1.5, 1.3, 0.012), (0, 0, 0.006), fabric), 0.0, 1.5, on=1)
    sofa = g.p.add(HERE, "sofa", f.sofa(w, g.p.fabric(), g.p.fabric("stripes")), 0.0, 0.45, on=1)
    pillow = f.flat((0.42, 0.16, 0.36), (0, 0, 0.18), g.p.bright("dots", 0.5))
    for x in (-0.45, 0.5):
        at = x + float(g.p.rng.uniform(-0.1, 0.1))
        g.p.add(HERE, "cushion", pillow, at, 0.36, float(g.p.rng.uniform(-15, 15)), z=0.44, on=sofa.id)
    size = (float(g.p.rng.uniform(0.8, 1.0)), 0.55, 0.42)
    table = g.p.add(HERE, "table", f.table(size, g.p.wood(1.2), 0.05), 0.0, 1.5, on=1)
    g.p.scatter(HERE, table, _some(g, "book", "mug", "bowl"), size[0], size[1])
    return w, 1.85


def tv_group(g: Furnisher) -> tuple[float, float]:
    w = float(g.p.rng.uniform(1.2, 1.6))
    board = g.p.add(HERE, "cabinet", f.cabinet((w, 0.42, 0.5), g.p.wood(), g.p.wood(0.6), 3), 0.0, 0.21, on=1)
    dark = Material("plain", (30, 30, 34), (60, 62, 68), 0.4)
    g.p.add(HERE, "television", f.monitor(0.9, dark, g.p.bright("print", 0.8)), 0.0, 0.2, z=0.5, on=board.id)
    return w, 0.42


def dining_group(g: Furnisher) -> tuple[float, float]:
    """A table with equal chairs round it."""
    w, d = float(g.p.rng.uniform(1.2, 1.6)), float(g.p.rng.uniform(0.8, 0.95))
    y = d / 2 + 0.42
    table = g.p.add(HERE, "table", f.table((w, d, 0.74), g.p.wood(1.2)), 0.0, y, on=1)
    g.p.scatter(HERE, table, _some(g, "bowl", "mug", "mug", "vase", "book", "box"), w, d)
    for x in (-w / 4, w / 4):
        for side in (-1, 1):
            turn = (0 if side < 0 else 180) + float(g.p.rng.uniform(-15, 15))
            g.p.add(HERE, "chair", g.catalogue.chair, x, y + side * (d / 2 + 0.12), turn, on=1)
    return w, d + 0.84


def desk_group(g: Furnisher) -> tuple[float, float]:
    """Desk, screen, chair and small objects; the models are those of the building."""
    desk = g.p.add(HERE, "desk", g.catalogue.desk, 0.0, 0.35, on=1)
    width = float(desk.box().size[0])
    g.p.add(HERE, "monitor", g.catalogue.monitor, float(g.p.rng.uniform(-0.2, 0.2)), 0.18, z=0.74, on=desk.id)
    g.p.scatter(HERE, desk, _some(g, "book", "mug", "box"), width, 0.66, keep_xy=0.28)
    x, turn = float(g.p.rng.uniform(-0.15, 0.15)), 180 + float(g.p.rng.uniform(-40, 40))
    g.p.add(HERE, "office chair", g.catalogue.office_chair, x, 0.95, turn, on=1)
    return width, 1.25


def bed_group(g: Furnisher) -> tuple[float, float]:
    """Bed between two equal night tables with lamps."""
    w = float(g.p.rng.uniform(1.3, 1.6))
    linen = Material("fabric", (206, 206, 214), (240, 240, 244), 0.5, int(g.p.rng.integers(1 << 16)))
    bed = g.p.add(HERE, "bed", f.bed(w, 2.0, g.p.wood(), linen, g.p.fabric("checker")), 0.0, 1.0, on=1)
    pillow, night = f.flat((0.55, 0.36, 0.12), (0, 0, 0.06), g.p.fabric("stripes")), None
    for x in (-w / 4, w / 4):
        g.p.add(HERE, "pillow", pillow, x, 0.3, float(g.p.rng.uniform(-8, 8)), z=0.46, on=bed.id)
    night = f.cabinet((0.44, 0.42, 0.5), g.p.wood(), g.p.wood(0.5), 1)
    dark, glow = Material("plain", (40, 40, 44), (70, 70, 78), 0.4), Material("plain", (236, 206, 150), (252, 236, 200))
    lamp = f.lamp(0.42, dark, glow)
    for side in (-1, 1):
        table = g.p.add(HERE, "night table", night, side * (w / 2 + 0.25), 0.22, on=1)
        g.p.add(HERE, "lamp", lamp, side * (w / 2 + 0.25), 0.2, z=0.5, on=table.id)
    return w + 1.0, 2.0


def kitchen_group(g: Furnisher) -> tuple[float, float]:
    """A counter with wall cabinets above it and a refrigerator at its end."""
    w = float(min(g.p.rng.uniform(1.8, 2.6), g.plan.width - 0.9))
    pale = Material("plain", (226, 228, 230), (244, 244, 246), 0.5)
    front, body = g.p.wood(0.6), g.p.wood()
    counter = g.p.add(HERE, "counter", f.cabinet((w, 0.6, 0.9), body, front, round(w / 0.5)), -0.32, 0.3, on=1)
    g.p.scatter(HERE, counter, _some(g, "bowl", "vase", "box", "mug", "bowl"), w, 0.6)
    for k in range(3):
        if g.p.rng.uniform() < g.plan.clutter:
            x = -0.32 - w / 2 + 0.2 + 0.12 * k
            g.p.add(HERE, "mug", g.catalogue.mug, x, 0.12, 90.0, z=0.9, on=counter.id)
    g.p.add(HERE, "wall cabinet", f.cabinet((w, 0.34, 0.62), body, front, round(w / 0.5)), -0.32, 0.17, z=1.5)
    fridge = f.cabinet((0.62, 0.62, float(g.p.rng.uniform(1.5, 1.85))), pale, pale, 1)
    g.p.add(HERE, "refrigerator", fridge, w / 2 + 0.01, 0.31, on=1)
    return w + 0.66, 0.62


def meeting_group(g: Furnisher) -> tuple[float, float]:
    """A long table with rows of equal chairs."""
    seats = 3 if max(g.plan.width, g.plan.depth) < 4.6 else 4
    w, d = 0.62 * seats + 0.2, 1.0
    y = d / 2 + 0.5
    table = g.p.add(HERE, "table", f.table((w, d, 0.74), g.p.wood(1.2), 0.07), 0.0, y, on=1)
    g.p.scatter(HERE, table, _some(g, "mug", "book", "vase", "mug"), w, d)
    for k in range(seats):
        for side in (-1, 1):
            x, turn = (k - (seats - 1) / 2) * 0.62, (0 if side < 0 else 180) + float(g.p.rng.uniform(-12, 12))
            g.p.add(HERE, "chair", g.catalogue.chair, x, y + side * (d / 2 + 0.16), turn, on=1)
    return w, d + 1.0


def plant_group(g: Furnisher) -> tuple[float, float]:
    leaf = Material("dots", (44, 98, 48), (98, 158, 76), 0.35, int(g.p.rng.integers(1 << 16)))
    g.p.add(HERE, "plant", f.plant(g.p.bright("stripes", 0.5), leaf), 0.0, 0.24, float(g.p.rng.uniform(0, 360)), on=1)
    return 0.48, 0.48


def basket_group(g: Furnisher) -> tuple[float, float]:
    basket = g.p.add(HERE, "basket", f.basket(0.18, 0.28, g.p.bright("checker", 0.4)), 0.0, 0.2, on=1)
    g.p.add(HERE, "ball", f.ball(0.12, g.p.bright("dots", 0.4)), 0.0, 0.2, z=0.06, on=basket.id, inside=basket.id)
    return 0.4, 0.4


def armchair_group(g: Furnisher) -> tuple[float, float]:
    g.p.add(HERE, "armchair", f.sofa(0.9, g.p.fabric(), g.p.fabric()), 0.0, 0.5, float(g.p.rng.uniform(-20, 20)), on=1)
    return 1.0, 0.95


def cartons_group(g: Furnisher) -> tuple[float, float]:
    """Equal cartons in a stack next to one on the floor."""
    low = g.p.add(HERE, "carton", g.catalogue.carton, -0.2, 0.2, float(g.p.rng.uniform(-8, 8)), on=1)
    turn = float(g.p.rng.uniform(-20, 20))
    g.p.add(HERE, "carton", g.catalogue.carton, -0.2, 0.2, turn, z=0.261, on=low.id)
    g.p.add(HERE, "carton", g.catalogue.carton, 0.22, 0.2, float(g.p.rng.uniform(-8, 8)), on=1)
    return 0.85, 0.42


def bench_group(g: Furnisher) -> tuple[float, float]:
    g.p.add(HERE, "bench", f.table((1.1, 0.36, 0.45), g.p.wood(), 0.06), 0.0, 0.18, on=1)
    return 1.1, 0.36
