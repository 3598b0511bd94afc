"""Small things: tableware, bottles, books, boxes, toys, shoes, food."""

from __future__ import annotations

import numpy as np

from training.worlds.draft import Draft
from training.worlds.materials import Material
from training.worlds.mesh import Mesh, ball, bar, box, cylinder, join, lathe, rod, soft_box, tube


def _glaze(d: Draft) -> Material:
    return d.palette.paint() if d.chance(0.7) else d.palette.printed()


def mug(d: Draft) -> None:
    """A mug with a handle."""
    material, radius, height = _glaze(d), d.u(0.032, 0.05), d.u(0.07, 0.12)
    top = radius * d.u(0.95, 1.2)
    d.add(
        lathe([(0, 0), (radius, 0), (top, height), (top - 0.005, height), (radius - 0.005, 0.008), (0, 0.008)]),
        material,
    )
    a = np.linspace(-1.3, 1.3, 8)
    reach = d.u(0.02, 0.035)
    d.add(
        tube(
            np.stack([radius + reach * np.cos(a) - 0.008, np.zeros(8), height / 2 + height * 0.3 * np.sin(a)], 1), 0.006
        ),
        material,
    )


def glass(d: Draft) -> None:
    """A drinking glass or wine glass."""
    material = d.palette.paint()
    if d.chance(0.5):
        r, h = d.u(0.028, 0.04), d.u(0.08, 0.16)
        d.add(lathe([(0, 0), (r * 0.85, 0), (r, h), (r - 0.003, h), (r * 0.8, 0.01), (0, 0.01)]), material)
    else:
        h = d.u(0.15, 0.22)
        d.add(
            lathe(
                [
                    (0, 0),
                    (0.034, 0),
                    (0.005, 0.01),
                    (0.005, h * 0.45),
                    (0.035, h * 0.65),
                    (0.03, h),
                    (0.028, h),
                    (0.03, h * 0.65),
                    (0, h * 0.5),
                ]
            ),
            material,
        )


def bowl(d: Draft) -> None:
    """A bowl."""
    r, h = d.u(0.06, 0.16), d.u(0.04, 0.1)
    d.add(
        lathe(
            [
                (0, 0),
                (r * 0.4, 0),
                (r * 0.8, h * 0.45),
                (r, h),
                (r - 0.006, h),
                (r * 0.75, h * 0.5),
                (r * 0.3, 0.012),
                (0, 0.012),
            ],
            sides=28,
        ),
        _glaze(d),
    )


def plate(d: Draft) -> None:
    """A plate or a stack of plates, which is one thing only as single plates are."""
    r = d.u(0.08, 0.15)
    d.add(
        lathe([(0, 0), (r * 0.6, 0), (r, 0.02), (r - 0.002, 0.026), (r * 0.6, 0.008), (0, 0.008)], sides=32), _glaze(d)
    )


def bottle(d: Draft) -> None:
    """A bottle with a neck and a label."""
    r, h = d.u(0.028, 0.05), d.u(0.18, 0.34)
    neck, shoulder = r * d.u(0.25, 0.5), h * d.u(0.5, 0.75)
    d.add(
        lathe([(0, 0), (r, 0), (r, shoulder), (neck, shoulder + (h - shoulder) * 0.45), (neck, h), (0, h)]), _glaze(d)
    )
    d.add(cylinder(neck * 1.15, 0.02, (0, 0, h - 0.01)), d.palette.paint())
    if d.chance(0.6):
        d.add(lathe([(r + 0.001, shoulder * 0.25), (r + 0.001, shoulder * 0.8)]), d.palette.printed())


def spray(d: Draft) -> None:
    """A spray bottle or a soap dispenser."""
    r, h, paint = d.u(0.03, 0.045), d.u(0.12, 0.2), d.palette.paint()
    d.add(soft_box((2 * r, 1.6 * r, h), (0, 0, 0), 0.02), d.palette.printed())
    d.add(cylinder(0.01, 0.05, (0, 0, h)), paint)
    d.add(box((0.03, 0.07, 0.03), (0, 0.015, h + 0.04)), paint)


def can(d: Draft) -> None:
    """A can or a jar."""
    r, h = d.u(0.03, 0.055), d.u(0.07, 0.16)
    d.add(cylinder(r, h), d.palette.printed())
    d.add(cylinder(r * 1.02, 0.012, (0, 0, h)), d.palette.metal())


def jug(d: Draft) -> None:
    """A jug, teapot or kettle."""
    r, h, material = d.u(0.06, 0.09), d.u(0.14, 0.25), _glaze(d) if d.chance(0.6) else d.palette.metal()
    d.add(
        lathe(
            [(0, 0), (r * 0.9, 0), (r, h * 0.3), (r * 0.75, h * 0.9), (r * 0.7, h), (r * 0.3, h * 1.05), (0, h * 1.08)],
            sides=24,
        ),
        material,
    )
    a = np.linspace(-1.2, 1.2, 8)
    d.add(
        tube(np.stack([-r * 0.75 - 0.045 * np.cos(a), np.zeros(8), h * 0.55 + h * 0.35 * np.sin(a)], 1), 0.01), material
    )
    d.add(rod((r * 0.8, 0, h * 0.5), (r * 1.5, 0, h * 0.85), 0.012), material)


def pot(d: Draft) -> None:
    """A pot or pan with handles."""
    r, h, metal = d.u(0.09, 0.15), d.u(0.05, 0.16), d.palette.metal()
    d.add(lathe([(0, 0), (r, 0), (r, h), (r - 0.004, h), (r - 0.004, 0.008), (0, 0.008)], sides=28), metal)
    if h < 0.09:
        d.add(rod((r, 0, h * 0.8), (r + 0.18, 0, h + 0.01), 0.011), d.palette.paint())
        return
    for side in (-1, 1):
        d.add(bar((side * r, -0.03, h * 0.8), (side * (r + 0.03), 0.03, h * 0.8), 0.015, 0.015), metal)
    if d.chance(0.6):
        d.add(lathe([(0, h + 0.03), (r, h + 0.005), (r, h)], sides=28), metal)
        d.add(cylinder(0.015, 0.025, (0, 0, h + 0.028)), d.palette.paint())


def vase(d: Draft) -> None:
    """A vase."""
    h, w = d.u(0.14, 0.38), d.u(0.04, 0.1)
    radii = w * np.array([0.7, d.u(0.8, 1.2), d.u(0.7, 1.2), d.u(0.4, 0.9), d.u(0.5, 1.0)])
    z = np.linspace(0, h, 5)
    outer = [(0.0, 0.0)] + [(float(r), float(a)) for r, a in zip(radii, z, strict=True)]
    d.add(lathe([*outer, (float(radii[-1]) - 0.006, h), (float(radii[-1]) * 0.6, h * 0.8)], sides=24), _glaze(d))


def book(d: Draft) -> None:
    """One book, lying."""
    w, t, h = d.u(0.11, 0.24), d.u(0.01, 0.05), d.u(0.16, 0.32)
    cover, paper = d.palette.printed(), d.palette.paint()
    d.add(box((w, h, t * 0.84), (0.002, 0, t * 0.08)), paper)
    for z in (0.0, t * 0.92):
        d.add(box((w + 0.004, h + 0.004, t * 0.08), (0, 0, z)), cover)
    d.add(box((0.003, h + 0.004, t), (-w / 2 - 0.002, 0, 0)), cover)


def open_book(d: Draft) -> None:
    """An open book or magazine."""
    w, h, page = d.u(0.12, 0.2), d.u(0.18, 0.28), d.palette.printed()
    x = np.linspace(0, w, 8)
    z = d.u(0.01, 0.03) * np.sin(np.clip(x / w * 2.6, 0, np.pi)) + 0.004
    for side in (-1, 1):
        points = np.array([[side * a, b, c] for b in (-h / 2, h / 2) for a, c in zip(x, z, strict=True)])
        tri = np.array([[k, k + 1, k + 8] for k in range(7)] + [[k + 1, k + 9, k + 8] for k in range(7)])
        d.add(Mesh(points, tri), page)
    d.add(box((2 * w, h, 0.004)), d.palette.printed())


def papers(d: Draft) -> None:
    """A sheet, or a loose pile of paper or magazines."""
    w, h = d.u(0.15, 0.22), d.u(0.2, 0.3)
    thick = d.u(0.002, 0.02)
    count = int(d.rng.integers(1, 5))
    for k in range(count):
        d.add(
            box((w, h, thick / count)).moved(
                (d.u(-0.008, 0.008), d.u(-0.008, 0.008), thick * k / count), yaw=d.u(-0.1, 0.1)
            ),
            d.palette.printed(),
        )


def carton(d: Draft) -> None:
    """A shut box or package."""
    size = (d.u(0.06, 0.45), d.u(0.05, 0.35), d.u(0.04, 0.32))
    material = d.palette.printed() if d.chance(0.5) else d.palette.paint()
    d.add(box(size), material)
    if d.chance(0.3):
        d.add(box((size[0] + 0.008, size[1] + 0.008, 0.035), (0, 0, size[2] - 0.03)), d.palette.paint())


def open_box(d: Draft) -> None:
    """An open box or crate; some have flaps."""
    w, deep, h, t = d.u(0.15, 0.45), d.u(0.15, 0.4), d.u(0.1, 0.32), 0.006
    m = d.palette.printed() if d.chance(0.3) else d.palette.paint() if d.chance(0.5) else d.palette.wood()
    d.add(box((w, deep, t)), m)
    for side in (-1, 1):
        d.add(box((t, deep, h), (side * (w - t) / 2, 0, 0)), m)
        d.add(box((w, t, h), (0, side * (deep - t) / 2, 0)), m)
        if h > 0.2 and d.chance(0.4):
            d.add(
                box((w * 0.5, deep, 0.004), (w * 0.25, 0, 0)).moved(
                    (side * w / 2, 0, h), yaw=0 if side > 0 else np.pi, pitch=d.u(-0.6, 0.9)
                ),
                m,
            )


def basket(d: Draft) -> None:
    """A round basket, bin or planter."""
    r, h = d.u(0.11, 0.22), d.u(0.16, 0.4)
    top = r * d.u(1.0, 1.25)
    m = d.palette.fabric() if d.chance(0.5) else d.palette.paint()
    d.add(lathe([(0, 0), (r, 0), (top, h), (top - 0.01, h), (r - 0.01, 0.01), (0, 0.01)], sides=26), m)


def toy_blocks(d: Draft) -> None:
    """One toy block or a brick."""
    s = d.u(0.04, 0.09)
    d.add(soft_box((s * d.u(1, 2), s, s * d.u(0.5, 1.0)), (0, 0, 0), 0.004), d.palette.paint())


def toy_car(d: Draft) -> None:
    """A toy car or lorry."""
    deep, w, h, paint = d.u(0.1, 0.3), d.u(0.05, 0.13), d.u(0.04, 0.1), d.palette.paint()
    d.add(soft_box((deep, w, h * 0.6), (0, 0, h * 0.25), 0.012), paint)
    d.add(soft_box((deep * d.u(0.3, 0.55), w * 0.85, h * 0.6), (deep * d.u(-0.15, 0.15), 0, h * 0.8), 0.012), paint)
    for sx in (-1, 1):
        for sy in (-1, 1):
            d.add(
                cylinder(h * 0.32, 0.02, sides=12).moved((sx * deep * 0.3, sy * w * 0.45, h * 0.32), roll=np.pi / 2),
                d.palette.paint(),
            )


def soft_toy(d: Draft) -> None:
    """A stuffed animal that sits."""
    s, m = d.u(0.12, 0.35), d.palette.fabric()
    d.add(ball(s * 0.3).scaled((1, 0.9, 1.2)), m)
    d.add(ball(s * 0.22, (0, s * 0.03, s * 0.6)), m)
    for side in (-1, 1):
        d.add(ball(s * 0.08, (side * s * 0.17, 0, s * 0.93)), m)
        d.add(ball(s * 0.12).scaled((1, 1.6, 0.9)).moved((side * s * 0.24, s * 0.26, 0)), m)
        d.add(ball(s * 0.09).scaled((1, 1, 1.8)).moved((side * s * 0.32, s * 0.08, s * 0.25)), m)


def game_ball(d: Draft) -> None:
    """A ball."""
    d.add(ball(d.u(0.03, 0.13), sides=24), d.palette.printed() if d.chance(0.5) else d.palette.paint())


def fruit(d: Draft) -> None:
    """A fruit."""
    r = d.u(0.03, 0.05)
    d.add(ball(r).scaled((1, d.u(0.9, 1.2), d.u(0.85, 1.3))), d.palette.paint())


def shoe(d: Draft) -> None:
    """One shoe or boot."""
    deep, w, m = d.u(0.2, 0.31), d.u(0.08, 0.11), d.palette.fabric() if d.chance(0.6) else d.palette.paint()
    d.add(soft_box((w, deep, 0.025), (0, 0, 0), 0.012), d.palette.paint())
    d.add(soft_box((w * 0.95, deep * 0.55, d.u(0.05, 0.07)), (0, deep * 0.2, 0.02), 0.03), m)
    tall = d.u(0.06, 0.12) if d.chance(0.75) else d.u(0.18, 0.34)
    r = w * 0.45
    d.add(
        lathe([(r, 0), (r, tall), (r - 0.008, tall), (r - 0.008, 0.0)])
        .scaled((1, 1.3, 1))
        .moved((0, -deep * 0.25, 0.02)),
        m,
    )


def remote(d: Draft) -> None:
    """A remote control, phone or small device."""
    d.add(soft_box((d.u(0.04, 0.075), d.u(0.13, 0.2), d.u(0.008, 0.025)), (0, 0, 0), 0.004), d.palette.paint())


def gamepad(d: Draft) -> None:
    """A controller with two grips."""
    m = d.palette.paint()
    d.add(soft_box((0.13, 0.08, 0.035), (0, 0.01, 0.01), 0.016), m)
    for side in (-1, 1):
        d.add(soft_box((0.045, 0.1, 0.04), (0, 0, 0), 0.02).moved((side * 0.06, -0.025, 0), yaw=-side * 0.3), m)
        d.add(cylinder(0.01, 0.02, (side * 0.03, 0, 0.04)), d.palette.paint())


def tissue_box(d: Draft) -> None:
    """A box of tissues."""
    w = d.u(0.12, 0.24)
    d.add(box((w, d.u(0.11, 0.14), d.u(0.06, 0.12))), d.palette.printed())
    d.add(lathe([(0.03, 0), (0.02, 0.03), (0.035, 0.05)], (0, 0, d.bounds()[1][2]), 7), d.palette.paint())


def tray(d: Draft) -> None:
    """A tray with a rim."""
    w, deep, m = d.u(0.3, 0.5), d.u(0.2, 0.35), d.palette.wood()
    d.add(box((w, deep, 0.008)), m)
    for side in (-1, 1):
        d.add(box((0.01, deep, 0.035), (side * w / 2, 0, 0)), m)
        d.add(box((w, 0.01, 0.035), (0, side * deep / 2, 0)), m)


def kitchen_roll(d: Draft) -> None:
    """A roll of paper, some on a stand."""
    r, h = d.u(0.045, 0.065), d.u(0.1, 0.26)
    d.add(join([lathe([(0.02, 0.01), (r, 0.01), (r, h), (0.02, h)], sides=24)]), d.palette.paint())
    d.add(cylinder(0.008, h + 0.03), d.palette.wood())
    d.add(cylinder(r * 1.1, 0.01), d.palette.wood())


def statuette(d: Draft) -> None:
    """An ornament of no use."""
    m, h = _glaze(d), d.u(0.1, 0.3)
    d.add(cylinder(h * 0.25, h * 0.08), m)
    radii = d.rng.uniform(0.05, 0.24, 6) * h
    d.add(lathe([(float(r), h * (0.08 + 0.92 * k / 5)) for k, r in enumerate(radii)] + [(0.0, h)], sides=14), m)
