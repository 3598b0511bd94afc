"""What is built into rooms: glazing, panels, long curtains, cabinets flush with walls, kitchens with worktops."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from training.worlds.draft import Draft, Zone, pose_of
from training.worlds.materials import Material
from training.worlds.mesh import Mesh, box, cylinder, grid_triangles, join, rod, soft_box
from training.worlds.tables import drawers


def _pane(d: Draft) -> Material:
    """A pane: depth fails on it, or it is clouded, or something hangs right behind it, so that depth works."""
    share = float(d.rng.choice([0.0, 0.0, 0.3, 0.95]))
    base = d.palette.glass() if d.chance(0.6) else d.palette.printed()
    return replace(base, glass=share)


def _leaf(d: Draft, size: tuple[float, float], pane: Material, frame: Material) -> list[tuple[Mesh, Material]]:
    """A glazed or filled leaf with bars; its origin is its lower left corner, it lies in the plane y = 0."""
    w, h = size
    edge, thick = d.u(0.03, 0.09), d.u(0.025, 0.06)
    parts = [(box((w - 0.01, 0.012, h - 0.01), (w / 2, 0, 0.005)), pane)]
    bars = [box((edge, thick, h), (x, 0, 0)) for x in (edge / 2, w - edge / 2)]
    bars += [box((w, thick, edge), (w / 2, 0, z)) for z in (0.0, h - edge)]
    rows = int(d.rng.integers(0, 4)) if d.chance(0.5) else 0
    bars += [box((w, thick * 0.7, edge * 0.6), (w / 2, 0, h * (k + 1) / (rows + 1))) for k in range(rows)]
    if d.chance(0.25):
        bars.append(box((edge * 0.6, thick * 0.7, h), (w / 2, 0, 0)))
    return [*parts, (join(bars), frame)]


def _frame_material(d: Draft) -> Material:
    pick = d.rng.random()
    return d.palette.paint() if pick < 0.5 else d.palette.wood() if pick < 0.75 else d.palette.metal()


def large_window(d: Draft, width: float | None = None, height: float | None = None) -> None:
    """A window of one to four leaves side by side; the origin is its lower edge at the wall."""
    w, h = width or d.u(1.3, 3.0), height or d.u(1.1, 2.2)
    frame, pane, count = _frame_material(d), _pane(d), int(d.rng.integers(1, 5))
    each, out = w / count, d.u(0.02, 0.06)
    for k in range(count):
        for mesh, material in _leaf(d, (each, h), pane, frame):
            d.add(mesh.moved((-w / 2 + each * k, out, 0)), material)
    if d.chance(0.4):
        d.add(box((w + 0.1, d.u(0.08, 0.25), 0.03), (0, 0.06, -0.03)), d.palette.paint())


def folding_door(d: Draft, width: float | None = None, height: float | None = None) -> None:
    """Leaves hinged to each other, shut or a little folded, glazed or of boards."""
    count, h = int(d.rng.integers(2, 6)), height or d.u(1.95, 2.3)
    each = (width or count * d.u(0.45, 0.9)) / count
    frame, pane = _frame_material(d), _pane(d) if d.chance(0.6) else d.palette.wood()
    fold = d.u(0.0, 0.35) if d.chance(0.5) else 0.0
    x, side = -each * count * float(np.cos(fold)) / 2, 0.04
    for k in range(count):
        angle = fold if k % 2 == 0 else -fold
        for mesh, material in _leaf(d, (each, h), pane, frame):
            d.add(mesh.moved((x, side + (0 if k % 2 == 0 else each * float(np.sin(fold))), 0.01), yaw=angle), material)
        x += each * float(np.cos(fold))
    if d.chance(0.6):
        d.add(box((each * count + 0.1, 0.09, 0.05), (0, 0.045, h + 0.01)), frame)


def sliding_door(d: Draft, width: float | None = None, height: float | None = None) -> None:
    """Two or three large leaves, one before another, some of them open."""
    count, h = int(d.rng.integers(2, 4)), height or d.u(1.95, 2.4)
    each = (width or count * d.u(0.7, 1.1)) / count
    frame, pane = _frame_material(d), _pane(d) if d.chance(0.8) else d.palette.paint()
    w = each * count
    for k in range(count):
        shift = -d.u(0.2, 0.9) * each if k == count - 1 and d.chance(0.3) else 0.0
        for mesh, material in _leaf(d, (each + 0.03, h), pane, frame):
            d.add(mesh.moved((-w / 2 + each * k + shift, 0.03 + 0.045 * (k % 2), 0.01)), material)
    for x in (-w / 2 - 0.03, w / 2 + 0.03):
        d.add(box((0.06, 0.12, h + 0.06), (x, 0.06, 0)), frame)
    d.add(box((w + 0.12, 0.12, 0.06), (0, 0.06, h)), frame)


def plain_door(d: Draft, width: float, height: float) -> None:
    """A leaf without a frame, with a handle."""
    d.add(box((width, 0.04, height), (0, 0.02, 0)), d.palette.paint() if d.rng.random() < 0.6 else d.palette.wood())
    d.add(box((0.12, 0.05, 0.02), (width / 2 - 0.12, 0.06, 1.0)), d.palette.metal())


def panel(d: Draft) -> None:
    """A board before a wall: boarding, an upholstered headboard, a sound absorber; its origin is at the wall."""
    w, h, t = d.u(0.5, 2.6), d.u(0.4, 2.2), d.u(0.012, 0.07)
    material = [d.palette.wood, d.palette.fabric, d.palette.paint][int(d.rng.integers(3))]()
    columns = int(d.rng.integers(1, 7)) if d.chance(0.5) else 1
    gap = d.u(0.004, 0.03) if columns > 1 else 0.0
    for k in range(columns):
        each = w / columns
        d.add(box((each - gap, t, h), (-w / 2 + each * (k + 0.5), t / 2, 0)), material)


def board(d: Draft) -> None:
    """A board to write or pin on, in a thin frame."""
    w, h = d.u(0.5, 1.8), d.u(0.4, 1.1)
    face = d.palette.paint() if d.chance(0.6) else d.palette.printed()
    d.add(box((w, 0.015, h), (0, 0.012, 0)), face)
    frame = d.palette.metal() if d.chance(0.6) else d.palette.wood()
    for z in (0.0, h - 0.02):
        d.add(box((w + 0.02, 0.025, 0.02), (0, 0.014, z)), frame)
    for x in (-w / 2, w / 2):
        d.add(box((0.02, 0.025, h), (x, 0.014, 0)), frame)
    if d.chance(0.5):
        d.add(box((w * 0.6, 0.06, 0.012), (0, 0.04, -0.012)), frame)


def long_curtain(d: Draft, width: float | None = None, height: float | None = None) -> None:
    """A curtain across a wall, drawn; its origin is the middle of its lower edge at the wall."""
    w, h = width or d.u(1.2, 3.4), height or d.u(1.9, 2.4)
    columns, rows = 160, 4
    folds = w / d.u(0.1, 0.3)
    x = np.linspace(-w / 2, w / 2, columns)
    depth = d.u(0.015, 0.05)
    y = 0.08 + depth * np.sin(np.linspace(0, 2 * np.pi * folds, columns) + 0.6 * np.sin(x * 7 + d.u(0, 6)))
    z = np.linspace(0, h, rows)
    grid = np.stack([np.tile(x, (rows, 1)), np.tile(y, (rows, 1)), np.repeat(z[:, None], columns, 1)], -1)
    d.add(Mesh(grid.reshape(-1, 3), grid_triangles(rows, columns)), d.palette.fabric())
    if d.chance(0.7):
        d.add(rod((-w / 2 - 0.08, 0.08, h + 0.01), (w / 2 + 0.08, 0.08, h + 0.01), 0.013), d.palette.metal())


def lamella_blind(d: Draft, width: float | None = None, height: float | None = None) -> None:
    """Upright lamellas side by side below a rail."""
    w, h, turn = width or d.u(1.0, 2.6), height or d.u(1.2, 2.3), d.u(-1.0, 1.0)
    material = d.palette.fabric()
    pieces = [box((0.12, 0.003, h)).moved((float(x), 0.07, 0), yaw=turn) for x in np.arange(-w / 2, w / 2, 0.11)]
    d.add(join(pieces), material)
    d.add(box((w, 0.05, 0.04), (0, 0.06, h)), d.palette.paint())


def fronts(d: Draft, size: tuple[float, float], base: tuple[float, float, float]) -> None:
    """Add the fronts of a built-in body: doors with gaps, knobs or none, at times a row of drawers; parts of it."""
    w, h = size
    body = d.parts[-1][1]
    face = body if d.chance(0.5) else d.palette.paint() if d.chance(0.5) else d.palette.wood()
    metal, columns = d.palette.metal(), max(1, round(w / d.u(0.4, 0.75)))
    rows = [0.0, 1.0] if h < 1.2 or d.chance(0.5) else [0.0, d.u(0.6, 0.82), 1.0]
    each, knob, ajar = w / columns, int(d.rng.integers(3)), int(d.rng.integers(columns)) if d.chance(0.15) else -1
    for k in range(columns):
        for low, high in pairwise(rows):
            tall, z = h * (high - low), base[2] + h * low
            leaf = [box((each - 0.008, 0.018, tall - 0.008), (each / 2, 0.009, 0.004))]
            if d.chance(0.15):
                leaf.append(box((each * 0.7, 0.008, tall * 0.8), (each / 2, 0.022, tall * 0.1)))
            grip = rod((each * 0.9, 0.04, tall * 0.4), (each * 0.9, 0.04, tall * 0.55), 0.008)
            if knob == 1:
                grip = cylinder(0.015, 0.02).moved((each * 0.9, 0.02, tall * 0.5), roll=-np.pi / 2)
            angle = d.u(0.1, 1.2) if k == ajar else 0.0
            at = (base[0] - w / 2 + each * k, base[1], z)
            d.add(join(leaf).moved(at, yaw=angle), face)
            if knob:
                d.add(grip.moved(at, yaw=angle), metal)


def built_in_wardrobe(
    d: Draft, width: float | None = None, height: float | None = None, depth: float | None = None
) -> None:
    """A wardrobe or tall cabinet from floor to near the ceiling."""
    w, h, t = width or d.u(0.9, 3.2), height or d.u(1.9, 2.35), depth or d.u(0.3, 0.65)
    body = d.palette.paint() if d.chance(0.5) else d.palette.wood()
    d.add(box((w, t, h), (0, 0, 0)), body)
    foot = d.u(0.0, 0.1)
    if d.chance(0.3):
        drawers(d, (w, h - foot), (0, t / 2, foot), int(d.rng.integers(4, 8)), max(1, round(w / 0.8)))
    else:
        fronts(d, (w, h - foot), (0, t / 2, foot))


def shelf_wall(d: Draft, width: float | None = None, height: float | None = None, depth: float | None = None) -> None:
    """Shelves across a wall, the lowest row at times closed."""
    w, h, t = width or d.u(1.2, 2.8), height or d.u(1.6, 2.35), depth or d.u(0.22, 0.42)
    wood, thick = d.palette.wood(), d.u(0.018, 0.04)
    columns, rows = max(1, round(w / d.u(0.45, 0.9))), max(2, round(h / d.u(0.3, 0.45)))
    d.add(box((w, 0.01, h), (0, -t / 2 + 0.005, 0)), wood)
    for k in range(columns + 1):
        d.add(box((thick, t, h), (-w / 2 + (w - thick) * k / columns + thick / 2, 0, 0)), wood)
    closed = int(d.chance(0.5))
    for r in range(rows + 1):
        z = (h - thick) * r / rows
        d.add(box((w - thick, t - 0.01, thick), (0, 0.005, z)), wood)
        for k in range(columns):
            x = -w / 2 + w * k / columns
            if closed <= r < rows:
                low, high = (x + 0.04, -t / 2 + 0.03), (x + w / columns - 0.04, t / 2 - 0.01)
                d.zones.append(Zone(low, high, z + thick, h / rows - thick - 0.02, "shelf"))
    if closed:
        d.add(box((w - 2 * thick, t - 0.03, h / rows - thick), (0, 0, thick)), wood)
        fronts(d, (w - 2 * thick, h / rows - thick), (0, t / 2 - 0.015, thick))


def kitchen_run(d: Draft, width: float | None = None) -> None:
    """Base units under a worktop with a sink and a hob; wall cupboards and a hood above are things of their own."""
    w, t, h = width or d.u(1.6, 3.6), d.u(0.55, 0.68), d.u(0.84, 0.96)
    body = d.palette.paint() if d.chance(0.6) else d.palette.wood()
    d.add(box((w, t - 0.08, 0.1), (0, -0.04, 0)), d.palette.paint())
    d.add(box((w, t, h - 0.14), (0, 0, 0.1)), body)
    fronts(d, (w * 0.6, h - 0.16), (-w * 0.2, t / 2, 0.11))
    drawers(d, (w * 0.4, h - 0.16), (w * 0.3, t / 2, 0.11), int(d.rng.integers(2, 5)))
    top = d.palette.wood() if d.chance(0.5) else d.palette.paint()
    d.add(box((w, t + 0.03, 0.04), (0, 0.015, h - 0.04)), top)
    if d.chance(0.4):
        d.add(box((w, 0.02, d.u(0.08, 0.5)), (0, -t / 2 + 0.01, h)), top)
    sink, hob = -w * d.u(0.2, 0.32), w * d.u(0.18, 0.32)
    _sink(d, (sink, 0.0, h))
    d.add(box((0.56, 0.5, 0.008), (hob, 0, h)), d.palette.screen())
    for low, high in ((-w / 2, sink - 0.28), (sink + 0.28, hob - 0.3), (hob + 0.3, w / 2)):
        if high - low > 0.15:
            d.zones.append(Zone((low + 0.02, -t / 2 + 0.04), (high - 0.02, t / 2 - 0.02), h, 0.5))
    if d.chance(0.75):
        _above(d, (w, t, hob))


def _sink(d: Draft, at: tuple[float, float, float]) -> None:
    """A hollow of metal set into a top, drawn as a rim with a dark bottom, and its tap."""
    metal, (x, y, z) = d.palette.metal(), at
    for side in (-1, 1):
        d.add(box((0.03, 0.42, 0.012), (x + side * 0.24, y, z)), metal)
        d.add(box((0.5, 0.03, 0.012), (x, y + side * 0.2, z)), metal)
    d.add(box((0.46, 0.38, 0.003), (x, y, z)), metal)
    d.add(rod((x, y - 0.22, z), (x, y - 0.22, z + 0.25), 0.013), metal)
    d.add(rod((x, y - 0.22, z + 0.25), (x, y - 0.04, z + 0.22), 0.011), metal)


def _above(d: Draft, run: tuple[float, float, float]) -> None:
    """Hang cupboards over a worktop, and a hood over its hob."""
    w, t, hob = run
    low, tall, deep = d.u(1.35, 1.5), d.u(0.5, 0.8), d.u(0.3, 0.38)
    ends = [(-w / 2, hob - 0.31), (hob + 0.31, w / 2)] if d.chance(0.7) else [(-w / 2, w / 2)]
    for left, right in ends:
        if right - left > 0.3 and d.chance(0.8):
            child = d.child()
            child.add(box((right - left, deep, tall), (0, 0, 0)), d.palette.paint())
            fronts(child, (right - left, tall), (0, deep / 2, 0))
            d.lay("cupboard", child, pose_of(((left + right) / 2, -t / 2 + deep / 2 + 0.002, low)))
    if len(ends) == 2 and d.chance(0.8):
        child, metal = d.child(), d.palette.metal()
        child.add(box((0.58, d.u(0.3, 0.5), 0.1), (0, 0.05, 0)), metal)
        child.add(box((0.25, 0.22, d.u(0.4, 0.7)), (0, 0, 0.1)), metal)
        d.lay("hood", child, pose_of((hob, -t / 2 + 0.17, low + 0.05)))


def island(d: Draft) -> None:
    """A counter that stands free, with room for knees on one side at times."""
    w, t, h = d.u(1.0, 2.4), d.u(0.6, 1.0), d.u(0.85, 1.05)
    body = d.palette.paint() if d.chance(0.5) else d.palette.wood()
    over = d.u(0.0, 0.3)
    d.add(box((w, t - over, h - 0.04), (0, over / 2, 0)), body)
    fronts(d, (w, h - 0.06), (0, t / 2, 0.01))
    d.add(box((w + 0.05, t + 0.05, 0.04), (0, 0, h - 0.04)), d.palette.wood())
    d.zones.append(Zone((-w / 2 + 0.02, -t / 2 + 0.02), (w / 2 - 0.02, t / 2 - 0.02), h, 0.6))


def air_conditioner(d: Draft) -> None:
    """A unit high on a wall, or a column on the floor."""
    paint = d.palette.paint()
    if d.chance(0.6):
        w, t = d.u(0.7, 1.0), d.u(0.16, 0.25)
        d.add(soft_box((w, t, 0.28), (0, t / 2, 1.0), 0.03), paint)
        d.add(box((w * 0.9, 0.01, 0.06), (0, t, 1.02)), d.palette.paint())
    else:
        w = d.u(0.32, 0.5)
        d.add(soft_box((w, w * 0.8, d.u(1.6, 1.9)), (0, w * 0.4, 0), 0.02), paint)
        d.add(box((w * 0.8, 0.01, 0.3), (0, w * 0.8, 1.2)), d.palette.paint())


def large_picture(d: Draft) -> None:
    """A large picture, framed or on bare canvas; the origin is the middle of its lower edge at the wall."""
    w, h, t = d.u(0.7, 2.0), d.u(0.5, 1.4), d.u(0.012, 0.04)
    d.add(box((w, t, h), (0, t / 2, 0)), d.palette.printed())
    if d.chance(0.6):
        frame, e = d.palette.wood(), d.u(0.01, 0.06)
        for side in (-1, 1):
            d.add(box((e, t + 0.012, h), (side * (w - e) / 2, t / 2 + 0.006, 0)), frame)
            d.add(box((w, t + 0.012, e), (0, t / 2 + 0.006, (h - e) * (side + 1) / 2)), frame)


def folding_screen(d: Draft) -> None:
    """A screen of leaves that stands free in a zigzag."""
    count, each, h = int(d.rng.integers(2, 5)), d.u(0.4, 0.7), d.u(1.3, 2.0)
    fold, material = d.u(0.2, 0.7), d.palette.wood() if d.chance(0.5) else d.palette.fabric()
    x = -each * count * float(np.cos(fold)) / 2
    for k in range(count):
        leaf = box((each, 0.025, h), (each / 2, 0, 0.02))
        y = 0.0 if k % 2 == 0 else each * float(np.sin(fold))
        d.add(leaf.moved((x, y, 0), yaw=fold if k % 2 == 0 else -fold), material)
        x += each * float(np.cos(fold))
