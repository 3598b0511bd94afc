"""What is mounted, leaned or plugged in: lamps, screens, pictures, doors, windows, radiators, plants."""

from __future__ import annotations

import numpy as np

from training.worlds.draft import Draft, Zone
from training.worlds.mesh import Mesh, bar, box, cylinder, join, lathe, rod, soft_box, tube


def monitor(d: Draft) -> None:
    """A screen on a foot."""
    w, h, paint = d.u(0.42, 0.8), d.u(0.27, 0.42), d.palette.paint()
    rise = d.u(0.06, 0.16)
    d.add(box((w, 0.03, h), (0, 0, rise)), paint)
    d.add(box((w - 0.03, 0.002, h - 0.03), (0, 0.016, rise + 0.015)), d.palette.screen())
    d.add(bar((0, -0.03, 0), (0, -0.03, rise + h * 0.4), 0.05, 0.02), paint)
    d.add(soft_box((d.u(0.18, 0.3), d.u(0.14, 0.22), 0.012), (0, -0.02, 0), 0.005), paint)


def television(d: Draft) -> None:
    """A television on two feet."""
    w = d.u(0.7, 1.4)
    h, paint = w * 0.57, d.palette.paint()
    d.add(box((w, 0.05, h), (0, 0, 0.06)), paint)
    d.add(box((w - 0.02, 0.002, h - 0.02), (0, 0.026, 0.07)), d.palette.screen())
    for side in (-1, 1):
        d.add(bar((side * w * 0.3, -0.1, 0.01), (side * w * 0.3, 0.1, 0.01), 0.03, 0.02), paint)
        d.add(bar((side * w * 0.3, 0, 0), (side * w * 0.3, 0, 0.08), 0.03, 0.02), paint)


def wall_television(d: Draft) -> None:
    """A television on a wall; the origin is the middle of its lower edge at the wall."""
    w = d.u(0.7, 1.4)
    d.add(box((w, 0.04, w * 0.57), (0, 0.06, 0)), d.palette.paint())
    d.add(box((w - 0.02, 0.002, w * 0.57 - 0.02), (0, 0.081, 0.01)), d.palette.screen())


def keyboard(d: Draft) -> None:
    """A keyboard with rows of keys."""
    w, paint, keys = d.u(0.28, 0.46), d.palette.paint(), d.palette.paint()
    d.add(soft_box((w, 0.14, 0.015), (0, 0, 0), 0.004), paint)
    for row in range(4):
        d.add(
            join(
                [
                    box((w / 13, 0.022, 0.008), (w * (k / 12 - 0.5) * 0.92, -0.048 + 0.031 * row, 0.014))
                    for k in range(13)
                ]
            ),
            keys,
        )


def mouse(d: Draft) -> None:
    """A computer mouse."""
    d.add(soft_box((0.06, d.u(0.09, 0.12), 0.036), (0, 0, 0), 0.017), d.palette.paint())


def laptop(d: Draft) -> None:
    """A laptop, open or shut."""
    w, paint = d.u(0.28, 0.38), d.palette.metal()
    deep = w * 0.68
    d.add(box((w, deep, 0.016)), paint)
    if d.chance(0.2):
        d.add(box((w, deep, 0.008), (0, 0, 0.016)), paint)
        return
    lid = join([box((w, 0.008, deep))])
    angle = d.u(0.05, 0.5)
    d.add(lid.moved((0, -deep / 2, 0.014), roll=angle), paint)
    d.add(
        box((w * 0.95, 0.001, deep * 0.92), (0, 0.005, 0.01)).moved((0, -deep / 2, 0.014), roll=angle),
        d.palette.screen(),
    )
    d.add(box((w * 0.88, deep * 0.45, 0.003), (0, -deep * 0.15, 0.015)), d.palette.paint())


def computer(d: Draft) -> None:
    """A computer's case, a printer or a loudspeaker."""
    size = (d.u(0.17, 0.42), d.u(0.25, 0.45), d.u(0.18, 0.48))
    d.add(soft_box(size, (0, 0, 0), 0.01), d.palette.paint())
    d.add(box((size[0] * 0.8, 0.006, size[2] * 0.5), (0, size[1] / 2, size[2] * 0.3)), d.palette.paint())


def table_lamp(d: Draft) -> None:
    """A lamp with a shade."""
    foot, shade = d.palette.paint() if d.chance(0.5) else d.palette.wood(), d.palette.fabric()
    h, r = d.u(0.25, 0.55), d.u(0.07, 0.17)
    if d.chance(0.5):
        d.add(lathe([(0, 0), (r * 0.6, 0), (r * 0.7, h * 0.2), (0.02, h * 0.5), (0.012, h * 0.7)]), foot)
    else:
        d.add(cylinder(r * 0.7, 0.02), foot)
        d.add(rod((0, 0, 0), (0, 0, h * 0.8), 0.01), foot)
    d.add(lathe([(r, h * 0.6), (r * d.u(0.5, 1.0), h)], sides=26), shade)


def desk_lamp(d: Draft) -> None:
    """A lamp with a jointed arm."""
    m, a, b = d.palette.paint(), d.u(0.2, 0.4), d.u(0.15, 0.35)
    d.add(cylinder(d.u(0.06, 0.1), 0.02), m)
    elbow = (-0.1, 0.0, a)
    tip = (b - 0.1, 0.0, a + d.u(-0.05, 0.2))
    d.add(rod((0, 0, 0.02), elbow, 0.008), m)
    d.add(rod(elbow, tip, 0.008), m)
    d.add(lathe([(0.02, 0.06), (0.03, 0.05), (0.07, -0.05)]).moved(tip, pitch=d.u(-0.3, 0.6)), m)


def floor_lamp(d: Draft) -> None:
    """A lamp that stands on the floor."""
    m, shade, h, r = d.palette.metal(), d.palette.fabric(), d.u(1.3, 1.8), d.u(0.12, 0.25)
    if d.chance(0.3):
        for k in range(3):
            a = 2.1 * k
            d.add(rod((0.25 * float(np.cos(a)), 0.25 * float(np.sin(a)), 0), (0, 0, h * 0.75), 0.012), d.palette.wood())
    else:
        d.add(cylinder(0.14, 0.025, sides=24), m)
    d.add(rod((0, 0, 0), (0, 0, h - 0.1), 0.013), m)
    d.add(lathe([(r, h - 0.28), (r * d.u(0.6, 1.0), h)], sides=26), shade)


def hanging_lamp(d: Draft) -> None:
    """A lamp below the ceiling; the origin is its upper end."""
    r, drop, shade = d.u(0.12, 0.28), d.u(0.3, 0.8), d.palette.paint() if d.chance(0.5) else d.palette.fabric()
    d.add(rod((0, 0, -drop), (0, 0, 0), 0.006), d.palette.metal())
    d.add(lathe([(0.03, 0.0), (r * 0.6, -0.03), (r, -d.u(0.12, 0.25))], (0, 0, -drop), 26), shade)


def picture(d: Draft) -> None:
    """A framed picture; the origin is the middle of its lower edge at the wall."""
    w, h, t = d.u(0.2, 1.0), d.u(0.2, 0.8), d.u(0.015, 0.04)
    d.add(box((w, t * 0.6, h), (0, t * 0.3, 0)), d.palette.printed())
    frame = d.palette.wood()
    e = d.u(0.015, 0.05)
    for side in (-1, 1):
        d.add(box((e, t, h), (side * (w - e) / 2, t / 2, 0)), frame)
        d.add(box((w, t, e), (0, t / 2, (h - e) * (side + 1) / 2)), frame)


def photo_frame(d: Draft) -> None:
    """A small picture that stands."""
    w, h = d.u(0.1, 0.22), d.u(0.12, 0.26)
    d.add(box((w, 0.015, h)).moved((0, 0, 0), roll=d.u(0.12, 0.3)), d.palette.wood())
    d.add(box((w * 0.8, 0.002, h * 0.8), (0, 0.009, h * 0.1)).moved((0, 0, 0), roll=0.2), d.palette.printed())


def mirror(d: Draft) -> None:
    """A mirror on a wall; depth fails on it."""
    w, h = d.u(0.3, 0.8), d.u(0.4, 1.4)
    d.add(box((w, 0.02, h), (0, 0.01, 0)), d.palette.wood())
    d.add(box((w - 0.05, 0.001, h - 0.05), (0, 0.021, 0.025)), d.palette.glass())


def clock(d: Draft) -> None:
    """A round clock on a wall."""
    r = d.u(0.1, 0.2)
    d.add(lathe([(0, 0.03), (r, 0.03), (r, 0.0)], sides=28).moved((0, 0, r), roll=-np.pi / 2), d.palette.paint())
    d.add(box((0.01, 0.004, r * 0.8), (0, 0.035, r)), d.palette.paint())


def window(d: Draft) -> None:
    """A window with a frame and bars before a pane; the origin is its lower edge at the wall."""
    w, h, paint = d.u(0.7, 1.6), d.u(0.8, 1.4), d.palette.paint()
    d.add(box((w, 0.01, h), (0, 0.005, 0)), d.palette.glass())
    for x in np.linspace(-w / 2, w / 2, int(d.rng.integers(2, 4))):
        d.add(box((0.06, 0.05, h), (float(x), 0.025, 0)), paint)
    for z in (-0.03, h - 0.03):
        d.add(box((w + 0.06, 0.05, 0.06), (0, 0.025, z)), paint)
    if d.chance(0.6):
        d.add(box((w + 0.2, d.u(0.1, 0.22), 0.03), (0, 0.08, -0.06)), paint)
        d.zones.append(Zone((-w / 2, 0.04), (w / 2, 0.12), -0.03, 0.4, "shelf"))


def door(d: Draft) -> None:
    """A door in its frame, shut or ajar; the leaf is part of it."""
    w, h, paint = d.u(0.75, 0.95), d.u(1.98, 2.1), d.palette.paint() if d.chance(0.6) else d.palette.wood()
    for side in (-1, 1):
        d.add(box((0.07, 0.03, h + 0.07), (side * (w / 2 + 0.035), 0.015, 0)), paint)
    d.add(box((w, 0.03, 0.07), (0, 0.015, h)), paint)
    parts = [box((w - 0.01, 0.035, h), (w / 2, 0.02, 0.005))]
    if d.chance(0.5):
        parts += [box((w * 0.6, 0.012, h * 0.35), (w / 2, 0.04, h * z)) for z in (0.1, 0.55)]
    angle = d.u(0.3, 1.5) if d.chance(0.2) else 0.0
    d.add(join(parts).moved((-w / 2, 0, 0), yaw=angle), paint if d.chance(0.5) else d.palette.wood())
    handle = join(
        [
            rod((w * 0.92, 0.03, 1.03), (w * 0.92, 0.08, 1.03), 0.01),
            rod((w * 0.92, 0.08, 1.03), (w * 0.8, 0.08, 1.03), 0.009),
        ]
    )
    d.add(handle.moved((-w / 2, 0, 0), yaw=angle), d.palette.metal())


def radiator(d: Draft) -> None:
    """A radiator of ribs or of one panel, a little off its wall."""
    w, h, paint = d.u(0.5, 1.5), d.u(0.4, 0.75), d.palette.paint()
    if d.chance(0.5):
        for x in np.arange(-w / 2, w / 2, d.u(0.045, 0.07)):
            d.add(soft_box((0.035, 0.1, h), (float(x), 0.09, 0.1), 0.015, cells=2), paint)
    else:
        d.add(soft_box((w, 0.07, h), (0, 0.08, 0.1), 0.012), paint)
        for x in np.arange(-w / 2 + 0.03, w / 2, 0.05):
            d.add(box((0.012, 0.01, h * 0.9), (float(x), 0.118, 0.1 + h * 0.05)), paint)
    d.add(rod((w / 2 + 0.03, 0.08, 0.0), (w / 2 + 0.03, 0.08, 0.16), 0.012), paint)


def switch(d: Draft) -> None:
    """A switch or a socket."""
    d.add(box((d.u(0.08, 0.16), 0.012, 0.08), (0, 0.006, 0)), d.palette.paint())


def _leaf(length: float, width: float, bend: float) -> Mesh:
    s = np.linspace(0, 1, 6)
    half = width / 2 * np.sin(np.pi * np.clip(s, 0.04, 1.0)) ** 0.7
    x, z = length * s, -bend * length * s**2
    rows = np.stack(
        [
            np.stack([x, -half, z + 0.02 * width], 1),
            np.stack([x, 0 * s, z], 1),
            np.stack([x, half, z + 0.02 * width], 1),
        ],
        1,
    )
    tri = [
        t
        for k in range(5)
        for c in (0, 1)
        for t in ((3 * k + c, 3 * k + c + 1, 3 * k + c + 3), (3 * k + c + 1, 3 * k + c + 4, 3 * k + c + 3))
    ]
    return Mesh(rows.reshape(-1, 3), np.array(tri))


def plant(d: Draft) -> None:
    """A plant in a pot: a rosette, a bush or a small tree."""
    leaf, small = d.palette.leaf(), d.chance(0.5)
    r = d.u(0.05, 0.1) if small else d.u(0.12, 0.2)
    h = r * d.u(1.3, 2.2)
    top = r * 1.15
    d.add(
        lathe([(0, 0), (r * 0.85, 0), (top, h), (top - 0.01, h), (r, h * 0.85), (0, h * 0.85)], sides=22),
        d.palette.paint(),
    )
    size, build = r * d.u(2.0, 5.0), int(d.rng.integers(3))
    leaves: list[Mesh] = []
    stalks: list[Mesh] = []
    for _ in range(int(d.rng.integers(14, 70))):
        a, rise = d.u(0, 6.3), d.u(0.1, 1.3)
        if build == 0:
            leaves.append(
                _leaf(size * d.u(0.5, 1.0), size * d.u(0.08, 0.2), d.u(0.1, 0.8)).moved(
                    (0, 0, h * 0.85), yaw=a, pitch=-rise
                )
            )
            continue
        tall = h + size * (d.u(0.2, 1.2) if build == 1 else d.u(1.0, 1.8))
        out = size * d.u(0.05, 0.45)
        at = (out * float(np.cos(a)), out * float(np.sin(a)), tall)
        leaves.append(
            _leaf(size * d.u(0.2, 0.5), size * d.u(0.1, 0.25), d.u(0, 0.6)).moved(
                at, yaw=a + d.u(-1, 1), pitch=d.u(-0.9, 0.6)
            )
        )
        stalks.append(rod((0, 0, h * 0.85 if build == 1 else tall - size * 0.3), at, 0.004, 4))
    d.add(join(leaves), leaf)
    if stalks:
        d.add(join(stalks), leaf)
    if build == 2:
        d.add(rod((0, 0, h * 0.8), (0, 0, h + size * 1.3), max(0.008, size * 0.025)), d.palette.wood())


def flowers(d: Draft) -> None:
    """A vase with flowers."""
    from training.worlds.mesh import ball
    from training.worlds.tabletop import vase

    vase(d)
    h, paint = float(d.bounds()[1][2]), d.palette.paint()
    for _ in range(int(d.rng.integers(3, 12))):
        a, out = d.u(0, 6.3), d.u(0.02, 0.12)
        at = (out * float(np.cos(a)), out * float(np.sin(a)), h + d.u(0.08, 0.28))
        d.add(rod((0, 0, h * 0.7), at, 0.003, 4), d.palette.leaf())
        d.add(ball(d.u(0.015, 0.035), at, 8), paint)


def cable(d: Draft) -> None:
    """A cable lying about."""
    t = np.linspace(0, 1, 14)
    points = np.stack([d.u(0.3, 0.8) * (t - 0.5), 0.06 * np.sin(7 * t + d.u(0, 6)), np.full(14, 0.005)], 1)
    d.add(tube(points, 0.004, 5), d.palette.paint())


def fan(d: Draft) -> None:
    """A fan on a stand."""
    m, h = d.palette.paint(), d.u(0.35, 1.2)
    d.add(cylinder(0.15, 0.03, sides=22), m)
    d.add(rod((0, 0, 0), (0, 0, h), 0.014), m)
    r = d.u(0.12, 0.2)
    for y in (-0.04, 0.05):
        d.add(lathe([(r, 0.0), (r + 0.006, 0.006)], sides=24).moved((0, y, h), roll=np.pi / 2), m)
    for k in range(16):
        a = k * np.pi / 8
        d.add(rod((0, 0.06, h), (r * float(np.cos(a)), 0.05, h + r * float(np.sin(a))), 0.003, 4), m)
    d.add(cylinder(r * 0.8, 0.01, sides=18).moved((0, 0, h), roll=np.pi / 2), d.palette.paint())


def guitar(d: Draft) -> None:
    """A guitar that leans."""
    wood = d.palette.wood()
    parts = [
        cylinder(0.19, 0.09, sides=24).scaled((1, 0.95, 1)),
        cylinder(0.14, 0.09, (0, 0.24, 0), sides=24),
        box((0.05, 0.62, 0.03), (0, 0.6, 0.06)),
        box((0.07, 0.14, 0.02), (0, 0.95, 0.06)),
    ]
    d.add(join(parts).moved((0, 0.09, 0.19), roll=np.pi / 2 - 0.02).moved((0, 0, 0), roll=-d.u(-0.3, -0.12)), wood)
