"""Beds, curtains, rugs, clothes, bags and other cloth."""

from __future__ import annotations

import numpy as np

from training.worlds.draft import Draft, Zone, pose_of
from training.worlds.mesh import (
    Mesh,
    bar,
    box,
    cloth,
    cylinder,
    grid_triangles,
    join,
    lathe,
    pillow,
    rod,
    soft_box,
    tube,
    turn,
    waves,
)


def bed(d: Draft) -> None:
    """A bed with a mattress of its own, and a duvet and pillows that are things of their own."""
    wood, sheet = d.palette.wood(), d.palette.fabric()
    width, length, frame, top = d.u(0.85, 1.9), d.u(1.9, 2.1), d.u(0.2, 0.35), d.u(0.4, 0.62)
    d.add(box((width, length, frame - 0.1), (0, 0, 0.1)), wood if d.chance(0.7) else d.palette.fabric())
    d.legs((width, length), 0.12, 0.06, wood)
    d.add(box((width, 0.05, d.u(0.7, 1.1)), (0, -length / 2 - 0.025, 0)), wood if d.chance(0.6) else d.palette.fabric())
    if d.chance(0.3):
        d.add(box((width, 0.04, d.u(0.45, 0.7)), (0, length / 2 + 0.02, 0)), wood)
    d.add(soft_box((width * 0.98, length * 0.98, top - frame), (0, 0, frame), 0.05), sheet)
    count = 1 if width < 1.2 else 2
    same = d.palette.fabric()
    for k in range(count):
        child = d.child()
        child.add(pillow((d.u(0.5, 0.75), d.u(0.38, 0.6), d.u(0.1, 0.18))), same)
        x = (k - (count - 1) / 2) * width / count
        d.lay(
            "pillow",
            child,
            pose_of((x, -length / 2 + 0.3, top + 0.01), turn(d.u(-0.15, 0.15)) @ turn(roll=d.u(-0.1, 0.5))),
        )
    if d.chance(0.85):
        child = d.child()
        _duvet(child, width, length * d.u(0.5, 0.75), top)
        d.lay("duvet", child, pose_of((0, length / 2 - child.bounds()[1][1] - 0.0, top)))
    d.zones.append(
        Zone((-width / 2 + 0.1, -length / 2 + 0.6), (width / 2 - 0.1, length / 2 - 0.1), top + 0.07, 0.6, "bed")
    )


def _duvet(d: Draft, width: float, length: float, top: float) -> None:
    """A cover over the bed that hangs down on both sides."""
    columns, rows = 24, 22
    across = np.linspace(-0.5, 0.5, columns) * (width + d.u(0.1, 0.6))
    over = np.clip(np.abs(across) - width / 2, 0, top - 0.12)
    x = np.sign(across) * np.minimum(np.abs(across), width / 2 + 0.015 + 0.1 * over)
    y = np.linspace(-0.5, 0.5, rows) * length
    z = 0.05 - over[None, :] + np.abs(waves(d.rng, (rows, columns), 0.02, 4.0))
    points = np.stack(
        [np.broadcast_to(x, z.shape) + waves(d.rng, z.shape, 0.006), np.broadcast_to(y[:, None], z.shape), z], -1
    )
    d.add(Mesh(points.reshape(-1, 3), grid_triangles(rows, columns)), d.palette.fabric())


def crib(d: Draft) -> None:
    """A cot with bars."""
    wood, width, length, tall = d.palette.wood(), 0.65, d.u(1.1, 1.3), d.u(0.8, 0.95)
    d.legs((width, length), tall, 0.04, wood)
    d.add(soft_box((width - 0.06, length - 0.06, 0.1), (0, 0, 0.3), 0.03), d.palette.fabric())
    for side in (-1, 1):
        for z in (0.25, tall - 0.03):
            d.add(bar((side * width / 2, -length / 2, z), (side * width / 2, length / 2, z), 0.03, 0.03), wood)
            d.add(bar((-width / 2, side * length / 2, z), (width / 2, side * length / 2, z), 0.03, 0.03), wood)
        for y in np.linspace(-length / 2, length / 2, 14):
            d.add(rod((side * width / 2, float(y), 0.25), (side * width / 2, float(y), tall), 0.008, 5), wood)


def curtain(d: Draft) -> None:
    """A curtain in folds; its origin is the middle of its lower edge at the wall."""
    width, height, folds = d.u(0.3, 1.1), d.u(1.3, 2.3), d.u(5, 14)
    columns = 60
    x = np.linspace(-width / 2, width / 2, columns)
    y = 0.07 + 0.035 * np.sin(np.linspace(0, 2 * np.pi * folds, columns) + d.u(0, 6)) * d.u(0.5, 1.2)
    rows = 5
    pinch = np.linspace(1.0, d.u(0.85, 1.0), rows)
    points = np.stack(
        [
            x[None] * pinch[:, None],
            np.broadcast_to(y, (rows, columns)),
            np.broadcast_to(np.linspace(0, height, rows)[:, None], (rows, columns)),
        ],
        -1,
    )
    d.add(Mesh(points.reshape(-1, 3), grid_triangles(rows, columns)), d.palette.fabric())
    if d.chance(0.6):
        d.add(
            rod((-width / 2 - 0.1, 0.07, height + 0.01), (width / 2 + 0.1, 0.07, height + 0.01), 0.012),
            d.palette.metal(),
        )


def blind(d: Draft) -> None:
    """A blind of slats or cloth before a window."""
    width, height = d.u(0.6, 1.4), d.u(0.5, 1.4)
    material = d.palette.paint() if d.chance(0.5) else d.palette.fabric()
    if d.chance(0.5):
        for z in np.arange(0, height, 0.045):
            d.add(box((width, 0.035, 0.003)).moved((0, 0.04, float(z)), roll=0.6), material)
    else:
        d.add(box((width, 0.008, height), (0, 0.03, 0)), material)
    d.add(box((width, 0.05, 0.05), (0, 0.03, height)), material)


def rug(d: Draft) -> None:
    """A rug, flat or with a fold."""
    width, depth, thick = d.u(0.6, 2.4), d.u(0.5, 1.7), d.u(0.004, 0.025)
    if d.chance(0.2):
        d.add(lathe([(0, thick), (depth / 2, thick), (depth / 2, 0)], sides=40), d.palette.fabric())
        return
    rows, columns = 30, 40
    z = np.zeros((rows, columns))
    if d.chance(0.3):
        at = d.u(0.2, 0.8) * columns
        z += d.u(0.01, 0.04) * np.exp(
            -0.5 * ((np.arange(columns)[None] + d.u(-0.3, 0.3) * np.arange(rows)[:, None] - at) / 1.0) ** 2
        )
    d.add(cloth(z, (width, depth), thick), d.palette.fabric())


def folded_cloth(d: Draft) -> None:
    """A folded towel, blanket or pullover."""
    width, depth = d.u(0.2, 0.45), d.u(0.18, 0.35)
    layers, each = int(d.rng.integers(1, 5)), d.u(0.012, 0.03)
    material = d.palette.fabric()
    for k in range(layers):
        d.add(soft_box((width * d.u(0.96, 1), depth * d.u(0.96, 1), each), (0, 0, each * k), each * 0.48), material)


def dropped_cloth(d: Draft) -> None:
    """Clothes or a blanket thrown down in a heap."""
    size, height = d.u(0.3, 0.8), d.u(0.04, 0.14)
    n = 26
    y, x = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    angle = np.arctan2(y, x)
    rim = 0.75 + 0.2 * np.sin(2 * angle + d.u(0, 6)) * d.u(0, 1) + 0.12 * np.sin(5 * angle + d.u(0, 6))
    fall = np.clip(1 - np.hypot(x, y) / rim, 0, 1) ** 0.6
    z = fall * (height + np.abs(waves(d.rng, (n, n), height * 0.5, 2.5)))
    keep = np.hypot(x, y) < rim
    mesh = cloth(z, (size, size * d.u(0.7, 1.0)))
    inside = keep.ravel()[mesh.triangles].any(axis=1)
    d.add(Mesh(mesh.vertices, mesh.triangles[inside]), d.palette.fabric())


def throw(d: Draft) -> None:
    """A blanket laid out on a seat or a bed."""
    d.add(cloth(np.abs(waves(d.rng, (20, 24), 0.012, 3.0)), (d.u(0.6, 1.2), d.u(0.5, 0.9)), 0.012), d.palette.fabric())


def handbag(d: Draft) -> None:
    """A bag with handles."""
    material = d.palette.fabric() if d.chance(0.6) else d.palette.paint()
    width, depth, height = d.u(0.22, 0.45), d.u(0.1, 0.2), d.u(0.2, 0.35)
    body = soft_box((width, depth, height), (0, 0, 0), 0.03, 0.1)
    taper = 1 - 0.35 * np.clip(body.vertices[:, 2] / height, 0, 1) * d.u(0.0, 1.0)
    d.add(
        Mesh(body.vertices * np.stack([np.ones_like(taper), taper, np.ones_like(taper)], 1), body.triangles), material
    )
    angle = np.linspace(0, np.pi, 9)
    for side in (-1, 1):
        loop = np.stack(
            [
                width * 0.28 * np.cos(angle),
                np.full(9, side * depth * 0.25),
                height - 0.02 + d.u(0.08, 0.18) * np.sin(angle),
            ],
            1,
        )
        d.add(tube(loop, 0.008), material)


def backpack(d: Draft) -> None:
    """A rucksack with pockets and straps."""
    material = d.palette.fabric()
    width, depth, height = d.u(0.26, 0.36), d.u(0.14, 0.24), d.u(0.38, 0.52)
    d.add(soft_box((width, depth, height), (0, 0, 0), 0.07, 0.08), material)
    d.add(
        soft_box((width * 0.8, 0.08, height * 0.45), (0, depth / 2 + 0.02, 0.04), 0.03),
        material if d.chance(0.6) else d.palette.fabric(),
    )
    for side in (-1, 1):
        line = np.array(
            [
                [side * 0.08, -depth / 2, height * 0.9],
                [side * 0.1, -depth / 2 - 0.06, height * 0.6],
                [side * 0.1, -depth / 2, height * 0.15],
            ]
        )
        d.add(tube(line, 0.016), material)


def suitcase(d: Draft) -> None:
    """A suitcase on wheels, standing."""
    paint, width, depth, height = d.palette.paint(), d.u(0.36, 0.5), d.u(0.2, 0.3), d.u(0.5, 0.72)
    d.add(soft_box((width, depth, height), (0, 0, 0.05), 0.05), paint)
    for sx in (-1, 1):
        d.add(cylinder(0.025, 0.06, (sx * width * 0.4, 0, 0)), d.palette.paint())
        d.add(
            rod((sx * 0.09, -depth / 2 + 0.03, height), (sx * 0.09, -depth / 2 + 0.03, height + 0.3), 0.008),
            d.palette.metal(),
        )
    d.add(
        bar((-0.1, -depth / 2 + 0.03, height + 0.3), (0.1, -depth / 2 + 0.03, height + 0.3), 0.025, 0.02),
        d.palette.paint(),
    )


def hanging_coat(d: Draft) -> None:
    """A coat or towel that hangs on a hook; its origin is the hook, it hangs down before the wall."""
    width, height = d.u(0.3, 0.5), d.u(0.6, 1.1)
    n, m = 14, 24
    share = np.linspace(0, 1, n)[:, None]
    angle = np.linspace(0, np.pi, m)[None]
    half = width / 2 * (0.35 + 0.65 * np.minimum(share * 4, 1))
    x = -half * np.cos(angle)
    y = 0.02 + (0.05 + 0.06 * share) * np.sin(angle) * (1 + 0.2 * np.sin(9 * angle + d.u(0, 6)))
    z = np.broadcast_to(-height * share, x.shape)
    d.add(
        join([Mesh(np.stack([x, np.broadcast_to(y, x.shape), z], -1).reshape(-1, 3), grid_triangles(n, m))]),
        d.palette.fabric(),
    )
