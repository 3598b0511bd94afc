"""Shelves, cupboards, wardrobes, drawers and appliances."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from training.worlds.draft import Draft, Zone
from training.worlds.mesh import bar, box, cylinder, lathe, rod, soft_box
from training.worlds.tables import drawers


def shelf(d: Draft) -> None:
    """An open shelf, with or without a back, whose boards carry things."""
    wood = d.palette.wood()
    width, depth, height = d.u(0.4, 1.3), d.u(0.22, 0.42), d.u(0.7, 2.1)
    thick, boards = d.u(0.015, 0.03), max(2, round(height / d.u(0.28, 0.42)))
    columns = int(d.rng.integers(1, 4)) if width > 0.7 else 1
    for side in (-1, 1):
        d.add(box((thick, depth, height), (side * (width - thick) / 2, 0, 0)), wood)
    if d.chance(0.6):
        d.add(box((width, 0.01, height), (0, -depth / 2 + 0.005, 0)), wood if d.chance(0.6) else d.palette.paint())
    levels = np.linspace(0.05, height - thick, boards + 1)
    for z in levels:
        d.add(box((width - 2 * thick, depth - 0.01, thick), (0, 0.005, float(z))), wood)
    for k in range(1, columns):
        d.add(box((thick, depth - 0.01, height - 0.05), (-width / 2 + width * k / columns, 0.005, 0.05)), wood)
    step = width / columns
    for low, high in pairwise(levels):
        for k in range(columns):
            x = -width / 2 + step * k
            zone = Zone(
                (x + 0.03, -depth / 2 + 0.02),
                (x + step - 0.03, depth / 2),
                float(low) + thick,
                float(high - low) - thick - 0.01,
                "shelf",
            )
            d.zones.append(zone)
    d.zones.append(Zone((-width / 2 + 0.02, -depth / 2 + 0.02), (width / 2 - 0.02, depth / 2 - 0.01), height, 0.4))


def frame_shelf(d: Draft) -> None:
    """A shelf of thin posts and boards."""
    metal, wood = d.palette.metal(), d.palette.wood()
    width, depth, height = d.u(0.5, 1.0), d.u(0.28, 0.45), d.u(0.8, 1.9)
    d.legs((width, depth), height, 0.025, metal)
    levels = np.linspace(d.u(0.08, 0.2), height - 0.02, int(d.rng.integers(3, 6)))
    for k, z in enumerate(levels):
        d.add(box((width, depth, 0.02), (0, 0, float(z))), wood)
        room = float(levels[k + 1] - z) - 0.03 if k + 1 < len(levels) else 0.4
        d.zones.append(
            Zone(
                (-width / 2 + 0.03, -depth / 2 + 0.03),
                (width / 2 - 0.03, depth / 2 - 0.03),
                float(z) + 0.02,
                room,
                "shelf",
            )
        )


def cupboard(d: Draft) -> None:
    """A closed cupboard or sideboard with doors, one of them ajar at times."""
    wood = d.palette.wood()
    width, depth, height, foot = d.u(0.6, 1.8), d.u(0.35, 0.55), d.u(0.6, 1.3), d.u(0.0, 0.15)
    d.add(box((width, depth, height - foot), (0, 0, foot)), wood)
    d.legs((width, depth), foot + 0.01, 0.04, wood)
    _doors(d, (width, height - foot), (0, depth / 2, foot), max(1, round(width / d.u(0.4, 0.6))))
    d.zones.append(Zone((-width / 2 + 0.02, -depth / 2 + 0.02), (width / 2 - 0.02, depth / 2 - 0.02), height, 0.8))


def _doors(d: Draft, size: tuple[float, float], base: tuple[float, float, float], count: int) -> None:
    front, metal = d.parts[-1][1] if d.chance(0.7) else d.palette.wood(), d.palette.metal()
    each, ajar = size[0] / count, int(d.rng.integers(count)) if d.chance(0.2) else -1
    for k in range(count):
        x = base[0] - size[0] / 2 + each * k
        leaf = box((each - 0.008, 0.02, size[1] - 0.02), (each / 2, 0.01, 0.01))
        handle = rod((each * 0.88, 0.045, size[1] * 0.45), (each * 0.88, 0.045, size[1] * 0.6), 0.007)
        angle = d.u(0.2, 1.4) if k == ajar else 0.0
        for mesh, material in ((leaf, front), (handle, metal)):
            d.add(mesh.moved((x, base[1], base[2]), yaw=angle), material)


def wardrobe(d: Draft) -> None:
    """A tall closed wardrobe."""
    wood, width, depth, height = d.palette.wood(), d.u(0.8, 2.2), d.u(0.5, 0.65), d.u(1.7, 2.3)
    d.add(box((width, depth, height), (0, 0, 0)), wood)
    _doors(d, (width, height - 0.08), (0, depth / 2, 0.06), max(2, round(width / d.u(0.45, 0.7))))
    d.zones.append(Zone((-width / 2 + 0.02, -depth / 2 + 0.02), (width / 2 - 0.02, depth / 2 - 0.02), height, 0.3))


def chest(d: Draft) -> None:
    """A chest of drawers."""
    wood, width, depth, height = d.palette.wood(), d.u(0.5, 1.4), d.u(0.38, 0.55), d.u(0.6, 1.2)
    foot = d.u(0, 0.12)
    d.add(box((width, depth, height - foot), (0, 0, foot)), wood)
    d.legs((width, depth), foot + 0.01, 0.04, wood)
    drawers(d, (width, height - foot), (0, depth / 2, foot), int(d.rng.integers(3, 6)), 1 if width < 0.9 else 2)
    d.add(box((width + 0.02, depth + 0.02, 0.02), (0, 0, height)), wood)
    d.zones.append(
        Zone((-width / 2 + 0.02, -depth / 2 + 0.02), (width / 2 - 0.02, depth / 2 - 0.02), height + 0.02, 0.8)
    )


def media_bench(d: Draft) -> None:
    """A low bench for a television, open or with fronts."""
    wood, width, depth, height = d.palette.wood(), d.u(1.0, 2.0), d.u(0.35, 0.5), d.u(0.35, 0.6)
    d.add(box((width, depth, 0.03), (0, 0, height - 0.03)), wood)
    d.add(box((width, depth, 0.03), (0, 0, 0.06)), wood)
    for x in np.linspace(-0.5, 0.5, int(d.rng.integers(2, 5))):
        d.add(box((0.025, depth, height), (float(x) * (width - 0.03), 0, 0)), wood)
    if d.chance(0.5):
        d.add(box((width * 0.5, depth * 0.97, height - 0.12), (-width * 0.25, 0, 0.08)), wood)
        drawers(d, (width * 0.5, height - 0.12), (-width * 0.25, depth / 2 - 0.01, 0.08), 1, 2)
    d.zones.append(
        Zone((-width / 2 + 0.02, -depth / 2 + 0.02), (width / 2 - 0.02, depth / 2 - 0.02), height, 0.9, "media")
    )


def fridge(d: Draft) -> None:
    """A refrigerator."""
    paint, width, height = d.palette.paint(), d.u(0.54, 0.7), d.u(0.85, 1.95)
    d.add(soft_box((width, 0.6, height), (0, 0, 0), 0.015), paint)
    split = height * d.u(0.55, 0.75)
    for low, high in ((0.04, split - 0.005), (split + 0.005, height - 0.01)):
        d.add(box((width - 0.01, 0.04, high - low), (0, 0.315, low)), paint)
        d.add(
            rod((width * 0.42, 0.36, low + (high - low) * 0.3), (width * 0.42, 0.36, low + (high - low) * 0.6), 0.01),
            d.palette.metal(),
        )
    d.zones.append(Zone((-width / 2 + 0.03, -0.27), (width / 2 - 0.03, 0.27), height, 0.4))


def washer(d: Draft) -> None:
    """A washing machine, or an oven, with a round or square window."""
    paint = d.palette.paint()
    d.add(soft_box((0.6, 0.58, 0.85), (0, 0, 0), 0.012), paint)
    if d.chance(0.5):
        d.add(cylinder(0.17, 0.03, sides=28).moved((0, 0.29, 0.42), roll=-np.pi / 2), d.palette.screen())
    else:
        d.add(box((0.5, 0.02, 0.45), (0, 0.3, 0.15)), d.palette.screen())
        d.add(rod((-0.2, 0.34, 0.64), (0.2, 0.34, 0.64), 0.01), d.palette.metal())
    d.add(box((0.56, 0.01, 0.08), (0, 0.293, 0.75)), d.palette.paint())
    d.zones.append(Zone((-0.27, -0.26), (0.27, 0.26), 0.85, 0.6))


def shoe_rack(d: Draft) -> None:
    """A low rack of rods or boards, full of shoes."""
    metal, width, depth, height = d.palette.metal(), d.u(0.5, 0.9), d.u(0.25, 0.33), d.u(0.35, 0.6)
    d.legs((width, depth), height, 0.02, metal)
    for z in np.linspace(0.1, height - 0.02, int(d.rng.integers(2, 4))):
        for y in np.linspace(-depth / 2 + 0.02, depth / 2 - 0.02, 6):
            d.add(rod((-width / 2, float(y), float(z)), (width / 2, float(y), float(z)), 0.008), metal)
        d.zones.append(
            Zone((-width / 2 + 0.03, -depth / 2), (width / 2 - 0.03, depth / 2), float(z) + 0.008, 0.2, "shoes")
        )


def coat_stand(d: Draft) -> None:
    """A stand with hooks."""
    wood, height = d.palette.wood(), d.u(1.6, 1.9)
    d.add(rod((0, 0, 0.0), (0, 0, height), 0.02), wood)
    d.add(lathe([(0, 0.04), (0.16, 0.02), (0.17, 0.0)]), wood)
    for k in range(6):
        a = k * np.pi / 3
        d.add(bar((0, 0, height - 0.1), (0.14 * float(np.cos(a)), 0.14 * float(np.sin(a)), height), 0.02, 0.02), wood)


def wall_shelf(d: Draft) -> None:
    """A board on a wall; its origin is its underside at the wall."""
    wood, width, depth = d.palette.wood(), d.u(0.4, 1.2), d.u(0.15, 0.28)
    d.add(box((width, depth, 0.025), (0, depth / 2, 0)), wood)
    d.zones.append(Zone((-width / 2 + 0.02, 0.01), (width / 2 - 0.02, depth - 0.01), 0.025, 0.35, "shelf"))


def wall_cupboard(d: Draft) -> None:
    """A closed cupboard on a wall."""
    wood, width, depth, height = d.palette.wood(), d.u(0.4, 1.6), d.u(0.28, 0.38), d.u(0.4, 0.8)
    d.add(box((width, depth, height), (0, depth / 2, 0)), wood)
    _doors(d, (width, height), (0, depth, 0), max(1, round(width / 0.45)))
