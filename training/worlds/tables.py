"""Tables, desks and what stands beside beds."""

from __future__ import annotations

import numpy as np

from training.worlds.draft import Draft, Zone
from training.worlds.mesh import bar, box, cylinder, lathe, rod, soft_box


def _top_zone(d: Draft, width: float, depth: float, z: float, use: str = "top", clearance: float = 0.9) -> None:
    margin = 0.02
    d.zones.append(
        Zone((-width / 2 + margin, -depth / 2 + margin), (width / 2 - margin, depth / 2 - margin), z, clearance, use)
    )


def dining_table(d: Draft) -> None:
    """A table for two to eight on four legs, trestles or plates."""
    wood = d.palette.wood()
    width, depth, height, thick = d.u(0.75, 2.0), d.u(0.65, 1.0), d.u(0.7, 0.78), d.u(0.02, 0.06)
    d.add(box((width, depth, thick), (0, 0, height - thick)), wood)
    build = int(d.rng.integers(3))
    if build == 0:
        d.legs(
            (width - d.u(0, 0.2), depth - d.u(0, 0.1)),
            height - thick,
            d.u(0.04, 0.09),
            wood if d.chance(0.6) else d.palette.metal(),
        )
        if d.chance(0.5):
            for side in (-1, 1):
                d.add(box((width * 0.9, 0.025, 0.08), (0, side * depth * 0.42, height - thick - 0.08)), wood)
    elif build == 1:
        frame = d.palette.metal()
        for side in (-1, 1):
            x = side * width * 0.36
            d.add(bar((x, -depth * 0.4, 0), (x, -depth * 0.1, height - thick), 0.04, 0.04), frame)
            d.add(bar((x, depth * 0.4, 0), (x, depth * 0.1, height - thick), 0.04, 0.04), frame)
        d.add(bar((-width * 0.36, 0, 0.3), (width * 0.36, 0, 0.3), 0.03, 0.03), frame)
    else:
        for side in (-1, 1):
            d.add(box((0.05, depth * 0.85, height - thick), (side * width * 0.42, 0, 0)), wood)
    _top_zone(d, width, depth, height)


def round_table(d: Draft) -> None:
    """A round table on one column or four legs."""
    wood = d.palette.wood()
    radius, height = d.u(0.3, 0.65), d.u(0.68, 0.78)
    d.add(cylinder(radius, 0.03, (0, 0, height - 0.03), sides=36), wood)
    if d.chance(0.6):
        d.add(cylinder(d.u(0.03, 0.06), height, (0, 0, 0)), d.palette.metal())
        d.add(cylinder(radius * 0.6, 0.03, (0, 0, 0), radius * 0.2, sides=24), d.palette.metal())
    else:
        d.legs((radius * 1.3, radius * 1.3), height - 0.02, 0.05, wood, 0.05)
    side = radius * 1.35
    _top_zone(d, side, side, height)


def coffee_table(d: Draft) -> None:
    """A low table, often with a second board."""
    wood = d.palette.wood()
    width, depth, height = d.u(0.6, 1.3), d.u(0.4, 0.8), d.u(0.32, 0.5)
    if d.chance(0.25):
        d.add(cylinder(depth / 2, 0.03, (0, 0, height - 0.03), sides=32), wood)
        d.legs((depth * 0.6, depth * 0.6), height - 0.02, 0.035, wood, 0.06)
        _top_zone(d, depth * 0.66, depth * 0.66, height)
        return
    thick = d.u(0.02, 0.06)
    d.add(box((width, depth, thick), (0, 0, height - thick)), wood)
    d.legs((width, depth), height - thick, d.u(0.03, 0.08), wood if d.chance(0.7) else d.palette.metal())
    if d.chance(0.5):
        d.add(box((width - 0.06, depth - 0.06, 0.02), (0, 0, 0.12)), wood)
        _top_zone(d, width - 0.1, depth - 0.1, 0.14, "shelf", height - thick - 0.15)
    _top_zone(d, width, depth, height)


def desk(d: Draft) -> None:
    """A desk, with drawers on one side or only legs, some with a modesty panel or a raised back."""
    wood, frame = d.palette.wood(), d.palette.metal()
    width, depth, height = d.u(1.0, 1.8), d.u(0.55, 0.85), d.u(0.7, 0.76)
    d.add(box((width, depth, 0.03), (0, 0, height - 0.03)), wood)
    d.legs((width, depth), height - 0.03, d.u(0.03, 0.06), frame if d.chance(0.5) else wood)
    if d.chance(0.5):
        block = d.u(0.35, 0.45)
        side = -1 if d.chance(0.5) else 1
        x, tall = side * (width / 2 - block / 2 - 0.03), height - 0.1
        d.add(box((block, depth * 0.9, tall), (x, 0, 0.06)), wood)
        drawers(d, (block, tall), (x, depth * 0.45, 0.06), int(d.rng.integers(2, 5)))
    if d.chance(0.3):
        d.add(box((width * 0.9, 0.02, 0.35), (0, -depth / 2 + 0.05, height - 0.4)), wood)
    _top_zone(d, width, depth, height, "desk")


def drawers(
    d: Draft, size: tuple[float, float], base: tuple[float, float, float], count: int, columns: int = 1
) -> None:
    """Add fronts with handles to a body; parts of it, one of them ajar at times."""
    front = d.parts[-1][1] if d.chance(0.7) else d.palette.wood()
    metal, knob = d.palette.metal(), d.chance(0.5)
    wide, tall = size[0] / columns, size[1] / count
    ajar = int(d.rng.integers(count * columns)) if d.chance(0.25) else -1
    for k in range(count * columns):
        row, column = divmod(k, columns)
        out = d.u(0.05, 0.25) if k == ajar else 0.0
        x, z = base[0] - size[0] / 2 + wide * (column + 0.5), base[2] + tall * row
        y = base[1] + out
        d.add(box((wide - 0.012, 0.02 + out, tall - 0.012), (x, y + 0.01 - out / 2, z + 0.006)), front)
        if knob:
            d.add(cylinder(0.012, 0.025, (0, 0, 0), sides=8).moved((x, y + 0.02, z + tall / 2), roll=-np.pi / 2), metal)
        else:
            d.add(
                rod((x - wide * 0.15, y + 0.045, z + tall * 0.6), (x + wide * 0.15, y + 0.045, z + tall * 0.6), 0.006),
                metal,
            )


def nightstand(d: Draft) -> None:
    """A small cupboard beside a bed."""
    wood = d.palette.wood()
    width, depth, height = d.u(0.35, 0.55), d.u(0.3, 0.45), d.u(0.4, 0.65)
    foot = d.u(0, 0.2)
    if d.chance(0.6):
        d.add(box((width, depth, height - foot), (0, 0, foot)), wood)
        drawers(d, (width, height - foot), (0, depth / 2, foot), int(d.rng.integers(1, 4)))
        d.legs((width, depth), foot + 0.02, 0.03, wood)
    else:
        d.legs((width, depth), height, 0.035, wood)
        for z in (height - 0.02, 0.15):
            d.add(box((width, depth, 0.02), (0, 0, z)), wood)
        _top_zone(d, width - 0.06, depth - 0.04, 0.17, "shelf", height - 0.2)
    _top_zone(d, width, depth, height)


def side_table(d: Draft) -> None:
    """A small table, round or square."""
    material = d.palette.wood() if d.chance(0.6) else d.palette.metal()
    size, height = d.u(0.3, 0.5), d.u(0.4, 0.65)
    if d.chance(0.5):
        d.add(cylinder(size / 2, 0.02, (0, 0, height - 0.02), sides=28), material)
        if d.chance(0.5):
            d.add(cylinder(0.02, height - 0.02, (0, 0, 0)), material)
            d.add(lathe([(0, 0.02), (size * 0.35, 0.012), (size * 0.35, 0)], sides=24), material)
        else:
            d.legs((size * 0.7, size * 0.7), height, 0.02, material, 0.03)
        _top_zone(d, size * 0.66, size * 0.66, height)
    else:
        d.add(box((size, size, 0.03), (0, 0, height - 0.03)), material)
        d.legs((size, size), height, 0.03, material)
        _top_zone(d, size, size, height)


def kitchen_counter(d: Draft) -> None:
    """Base units under one worktop, with fronts, a sink or a hob."""
    body, width, depth, height = d.palette.paint(), d.u(1.2, 2.6), 0.6, d.u(0.85, 0.95)
    d.add(box((width, depth - 0.06, 0.1), (0, -0.03, 0)), d.palette.paint())
    d.add(box((width, depth, height - 0.14), (0, 0, 0.1)), body)
    drawers(d, (width, height - 0.14), (0, depth / 2, 0.1), int(d.rng.integers(1, 4)), max(2, round(width / 0.6)))
    d.add(box((width, depth + 0.03, 0.04), (0, 0, height - 0.04)), d.palette.wood())
    metal, x = d.palette.metal(), d.u(-0.3, 0.3) * width
    if d.chance(0.6):
        d.add(box((0.5, 0.4, 0.005), (x, 0, height)), metal)
        d.add(rod((x, -0.22, height), (x, -0.22, height + 0.25), 0.012), metal)
        d.add(rod((x, -0.22, height + 0.25), (x, -0.05, height + 0.2), 0.01), metal)
    else:
        d.add(box((0.55, 0.5, 0.008), (x, 0, height)), d.palette.screen())
    _top_zone(d, width, depth, height)


def bar_table(d: Draft) -> None:
    """A high narrow table."""
    wood, width, depth, height = d.palette.wood(), d.u(0.6, 1.4), d.u(0.4, 0.6), d.u(0.95, 1.1)
    d.add(soft_box((width, depth, 0.04), (0, 0, height - 0.04), 0.01), wood)
    d.legs((width, depth), height - 0.02, 0.05, d.palette.metal())
    _top_zone(d, width, depth, height)
