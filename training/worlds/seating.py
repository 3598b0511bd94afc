"""Sofas, armchairs, chairs, stools and benches."""

from __future__ import annotations

import numpy as np

from training.worlds.draft import Draft, Zone, pose_of
from training.worlds.materials import Material
from training.worlds.mesh import bar, box, cylinder, join, lathe, pillow, rod, soft_box, turn


def cushion(d: Draft, material: Material | None = None) -> None:
    """A loose cushion, lying."""
    side = d.u(0.32, 0.55)
    d.add(pillow((side, side * d.u(0.6, 1.0), d.u(0.09, 0.18))), material or d.palette.fabric())


def _scatter(d: Draft, width: float, seat: float, back: float, count: int) -> None:
    """Lean loose cushions against the back of a seat."""
    for x in np.linspace(-width / 2 + 0.22, width / 2 - 0.22, count) if count else []:
        child = d.child()
        cushion(child)
        size = child.bounds()[1] - child.bounds()[0]
        lean = d.u(0.9, 1.35)
        height = seat + size[1] / 2 * np.sin(lean) + 0.02
        pose = pose_of(
            (x + d.u(-0.1, 0.1), back + size[2] / 2 + 0.12 + d.u(0, 0.05), height),
            turn(d.u(-0.4, 0.4)) @ turn(roll=lean),
        )
        d.lay("cushion", child, pose)


def sofa(d: Draft) -> None:
    """A sofa with seat and back cushions in its own cover, scatter cushions and a throw of their own."""
    cover = d.palette.fabric()
    width, depth, seat = d.u(1.3, 2.6), d.u(0.8, 1.05), d.u(0.36, 0.46)
    arm, tall, thick = d.u(0.08, 0.25), d.u(0.7, 0.95), d.u(0.15, 0.28)
    foot = d.u(0.02, 0.16)
    d.add(soft_box((width, depth, seat - 0.14 - foot), (0, 0, foot), 0.03), cover)
    d.add(soft_box((width, thick, tall - foot), (0, -depth / 2 + thick / 2, foot), d.u(0.03, 0.1)), cover)
    arm_high = d.u(seat + 0.08, min(seat + 0.28, tall))
    for side in (-1, 1) if d.chance(0.9) else ():
        d.add(soft_box((arm, depth, arm_high - foot), (side * (width - arm) / 2, 0, foot), d.u(0.02, 0.1)), cover)
    d.legs((width, depth), foot + 0.02, 0.05, d.palette.wood())
    inside, places = width - 2 * arm, int(np.clip(round((width - 2 * arm) / 0.65), 1, 4))
    each = inside / places
    for k in range(places):
        x = -inside / 2 + each * (k + 0.5)
        front = depth - thick
        d.add(soft_box((each * 0.98, front, 0.16), (x, thick / 2, seat - 0.14), 0.05, d.u(0, 0.2)), cover)
        if d.chance(0.7):
            back = soft_box((each * 0.97, 0.16, tall - seat + d.u(-0.1, 0.08)), (0, 0, 0), 0.06, d.u(0.0, 0.25))
            d.add(back.moved((x, -depth / 2 + thick + 0.08, seat), roll=d.u(0, 0.2)), cover)
    d.zones.append(
        Zone((-inside / 2, -depth / 2 + thick + 0.2), (inside / 2, depth / 2 - 0.05), seat + 0.03, 0.6, "seat")
    )
    _scatter(d, inside, seat, -depth / 2 + thick + 0.12, int(d.rng.integers(0, places + 2)))


def corner_sofa(d: Draft) -> None:
    """A sofa with a chaise on one side."""
    sofa(d)
    high = d.bounds()[1]
    cover = d.parts[0][1]
    side = 1 if d.chance(0.5) else -1
    wide, deep = d.u(0.65, 0.9), d.u(0.6, 0.9)
    seat = d.zones[0].z
    d.add(soft_box((wide, deep, seat), (side * (high[0] - wide / 2), high[1] + deep / 2 - 0.05, 0), 0.05), cover)


def armchair(d: Draft) -> None:
    """An upholstered armchair, boxy or with a frame of wood."""
    cover = d.palette.fabric()
    width, depth, seat, tall = d.u(0.65, 0.95), d.u(0.7, 0.95), d.u(0.36, 0.46), d.u(0.7, 1.05)
    if d.chance(0.5):
        d.add(soft_box((width, depth, seat - 0.08), (0, 0, 0.03), 0.04), cover)
        d.add(soft_box((width, 0.18, tall), (0, -depth / 2 + 0.09, 0.03), 0.07), cover)
        for side in (-1, 1):
            d.add(soft_box((0.13, depth, seat + d.u(0.12, 0.22)), (side * (width / 2 - 0.065), 0, 0.03), 0.05), cover)
        d.add(soft_box((width - 0.28, depth - 0.2, 0.15), (0, 0.08, seat - 0.07), 0.05, 0.1), cover)
    else:
        wood = d.palette.wood()
        d.legs((width, depth), seat + 0.2, 0.05, wood)
        for side in (-1, 1):
            d.add(box((0.06, depth, 0.03), (side * (width / 2 - 0.04), 0, seat + 0.19)), wood)
        d.add(soft_box((width - 0.14, depth - 0.1, 0.14), (0, 0.03, seat - 0.1), 0.05), cover)
        back = soft_box((width - 0.14, 0.14, tall - seat), (0, 0, 0), 0.05, 0.1)
        d.add(back.moved((0, -depth / 2 + 0.12, seat), roll=d.u(0.1, 0.35)), cover)
    d.zones.append(
        Zone((-width / 2 + 0.15, -depth / 2 + 0.25), (width / 2 - 0.15, depth / 2 - 0.05), seat + 0.06, 0.6, "seat")
    )
    _scatter(d, 0.3, seat + 0.05, -depth / 2 + 0.12, int(d.chance(0.5)))


def _seat_frame(d: Draft) -> tuple[float, float, float, float]:
    return d.u(0.38, 0.5), d.u(0.38, 0.5), d.u(0.42, 0.49), d.u(0.78, 1.05)


def slatted_chair(d: Draft) -> None:
    """A wooden chair with a back of slats, upright or across."""
    wood = d.palette.wood()
    width, depth, seat, tall = _seat_frame(d)
    bar_w = d.u(0.025, 0.045)
    d.legs((width, depth), seat, bar_w, wood, d.u(0, 0.04))
    d.add(soft_box((width, depth, 0.03), (0, 0, seat - 0.015), 0.012), wood if d.chance(0.6) else d.palette.fabric())
    lean, y, x = d.u(0, 0.09), -depth / 2 + bar_w, width / 2 - bar_w
    for side in (-1, 1):
        d.add(bar((side * x, y, seat), (side * x, y - lean, tall), bar_w, bar_w), wood)
    count = int(d.rng.integers(2, 7))
    if d.chance(0.5):
        for share in np.linspace(0.25, 0.95, count):
            z = seat + (tall - seat) * share
            d.add(box((2 * x, 0.02, d.u(0.03, 0.07)), (0, y - lean * share, z - 0.04)), wood)
    else:
        d.add(box((2 * x, 0.025, 0.06), (0, y - lean, tall - 0.06)), wood)
        for place in np.linspace(-x * 0.8, x * 0.8, count):
            d.add(bar((place, y, seat), (place, y - lean, tall), 0.02, 0.015), wood)
    if d.chance(0.4):
        for side in (-1, 1):
            d.add(bar((side * x, -depth / 2 + bar_w, 0.18), (side * x, depth / 2 - bar_w, 0.18), 0.02, 0.02), wood)
    d.zones.append(
        Zone((-width / 2 + 0.03, -depth / 2 + 0.06), (width / 2 - 0.03, depth / 2 - 0.03), seat + 0.015, 0.5, "seat")
    )


def padded_chair(d: Draft) -> None:
    """A dining chair with padded seat and back."""
    cover, frame = d.palette.fabric(), d.palette.wood() if d.chance(0.5) else d.palette.metal()
    width, depth, seat, tall = _seat_frame(d)
    d.legs((width, depth), seat, d.u(0.02, 0.04), frame, d.u(0, 0.06))
    d.add(soft_box((width, depth, d.u(0.05, 0.1)), (0, 0, seat - 0.04), 0.03), cover)
    back = soft_box((width * d.u(0.8, 1.0), 0.06, (tall - seat) * d.u(0.6, 1.0)), (0, 0, 0), 0.025)
    d.add(back.moved((0, -depth / 2 + 0.03, seat + d.u(0.0, 0.12)), roll=d.u(0.02, 0.2)), cover)
    for side in (-1, 1):
        d.add(
            rod((side * width * 0.3, -depth / 2 + 0.03, seat), (side * width * 0.3, -depth / 2, seat + 0.25), 0.012),
            frame,
        )
    d.zones.append(
        Zone((-width / 2 + 0.03, -depth / 2 + 0.08), (width / 2 - 0.03, depth / 2 - 0.03), seat + 0.04, 0.5, "seat")
    )


def shell_chair(d: Draft) -> None:
    """A chair of one bent shell on four thin legs or a sledge."""
    shell, frame = d.palette.paint(), d.palette.metal() if d.chance(0.5) else d.palette.wood()
    width, depth, seat, tall = _seat_frame(d)
    d.legs((width * 0.85, depth * 0.85), seat, 0.022, frame, d.u(0.0, 0.08))
    for k in range(7):
        angle = k / 6 * 1.45
        r = 0.16
        y, z = -depth / 2 + r - r * np.sin(angle), seat + r - r * np.cos(angle)
        piece = soft_box((width * (1 - 0.02 * k), 0.08, 0.018), (0, 0, 0), 0.008)
        d.add(piece.moved((0, y, z), roll=-angle), shell)
    d.add(soft_box((width, depth - 0.12, 0.018), (0, 0.07, seat), 0.008), shell)
    d.add(soft_box((width * 0.88, 0.018, tall - seat - 0.14), (0, -depth / 2 - 0.005, seat + 0.14), 0.008), shell)
    d.zones.append(
        Zone((-width / 2 + 0.03, -depth / 2 + 0.1), (width / 2 - 0.03, depth / 2 - 0.03), seat + 0.02, 0.5, "seat")
    )


def office_chair(d: Draft) -> None:
    """A chair on castors with a column."""
    cover, frame = d.palette.fabric(), d.palette.paint()
    seat, tall, reach = d.u(0.42, 0.54), d.u(0.85, 1.2), d.u(0.26, 0.33)
    for k in range(5):
        a = k * 2 * np.pi / 5 + 0.3
        tip = (reach * float(np.cos(a)), reach * float(np.sin(a)), 0.07)
        d.add(bar((0, 0, 0.1), tip, 0.04, 0.03), frame)
        d.add(cylinder(0.028, 0.06, (tip[0], tip[1], 0.0), sides=8), frame)
    d.add(cylinder(0.03, seat - 0.1, (0, 0, 0.08)), frame)
    d.add(soft_box((d.u(0.44, 0.54), d.u(0.42, 0.52), 0.09), (0, 0, seat - 0.05), 0.04), cover)
    back = soft_box((d.u(0.38, 0.52), 0.07, tall - seat - 0.1), (0, 0, 0), 0.03)
    d.add(back.moved((0, -0.24, seat + 0.1), roll=d.u(0.05, 0.2)), cover)
    d.add(bar((0, -0.18, seat - 0.03), (0, -0.27, seat + 0.25), 0.05, 0.02), frame)
    if d.chance(0.6):
        for side in (-1, 1):
            d.add(bar((side * 0.27, 0, seat - 0.02), (side * 0.29, 0, seat + 0.2), 0.03, 0.05), frame)
            d.add(soft_box((0.06, 0.24, 0.03), (side * 0.29, 0, seat + 0.2), 0.012), frame)
    d.zones.append(Zone((-0.2, -0.14), (0.2, 0.18), seat + 0.04, 0.5, "seat"))


def stool(d: Draft) -> None:
    """A round or square stool without a back."""
    material = d.palette.wood() if d.chance(0.6) else d.palette.paint()
    height, size = d.u(0.4, 0.75), d.u(0.28, 0.42)
    if d.chance(0.5):
        d.add(cylinder(size / 2, 0.035, (0, 0, height - 0.035), sides=24), material)
    else:
        d.add(soft_box((size, size, 0.04), (0, 0, height - 0.04), 0.012), material)
    d.legs((size * 0.8, size * 0.8), height - 0.02, d.u(0.022, 0.04), material, d.u(0.0, 0.06))
    if d.chance(0.5):
        d.add(lathe([(size * 0.42, 0), (size * 0.42, 0.02)], (0, 0, 0.2)), material)
    d.zones.append(Zone((-size / 3, -size / 3), (size / 3, size / 3), height, 0.5, "seat"))


def bench(d: Draft) -> None:
    """A bench without a back, of wood or padded."""
    wood, width, depth, height = d.palette.wood(), d.u(0.9, 1.6), d.u(0.3, 0.45), d.u(0.4, 0.5)
    d.add(box((width, depth, 0.04), (0, 0, height - 0.04)), wood)
    if d.chance(0.4):
        d.add(soft_box((width, depth, 0.07), (0, 0, height), 0.03), d.palette.fabric())
    d.legs((width, depth), height - 0.02, d.u(0.04, 0.07), wood)
    d.zones.append(
        Zone(
            (-width / 2 + 0.05, -depth / 2 + 0.03), (width / 2 - 0.05, depth / 2 - 0.03), d.bounds()[1][2], 0.6, "seat"
        )
    )


def pouf(d: Draft) -> None:
    """A round or square stuffed seat."""
    cover, size, height = d.palette.fabric(), d.u(0.4, 0.7), d.u(0.3, 0.45)
    if d.chance(0.5):
        profile = [(0.0, 0.0), (0.8, 0.0), (1.0, 0.15), (1.05, 0.5), (1.0, 0.85), (0.8, 1.0), (0.0, 1.02)]
        d.add(lathe([(r * size / 2, z * height) for r, z in profile], sides=24), cover)
    else:
        d.add(soft_box((size, size, height), (0, 0, 0), 0.06, 0.05), cover)
    d.zones.append(Zone((-size / 4, -size / 4), (size / 4, size / 4), height + 0.01, 0.5, "seat"))


def folded_chairs(d: Draft) -> None:
    """A stack of two or three equal chairs, each a thing of its own."""
    slatted = d.chance(0.5)
    state = d.rng.bit_generator.state
    (slatted_chair if slatted else shell_chair)(d)
    for k in range(int(d.rng.integers(1, 3))):
        child = d.child()
        now = d.rng.bit_generator.state
        d.rng.bit_generator.state = state
        (slatted_chair if slatted else shell_chair)(child)
        d.rng.bit_generator.state = now
        child.zones.clear()
        d.lay("chair", child, pose_of((0.0, 0.03 * (k + 1), 0.075 * (k + 1))))
    d.zones.clear()


def beanbag(d: Draft) -> None:
    """A bean bag."""
    size = d.u(0.6, 0.95)
    lump = lathe(
        [(0.0, 0.0), (0.42, 0.0), (0.5, 0.12), (0.47, 0.3), (0.34, 0.52), (0.18, 0.68), (0.05, 0.76), (0, 0.77)],
        sides=24,
    )
    wobble = 1 + 0.06 * np.sin(3 * np.arctan2(lump.vertices[:, 1], lump.vertices[:, 0]) + d.u(0, 6))
    d.add(join([lump]).scaled((size, size, size)), d.palette.fabric())
    mesh, material = d.parts[-1]
    d.parts[-1] = (type(mesh)(mesh.vertices * wobble[:, None], mesh.triangles), material)
