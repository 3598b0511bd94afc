"""Furniture in many styles: tops, supports, seats, backs, arms, fronts and feet, put together at random.

The catalogue draws each piece of furniture in two or three ways; what others make looks otherwise. Rooms that are asked
for styles take them instead of half of what the catalogue has for the same place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from training.worlds.draft import Draft, Zone, pose_of
from training.worlds.materials import Material
from training.worlds.mesh import (
    Mesh,
    bar,
    box,
    cylinder,
    grid_triangles,
    lathe,
    pillow,
    rod,
    soft_box,
    tube,
    turn,
    waves,
)
from training.worlds.seating import cushion
from training.worlds.tables import drawers

Range = tuple[float, float]


def _hard(d: Draft) -> Material:
    """Wood, paint or metal."""
    pick = d.rng.random()
    return d.palette.wood() if pick < 0.55 else d.palette.paint() if pick < 0.85 else d.palette.metal()


def _soft(d: Draft) -> Material:
    """Cloth, or leather, which is of one colour."""
    return d.palette.fabric() if d.chance(0.65) else d.palette.paint()


def _post(d: Draft) -> Callable[[float], Mesh]:
    """One way to make a leg, of any height: square, round, tapered, turned, flat."""
    kind, w, taper = int(d.rng.integers(5)), d.u(0.022, 0.085), d.u(0.35, 1.0)
    turned = np.clip(d.rng.uniform(0.35, 1.0, 9), 0.3, 1.0)

    def make(h: float) -> Mesh:
        if kind == 0:
            return box((w, w, h))
        if kind == 1:
            return cylinder(w / 2, h)
        if kind == 2:
            return cylinder(w / 2 * taper, h, top=w / 2)
        if kind == 3:
            line = zip((turned * w / 2).tolist(), np.linspace(0, h, 9).tolist(), strict=True)
            return lathe([(0.0, 0.0), *line], sides=12)
        return box((w * 1.3, w * 0.4, h))

    return make


def _legs(d: Draft, size: tuple[float, float], h: float, material: Material) -> None:
    """Four equal legs under a rectangle, upright or splayed, at times with bars between them."""
    post, splay, inset = _post(d), d.u(0.0, 0.09) if d.chance(0.4) else 0.0, d.u(0.01, 0.08)
    x, y = max(size[0] / 2 - inset - 0.02, 0.03), max(size[1] / 2 - inset - 0.02, 0.03)
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = post(h)
            down = (1 - leg.vertices[:, 2] / h)[:, None] * np.array([[sx * splay, sy * splay, 0.0]])
            d.add(Mesh(leg.vertices + down, leg.triangles).moved((sx * x, sy * y, 0.0)), material)
    low, thick = h * d.u(0.12, 0.5), d.u(0.015, 0.035)
    pick = int(d.rng.integers(5))
    if pick in (0, 1):
        for sx in (-1, 1):
            d.add(bar((sx * x, -y, low), (sx * x, y, low), thick, thick), material)
        if pick == 0:
            d.add(bar((-x, 0, low), (x, 0, low), thick, thick), material)
    if pick == 2:
        for sy in (-1, 1):
            d.add(bar((-x, sy * y, low), (x, sy * y, low), thick, thick), material)


def _support(d: Draft, size: tuple[float, float], h: float, material: Material) -> None:
    """What carries a top: legs, ends, frames, columns, a block."""
    w, deep = size
    kind = int(d.rng.integers(9))
    if kind <= 3:
        _legs(d, size, h, material)
    elif kind == 4:
        thick, x = d.u(0.02, 0.09), w / 2 - d.u(0.02, 0.15) * w
        for side in (-1, 1):
            d.add(box((thick, deep * d.u(0.6, 0.98), h), (side * x, 0, 0)), material)
    elif kind == 5:
        x, thick, tilt = w * d.u(0.3, 0.45), d.u(0.025, 0.06), d.u(0.0, 0.35) * deep
        for side in (-1, 1):
            crossed = d.chance(0.4)
            for sy in (-1, 1):
                foot, top = sy * deep * 0.42, sy * (deep * 0.42 - tilt) * (-1 if crossed else 1)
                d.add(bar((side * x, foot, 0), (side * x, top, h), thick, thick), material)
            for z in (0.0, h - thick)[: int(d.rng.integers(3))]:
                d.add(box((thick, deep * 0.84, thick), (side * x, 0, z)), material)
        if d.chance(0.5):
            d.add(bar((-x, 0, h * 0.4), (x, 0, h * 0.4), thick, thick), material)
    elif kind in (6, 7):
        _columns(d, size, h, material)
    else:
        inset = d.u(0.6, 0.95)
        body = box((w * inset, deep * inset, h)) if d.chance(0.6) else cylinder(0.5, h).scaled((w * inset, deep, 1.0))
        d.add(body, material)


def _columns(d: Draft, size: tuple[float, float], h: float, material: Material) -> None:
    """One column or two, each on a disc, a cross or a plate."""
    w, deep = size
    spots = (-w * 0.27, w * 0.27) if w > 1.2 and d.chance(0.6) else (0.0,)
    thick, foot, reach = d.u(0.025, 0.09), int(d.rng.integers(3)), min(w / len(spots), deep) * d.u(0.3, 0.46)
    arms = int(d.rng.integers(3, 6))
    post = cylinder(thick, h, top=thick * d.u(0.6, 1.2))
    for x in spots:
        d.add(post.moved((x, 0, 0)), material)
        if foot == 0:
            d.add(lathe([(0, 0.05), (thick, 0.045), (reach * 0.9, 0.015), (reach, 0.0)], (x, 0, 0), 28), material)
        elif foot == 1:
            for k in range(arms):
                a = 2 * np.pi * (k + 0.5) / arms
                tip = (x + reach * float(np.cos(a)), reach * float(np.sin(a)), 0.02)
                d.add(bar((x, 0, d.u(0.06, 0.2)), tip, 0.05, 0.035), material)
        else:
            d.add(box((reach * 1.6, reach * 1.6, d.u(0.01, 0.05)), (x, 0, 0)), material)


def _top(d: Draft, size: tuple[float, float], z: float, material: Material, use: str = "top") -> None:
    """A top of some outline and edge, with the zone on it; its upper face is at z."""
    w, deep = size
    thick, shape = d.u(0.012, 0.06), int(d.rng.integers(8))
    if d.chance(0.08):
        material = replace(d.palette.glass(), glass=float(d.rng.choice([0.0, 0.4, 0.9])))
    share = 1.0
    if shape <= 3:
        d.add(box((w, deep, thick), (0, 0, z - thick)), material)
    elif shape == 4:
        d.add(soft_box((w, deep, thick), (0, 0, z - thick), thick * 0.45), material)
    elif shape == 5:
        profile = [(0.0, 0.0), (0.5, 0.0), (0.5, thick * 0.6), (0.485, thick), (0.0, thick)]
        d.add(lathe(profile, sides=36).scaled((w, deep, 1.0)).moved((0, 0, z - thick)), material)
        share = 0.68
    elif shape == 6:
        sides = int(d.rng.choice([6, 8]))
        d.add(cylinder(0.5, thick, sides=sides).scaled((w, deep, 1.0)).moved((0, 0, z - thick)), material)
        share = 0.66
    else:
        x = np.linspace(-0.5, 0.5, 13)
        half = 0.5 * (1 - d.u(0.3, 1.2) * x**2)
        rim = np.concatenate([np.stack([x, -half], 1), np.stack([x[::-1], half[::-1]], 1)])
        d.add(_prism(rim * np.array([w, deep]), thick).moved((0, 0, z - thick)), material)
        share = 0.8
    m = 0.02
    low, high = (-w / 2 * share + m, -deep / 2 * share + m), (w / 2 * share - m, deep / 2 * share - m)
    if min(high[0] - low[0], high[1] - low[1]) > 0.08:
        d.zones.append(Zone(low, high, z, 0.9, use))


def _prism(rim: NDArray[np.float64], h: float) -> Mesh:
    """A star-shaped outline (N, 2) about the origin, drawn up to a height."""
    n = len(rim)
    ring = np.concatenate(
        [np.column_stack([rim, np.full(n, z)]) for z in (0.0, h)] + [np.array([[0, 0, 0], [0, 0, h]])]
    )
    k = np.arange(n)
    after = (k + 1) % n
    low, top = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    sides = [np.stack([k, after, k + n], 1), np.stack([after, after + n, k + n], 1)]
    return Mesh(ring, np.concatenate([*sides, np.stack([k, after, low], 1), np.stack([k + n, after + n, top], 1)]))


def table(width: Range, deep: Range, height: Range) -> Callable[[Draft], None]:
    """Return what builds a table of a size."""

    def build(d: Draft) -> None:
        size, h = (d.u(*width), d.u(*deep)), d.u(*height)
        wood = _hard(d)
        other = wood if d.chance(0.6) else _hard(d)
        if d.chance(0.3):
            low = h * d.u(0.2, 0.5)
            d.add(box((size[0] * 0.86, size[1] * 0.86, 0.02), (0, 0, low)), other)
            half = (size[0] * 0.4, size[1] * 0.4)
            if half[1] > 0.08:
                d.zones.append(Zone((-half[0], -half[1]), half, low + 0.02, h - low - 0.12, "shelf"))
        if d.chance(0.35):
            deep_apron, inset = d.u(0.05, 0.14), d.u(0.0, 0.1)
            apron = (size[0] - inset - 0.04, size[1] - inset - 0.04, deep_apron)
            d.add(box(apron, (0, 0, h - deep_apron - 0.02)), other)
            if d.chance(0.4) and deep_apron > 0.08:
                count = int(d.rng.integers(1, 4))
                drawers(d, (apron[0] * 0.9, deep_apron), (0, apron[1] / 2, h - deep_apron - 0.02), 1, count)
        _support(d, size, h - 0.012, other)
        _top(d, size, h, wood)
        if d.chance(0.08) and size[0] > 0.6:
            _table_cloth(d, size, h)

    return build


def _table_cloth(d: Draft, size: tuple[float, float], h: float) -> None:
    """A cloth over the top that hangs down, a part of the table."""
    drop, rows = d.u(0.12, min(0.5, h - 0.1)), 24
    line = np.linspace(-0.5, 0.5, rows)
    x, y = np.meshgrid(line * (size[0] + 2 * drop), line * (size[1] + 2 * drop))
    over = np.maximum(np.abs(x) - size[0] / 2, 0) + np.maximum(np.abs(y) - size[1] / 2, 0)
    z = h + 0.004 - np.minimum(over, drop)
    fold = 1 + 0.04 * np.sin(d.u(10, 30) * (x + y)) * (over > 0)
    limit = (size[0] / 2 + 0.02, size[1] / 2 + 0.02)
    points = np.stack([np.clip(x, -limit[0], limit[0]) * fold, np.clip(y, -limit[1], limit[1]) * fold, z], -1)
    d.add(Mesh(points.reshape(-1, 3), grid_triangles(rows, rows)), d.palette.fabric())
    d.zones = [replace(zone, z=zone.z + 0.006) if zone.z >= h - 1e-6 else zone for zone in d.zones]


def desk(d: Draft) -> None:
    """A desk: plain, with pedestals, a return, a hutch or a screen."""
    size, h = (d.u(0.9, 2.0), d.u(0.5, 0.9)), d.u(0.68, 0.78)
    wood = _hard(d)
    other = wood if d.chance(0.5) else _hard(d)
    pedestals = [s for s in (-1, 1) if d.chance(0.45)]
    if pedestals:
        block, tall, foot = d.u(0.32, 0.5), h - 0.05, d.u(0.0, 0.08)
        for side in pedestals:
            x = side * (size[0] / 2 - block / 2 - d.u(0.0, 0.04))
            d.add(box((block, size[1] * 0.92, tall - foot), (x, 0, foot)), other)
            drawers(d, (block, tall - foot), (x, size[1] * 0.46, foot), int(d.rng.integers(1, 5)))
    if len(pedestals) < 2:
        _support(d, size, h - 0.012, other)
    if d.chance(0.35):
        deep = d.u(0.15, h - 0.05)
        d.add(box((size[0] * 0.92, 0.02, deep), (0, -size[1] / 2 + d.u(0.02, 0.1), h - 0.03 - deep)), other)
    d.add(box((size[0], size[1], 0.03), (0, 0, h - 0.03)), wood)
    back = -size[1] / 2
    if d.chance(0.25):
        _hutch(d, size, h, other)
        back += 0.3
    elif d.chance(0.2):
        cover = d.palette.fabric() if d.chance(0.7) else _hard(d)
        d.add(box((size[0], 0.04, d.u(0.3, 0.6)), (0, -size[1] / 2 - 0.02, h - d.u(0.0, 0.2))), cover)
    if d.chance(0.2):
        side, long, deep = d.rng.choice([-1, 1]), d.u(0.5, 1.1), d.u(0.4, 0.6)
        x = side * (size[0] / 2 - deep / 2)
        d.add(box((deep, long, 0.03), (x, size[1] / 2 + long / 2, h - 0.03)), wood)
        d.add(box((deep * 0.9, 0.03, h - 0.03), (x, size[1] / 2 + long - 0.05, 0)), other)
    if size[1] / 2 - back > 0.2:
        d.zones.append(
            Zone((-size[0] / 2 + 0.02, back + 0.02), (size[0] / 2 - 0.02, size[1] / 2 - 0.02), h, 0.8, "desk")
        )


def _hutch(d: Draft, size: tuple[float, float], h: float, material: Material) -> None:
    """Boards over the back of a desk."""
    tall, deep = d.u(0.3, 0.8), d.u(0.2, 0.28)
    y = -size[1] / 2 + deep / 2
    for x in np.linspace(-size[0] / 2 + 0.01, size[0] / 2 - 0.01, int(d.rng.integers(2, 5))):
        d.add(box((0.02, deep, tall), (float(x), y, h)), material)
    for z in np.linspace(tall * 0.5, tall, int(d.rng.integers(1, 3))):
        d.add(box((size[0], deep, 0.02), (0, y, h + float(z))), material)
        low, high = (-size[0] / 2 + 0.03, y - deep / 2 + 0.01), (size[0] / 2 - 0.03, y + deep / 2 - 0.01)
        d.zones.append(Zone(low, high, h + float(z) + 0.02, 0.25, "shelf"))


def chair(d: Draft) -> None:
    """A chair of one of many makes, with arms or without."""
    frame = _hard(d)
    cover = _soft(d) if d.chance(0.6) else frame
    w, deep, seat, tall = d.u(0.38, 0.58), d.u(0.38, 0.55), d.u(0.4, 0.5), d.u(0.72, 1.25)
    under = int(d.rng.integers(6))
    if under <= 2:
        _legs(d, (w, deep), seat, frame)
    elif under == 3:
        _bent_frame(d, (w, deep), seat, frame)
    elif under == 4:
        _star(d, seat, frame)
    else:
        _columns(d, (w, deep), seat, frame)
    thick, y = d.u(0.015, 0.12), -deep / 2 + 0.02
    if d.chance(0.75):
        d.add(soft_box((w, deep, thick), (0, 0, seat - thick * 0.5), min(0.04, thick * 0.45), d.u(0, 0.15)), cover)
    else:
        d.add(cylinder(0.5, thick, sides=24).scaled((w, deep, 1.0)).moved((0, 0, seat - thick * 0.5)), cover)
    top = seat + thick * 0.5
    _back(d, (w, y), (top, tall), frame, cover)
    if d.chance(0.45):
        arm, out = d.u(0.16, 0.26), w / 2 + d.u(-0.02, 0.03)
        pad, front = d.u(0.02, 0.07), deep * d.u(0.1, 0.45)
        for side in (-1, 1):
            d.add(soft_box((pad, front - y, 0.03), (side * out, (front + y) / 2, top + arm), 0.012), frame)
            for place in (front - 0.02, y + 0.03)[: int(d.rng.integers(1, 3))]:
                d.add(
                    bar((side * (out - 0.01), place, seat - 0.02), (side * out, place, top + arm), 0.025, 0.025), frame
                )
    d.zones.append(Zone((-w / 2 + 0.04, y + 0.08), (w / 2 - 0.04, deep / 2 - 0.04), top + 0.005, 0.5, "seat"))


def _bent_frame(d: Draft, size: tuple[float, float], seat: float, material: Material) -> None:
    """Bent tubes: a cantilever or a sledge."""
    w, deep = size
    r, swings = d.u(0.01, 0.018), d.chance(0.5)
    for side in (-1, 1):
        x = side * (w / 2 - 0.03)
        line = [(x, deep * 0.45, seat - 0.01), (x, deep * 0.45, r), (x, -deep * 0.45, r)]
        if not swings:
            line.append((x, -deep * 0.45, seat - 0.01))
        d.add(tube(np.array(line), r), material)
    d.add(rod((-w / 2 + 0.03, -deep * 0.45, r), (w / 2 - 0.03, -deep * 0.45, r), r), material)
    if swings:
        d.add(box((w - 0.05, deep * 0.95, 0.015), (0, 0, seat - 0.02)), material)


def _star(d: Draft, seat: float, material: Material) -> None:
    """A column on a star of arms, with castors or glides."""
    arms, reach, thick = int(d.rng.integers(4, 6)), d.u(0.24, 0.34), d.u(0.025, 0.05)
    wheel = d.u(0.02, 0.06)
    for k in range(arms):
        a = 2 * np.pi * k / arms + 0.3
        tip = (reach * float(np.cos(a)), reach * float(np.sin(a)), wheel)
        d.add(bar((0, 0, wheel + d.u(0.02, 0.06)), tip, thick, thick * 0.8), material)
        d.add(cylinder(wheel * 0.55, wheel, (tip[0], tip[1], 0.0), sides=8), material)
    d.add(cylinder(d.u(0.02, 0.035), seat - wheel, (0, 0, wheel)), material)


Parts = list[tuple[Mesh, Material]]


def _back(d: Draft, at: tuple[float, float], z: tuple[float, float], frame: Material, cover: Material) -> None:
    """The back of a chair between two heights, which may lean."""
    w, y, (low, high) = at[0], at[1], z
    kind, lean = int(d.rng.integers(8)), d.u(0.0, 0.25)
    tall, parts = high - low, []
    if kind in (0, 1, 2, 5):
        post = _post(d)(tall)
        parts += [(post.moved((side * (w / 2 - 0.025), 0, 0)), frame) for side in (-1, 1)]
    make = (_slats, _spindles, _cross, _pad, _hoop, _board, _bent, _bent)[kind]
    for mesh, material in parts + make(d, w, tall, (frame, cover)):
        d.add(mesh.moved((0, y, low - 0.01), roll=lean), material)


def _slats(d: Draft, w: float, tall: float, of: tuple[Material, Material]) -> Parts:
    wide = w - 0.05
    return [
        (box((wide, 0.018, d.u(0.03, 0.09)), (0, 0, tall * float(share) - 0.04)), of[0])
        for share in np.linspace(d.u(0.2, 0.5), 0.95, int(d.rng.integers(2, 6)))
    ]


def _spindles(d: Draft, w: float, tall: float, of: tuple[Material, Material]) -> Parts:
    x = w / 2 - 0.025
    places = np.linspace(-x * 0.8, x * 0.8, int(d.rng.integers(3, 8)))
    rods = [(rod((float(k), 0, 0), (float(k), 0, tall), d.u(0.006, 0.012)), of[0]) for k in places]
    return [*rods, (box((w - 0.02, 0.03, d.u(0.04, 0.1)), (0, 0, tall - 0.05)), of[0])]


def _cross(d: Draft, w: float, tall: float, of: tuple[Material, Material]) -> Parts:
    x = w / 2 - 0.025
    bars = [(bar((-s * x, 0, 0.05), (s * x, 0, tall - 0.05), 0.03, 0.02), of[0]) for s in (-1, 1)]
    return [*bars, (box((2 * x, 0.025, 0.05), (0, 0, tall - 0.05)), of[0])]


def _pad(d: Draft, w: float, tall: float, of: tuple[Material, Material]) -> Parts:
    gap = d.u(0.0, 0.18)
    pad = soft_box((w * d.u(0.75, 1.0), d.u(0.03, 0.14), tall - gap), (0, 0, gap), 0.03, d.u(0, 0.15))
    return [(pad, of[1]), (bar((0, -0.03, -0.02), (0, -0.03, tall * 0.6), d.u(0.03, 0.12), 0.02), of[0])]


def _hoop(d: Draft, w: float, tall: float, of: tuple[Material, Material]) -> Parts:
    x, a = w / 2 - 0.025, np.linspace(0, np.pi, 13)
    parts = [(tube(np.stack([x * np.cos(a), np.zeros(13), tall * np.sin(a)], 1), 0.013), of[0])]
    for k in np.linspace(-x * 0.6, x * 0.6, int(d.rng.integers(2, 7))).tolist():
        reach = tall * float(np.sqrt(1 - (k / x) ** 2))
        parts.append((rod((k, 0, 0), (k, 0, reach), 0.007), of[0]))
    return parts


def _board(d: Draft, w: float, tall: float, of: tuple[Material, Material]) -> Parts:
    return [(box((w - 0.05, 0.016, tall * d.u(0.4, 0.9)), (0, 0, tall * 0.1)), of[1])]


def _bent(d: Draft, w: float, tall: float, of: tuple[Material, Material]) -> Parts:
    columns, depth, parts = 9, d.u(0.02, 0.22), []
    for low, high in pairwise(np.linspace(-1, 1, columns).tolist()):
        m = (low + high) / 2
        board = box((w / (columns - 2), d.u(0.015, 0.05), tall * (1 - 0.25 * m * m)))
        yaw = float(np.arctan(2 * depth * m / (w / 2)))
        parts.append((board.moved((m * w / 2, depth * m * m, 0), yaw=yaw), of[1]))
    return parts


def sofa(d: Draft) -> None:
    """A sofa for one and a half to four, with boxed, round, sloping or wooden arms, its seat in one or in cushions."""
    cover = _soft(d)
    w, deep, seat, tall = d.u(1.2, 2.9), d.u(0.75, 1.1), d.u(0.34, 0.48), d.u(0.62, 1.0)
    foot, thick, arm = d.u(0.0, 0.18), d.u(0.12, 0.3), d.u(0.06, 0.3)
    hard = _hard(d)
    if foot > 0.03:
        _legs(d, (w, deep), foot + 0.02, hard)
    base = d.u(0.12, max(0.13, seat - foot - 0.1))
    d.add(soft_box((w - 0.02, deep - 0.02, base), (0, 0, foot), 0.02), cover)
    style, inside = int(d.rng.integers(5)), w - 2 * arm
    high = d.u(seat + 0.06, min(seat + 0.3, tall + 0.02))
    for side in (-1, 1) if style < 4 else ():
        x = side * (w - arm) / 2
        if style == 0:
            d.add(soft_box((arm, deep, high - foot), (x, 0, foot), d.u(0.01, 0.05)), cover)
        elif style == 1:
            d.add(soft_box((arm * 0.8, deep, high - foot - arm / 2), (x, 0, foot), 0.02), cover)
            roll = cylinder(arm * 0.55, deep, sides=18).moved((0, deep / 2, 0), roll=np.pi / 2)
            d.add(roll.moved((x, 0, high - arm * 0.3)), cover)
        elif style == 2:
            arm_piece = soft_box((arm, deep, high - foot), (x, 0, foot), 0.03)
            slope = 1 - d.u(0.1, 0.45) * (arm_piece.vertices[:, 1] / deep + 0.5)
            d.add(
                Mesh(arm_piece.vertices * np.stack([slope * 0 + 1, slope * 0 + 1, slope], 1), arm_piece.triangles),
                cover,
            )
        else:
            for place in (-deep * 0.4, deep * 0.4):
                d.add(bar((x, place, 0), (x, place, high), 0.05, 0.05), hard)
            d.add(box((0.07, deep, 0.035), (x, 0, high)), hard)
    lean = d.u(0.0, 0.25)
    back = soft_box((w, thick, tall - foot - base * 0.5), (0, 0, 0), d.u(0.02, 0.12))
    d.add(back.moved((0, -deep / 2 + thick / 2, foot + base * 0.5), roll=lean), cover)
    places = int(np.clip(round(inside / d.u(0.5, 0.9)), 1, 4)) if d.chance(0.8) else 1
    each, front = inside / places, deep - thick
    own = cover if d.chance(0.85) else _soft(d)
    for k in range(places):
        x = -inside / 2 + each * (k + 0.5)
        d.add(
            soft_box(
                (each * 0.98, front, seat - foot - base + 0.03), (x, thick / 2, foot + base - 0.02), 0.05, d.u(0, 0.2)
            ),
            own,
        )
        if d.chance(0.6):
            tall_pad = (tall - seat) * d.u(0.6, 1.15)
            pad = soft_box((each * 0.96, d.u(0.1, 0.2), tall_pad), (0, 0, 0), 0.05, d.u(0.0, 0.3))
            d.add(pad.moved((x, -deep / 2 + thick + 0.07, seat), roll=lean + d.u(0, 0.1)), own)
    if d.chance(0.25):
        side, wide, long = d.rng.choice([-1, 1]), d.u(0.6, 0.95), d.u(0.5, 1.1)
        piece = soft_box((wide, long, seat - foot), (side * (w - wide) / 2, deep / 2 + long / 2 - 0.03, foot), 0.05)
        d.add(piece, cover)
    d.zones.append(
        Zone((-inside / 2, -deep / 2 + thick + 0.2), (inside / 2, deep / 2 - 0.05), seat + 0.03, 0.6, "seat")
    )
    for x in np.linspace(-inside / 2 + 0.2, inside / 2 - 0.2, int(d.rng.integers(0, places + 2))):
        child = d.child()
        cushion(child)
        size = child.bounds()[1] - child.bounds()[0]
        tilt = d.u(0.9, 1.35)
        spot = (
            float(x) + d.u(-0.1, 0.1),
            -deep / 2 + thick + size[2] / 2 + 0.24,
            seat + size[1] / 2 * np.sin(tilt) + 0.02,
        )
        d.lay("cushion", child, pose_of(spot, turn(d.u(-0.4, 0.4)) @ turn(roll=tilt)))


def case(width: Range, deep: Range, height: Range) -> Callable[[Draft], None]:
    """Return what builds a cupboard, chest or sideboard of a size: a body with a grid of doors, drawers and niches."""

    def build(d: Draft) -> None:
        w, t, h, foot = d.u(*width), d.u(*deep), d.u(*height), d.u(0.0, 0.2) if d.chance(0.7) else 0.0
        wood = _hard(d)
        face = wood if d.chance(0.55) else _hard(d)
        if foot > 0.02:
            _legs(d, (w, t), foot + 0.005, wood if d.chance(0.6) else d.palette.metal())
        thick, tall = d.u(0.015, 0.035), h - foot
        columns, rows = max(1, round(w / d.u(0.35, 0.8))), max(1, round(tall / d.u(0.2, 0.9)))
        each, step = w / columns, tall / rows
        for k in range(columns + 1):
            x = -w / 2 + each * k
            d.add(box((thick, t, tall), (float(np.clip(x, -w / 2 + thick / 2, w / 2 - thick / 2)), 0, foot)), wood)
        for r in range(rows + 1):
            d.add(box((w, t, thick), (0, 0, foot + min(step * r, tall - thick))), wood)
        d.add(box((w, 0.01, tall), (0, -t / 2 + 0.005, foot)), wood)
        niches = d.u(0.0, 0.4) if d.chance(0.5) else 0.0
        hung = d.u(0.0, 1.0)
        for k in range(columns):
            for r in range(rows):
                x, z = -w / 2 + each * (k + 0.5), foot + step * r
                if d.chance(niches):
                    low, high = (x - each / 2 + 0.03, -t / 2 + 0.03), (x + each / 2 - 0.03, t / 2 - 0.01)
                    d.zones.append(Zone(low, high, z + thick, step - thick - 0.02, "shelf"))
                    continue
                _front(d, (each, t, step), (x, z), face, drawer=d.chance(0.75 if step < 0.3 else hung * 0.3))
        if d.chance(0.4):
            over = d.u(0.0, 0.05)
            d.add(box((w + over, t + over, d.u(0.015, 0.06)), (0, 0, h)), wood)
        top = float(d.bounds()[1][2])
        if top < 2.0:
            d.zones.append(Zone((-w / 2 + 0.02, -t / 2 + 0.02), (w / 2 - 0.02, t / 2 - 0.02), top, 0.8))

    return build


def _front(
    d: Draft, size: tuple[float, float, float], at: tuple[float, float], face: Material, *, drawer: bool
) -> None:
    """A door or the front of a drawer in a cell, plain, framed or glazed, with a grip, at times ajar."""
    each, t, step = size
    x, z = at
    gap, thick = 0.004, d.u(0.012, 0.025)
    panel = [(box((each - gap, thick, step - gap), (0, thick / 2, gap / 2)), face)]
    if d.chance(0.25):
        e = min(0.08, each * 0.15, step * 0.15)
        inner = box((each - 2 * e, thick * 0.5, step - 2 * e), (0, thick * 1.2, e))
        panel.append((inner, face if d.chance(0.6) else d.palette.glass()))
    grip, metal = int(d.rng.integers(4)), d.palette.metal()
    side, middle = (0.0, step * 0.5) if drawer else (each * 0.4, step * 0.5)
    if grip == 0:
        panel.append((cylinder(0.014, 0.025, sides=8).moved((side, thick, middle), roll=-np.pi / 2), metal))
    elif grip == 1:
        half = min(0.09, each * 0.3)
        ends = (
            ((side - half, middle), (side + half, middle)) if drawer else ((side, middle - half), (side, middle + half))
        )
        panel.append(
            (rod((ends[0][0], thick + 0.03, ends[0][1]), (ends[1][0], thick + 0.03, ends[1][1]), 0.006), metal)
        )
    ajar = d.chance(0.06)
    out, angle = (d.u(0.04, 0.2), 0.0) if drawer and ajar else (0.0, d.u(0.15, 1.4) if ajar else 0.0)
    for mesh, material in panel:
        hinged = mesh.moved((each / 2, 0, 0)).moved((-each / 2, 0, 0), yaw=angle)
        d.add(hinged.moved((x, t / 2 + out, z)), material)
    if out:
        d.add(box((each - 0.04, out, step * 0.7), (x, t / 2 + out / 2, z + step * 0.1)), face)


def shelf(width: Range, deep: Range, height: Range) -> Callable[[Draft], None]:
    """Return what builds an open shelf of a size: boards on posts or between sides, all of one depth or not."""

    def build(d: Draft) -> None:
        w, t, h = d.u(*width), d.u(*deep), d.u(*height)
        wood = _hard(d)
        post = wood if d.chance(0.6) else d.palette.metal()
        kind, thick = int(d.rng.integers(5)), d.u(0.012, 0.05)
        columns = max(1, round(w / d.u(0.35, 1.1)))
        levels = np.linspace(d.u(0.02, 0.25), h - thick, max(2, round(h / d.u(0.22, 0.5)) + 1))
        if d.chance(0.25):
            levels = np.sort(np.concatenate([levels[[0, -1]], d.rng.uniform(0.15, h - 0.15, len(levels) - 1)]))
            levels = levels[np.append(True, np.diff(levels) > 0.14)]
        xs = np.linspace(-w / 2 + thick / 2, w / 2 - thick / 2, columns + 1)
        sides = kind != 1
        for x in xs.tolist():
            if sides:
                d.add(box((thick, t, h), (x, 0, 0)), wood)
            else:
                for y in (-t / 2 + 0.015, t / 2 - 0.015):
                    d.add(bar((x, y, 0), (x, y, h), d.u(0.015, 0.03), 0.02), post)
        if kind == 1 and d.chance(0.5):
            d.add(bar((-w / 2, -t / 2, 0.1), (w / 2, -t / 2, h - 0.1), 0.015, 0.01), post)
            d.add(bar((w / 2, -t / 2, 0.1), (-w / 2, -t / 2, h - 0.1), 0.015, 0.01), post)
        if sides and d.chance(0.6):
            back = wood if d.chance(0.6) else d.palette.paint()
            d.add(box((w, 0.01, h), (0, -t / 2 + 0.005, 0)), back)
        deeper = np.linspace(1.0, d.u(0.4, 1.0) if kind == 2 else 1.0, len(levels))
        for k, z in enumerate(levels.tolist()):
            own = t * float(deeper[k])
            y = -t / 2 + own / 2
            d.add(box((w, own, thick), (0, y, z)), wood)
            room = float(levels[k + 1]) - z - thick - 0.02 if k + 1 < len(levels) else 0.4
            for left, right in pairwise(xs.tolist()):
                if room > 0.08 and z < 2.1 and own > 0.12:
                    low, high = (left + 0.03, y - own / 2 + 0.02), (right - 0.03, y + own / 2 - 0.01)
                    d.zones.append(Zone(low, high, z + thick, room, "shelf"))
        if d.chance(0.2):
            tall = float(levels[1] - levels[0])
            for left, right in pairwise(xs.tolist()):
                _front(d, (right - left, t, tall), ((left + right) / 2, float(levels[0])), wood, drawer=False)
            d.zones = [z for z in d.zones if z.z > levels[0] + thick + 0.01]

    return build


def bed(d: Draft) -> None:
    """A bed or a bunk bed with ends of boards, bars, pads or none, drawers below, posts at times."""
    wood, sheet = _hard(d), d.palette.fabric()
    w, long, frame, top = d.u(0.8, 2.0), d.u(1.85, 2.15), d.u(0.15, 0.38), d.u(0.35, 0.68)
    top = max(top, frame + 0.1)
    body = wood if d.chance(0.65) else d.palette.fabric()
    raised = d.u(0.04, 0.2) if d.chance(0.6) else 0.0
    if raised:
        _legs(d, (w, long), raised + 0.01, wood)
    d.add(soft_box((w, long, frame - raised), (0, 0, raised), 0.015), body)
    if raised < 0.08 and d.chance(0.3):
        drawers(d, (long * 0.5, frame - raised), (0, 0, 0), 1, 2)
        for k in range(len(d.parts) - 4, len(d.parts)):
            mesh, material = d.parts[k]
            d.parts[k] = (mesh.moved((w / 2 - 0.01, 0, raised), yaw=-np.pi / 2), material)
    d.add(soft_box((w * 0.97, long * 0.97, top - frame + 0.01), (0, 0, frame - 0.01), 0.05, d.u(0, 0.05)), sheet)
    for side, tall in ((-1, d.u(0.55, 1.4)), (1, d.u(0.3, 0.8))):
        kind = int(d.rng.integers(4))
        if side > 0 and d.chance(0.6):
            continue
        y = side * (long / 2 + 0.02)
        if kind <= 1:
            end = soft_box((w + d.u(0, 0.15), d.u(0.02, 0.14), tall), (0, y, 0), 0.02)
            d.add(end, wood if kind == 0 else _soft(d))
        else:
            for x in (-w / 2, w / 2):
                d.add(_post(d)(tall).moved((x, y, 0)), wood)
            for z in (frame, tall - 0.05):
                d.add(box((w, 0.03, 0.05), (0, y, z)), wood)
            for x in np.linspace(-w / 2, w / 2, int(d.rng.integers(4, 12))):
                d.add(rod((float(x), y, frame), (float(x), y, tall - 0.02), 0.01), wood)
    cover = d.palette.fabric()
    for k in range(int(d.rng.integers(1, 5))):
        child = d.child()
        child.add(pillow((d.u(0.35, 0.75), d.u(0.3, 0.6), d.u(0.08, 0.2))), cover if k < 2 else d.palette.fabric())
        spot = (d.u(-0.4, 0.4) * w * 0.7, -long / 2 + 0.25 + 0.14 * (k // 2), top + 0.015 + 0.1 * (k // 2))
        d.lay("pillow", child, pose_of(spot, turn(d.u(-0.3, 0.3)) @ turn(roll=d.u(-0.05, 0.9))))
    if d.chance(0.75):
        child, share = d.child(), d.u(0.35, 0.8)
        rows = 22
        across = np.linspace(-0.5, 0.5, 24) * (w + d.u(-0.3, 0.6))
        over = np.clip(np.abs(across) - w / 2, 0, top - 0.1)
        x = np.sign(across) * np.minimum(np.abs(across), w / 2 + 0.02 + 0.1 * over)
        z = 0.04 - over[None] + np.abs(waves(d.rng, (rows, 24), d.u(0.005, 0.05), 4.0))
        y = np.linspace(-0.5, 0.5, rows)[:, None] * long * share + waves(d.rng, (rows, 24), 0.01)
        child.add(
            Mesh(np.stack([np.broadcast_to(x, z.shape), y, z], -1).reshape(-1, 3), grid_triangles(rows, 24)),
            d.palette.fabric(),
        )
        d.lay("duvet", child, pose_of((0, long / 2 * (1 - share), top)))
    d.zones.append(Zone((-w / 2 + 0.1, -long / 2 + 0.7), (w / 2 - 0.1, long / 2 - 0.1), top + 0.08, 0.6, "bed"))


def lamp(d: Draft) -> None:
    """A lamp that stands on the floor: on a disc, three legs, an arc, with a shade of some shape."""
    m, shade, h = _hard(d), d.palette.fabric() if d.chance(0.6) else d.palette.paint(), d.u(1.1, 2.0)
    r, tall, kind = d.u(0.08, 0.28), d.u(0.12, 0.45), int(d.rng.integers(3))
    at = (0.0, 0.0, h - tall)
    if kind == 0:
        d.add(cylinder(d.u(0.1, 0.2), d.u(0.01, 0.05)), m)
        d.add(rod((0, 0, 0), (0, 0, h - tall * 0.3), d.u(0.008, 0.025)), m)
    elif kind == 1:
        for k in range(3):
            a = 2 * np.pi * k / 3
            foot = (0.28 * float(np.cos(a)), 0.28 * float(np.sin(a)), 0.0)
            d.add(rod(foot, (0, 0, h - tall * 0.5), d.u(0.01, 0.025)), m)
    else:
        a, reach = np.linspace(0, np.pi * d.u(0.5, 0.75), 12), d.u(0.35, 0.8)
        line = np.stack(
            [
                reach * (1 - np.cos(a)),
                np.zeros(12),
                h * np.sin(np.minimum(a, np.pi / 2)) - 0.15 * np.maximum(a - 1.57, 0),
            ],
            1,
        )
        d.add(tube(line, 0.012), m)
        d.add(cylinder(0.16, 0.04), m)
        at = (float(line[-1, 0]), 0.0, float(line[-1, 2]) - tall)
    lower = r * d.u(0.6, 1.3)
    d.add(
        lathe([(r, 0.0), (lower, tall)] if d.chance(0.7) else [(0.02, 0.0), (r, tall * 0.5), (0.02, tall)], at, 26),
        shade,
    )


def plant(d: Draft) -> None:
    """A plant in a pot: blades, fronds, a tree with a crown, a cactus."""
    pot, leaf = _hard(d), d.palette.leaf()
    r, tall, kind = d.u(0.06, 0.22), d.u(0.1, 0.45), int(d.rng.integers(4))
    if d.chance(0.75):
        d.add(
            lathe(
                [(0, 0), (r * d.u(0.6, 1.1), 0), (r, tall), (r * 0.85, tall), (r * 0.8, tall * 0.9), (0, tall * 0.9)]
            ),
            pot,
        )
    else:
        d.add(box((2 * r, 2 * r, tall)), pot)
    high = d.u(0.2, 1.3)
    if kind == 0:
        for _ in range(int(d.rng.integers(6, 26))):
            a, lean = d.u(0, 6.3), d.u(0.05, 0.7)
            s = np.linspace(0, 1, 5)
            line = np.stack([lean * high * s**2, np.zeros(5), high * d.u(0.6, 1.0) * (s - 0.3 * lean * s**2)], 1)
            side = np.array([0, 0.02, 0])
            blade = np.concatenate([line + side, line - side])
            d.add(Mesh(blade, grid_triangles(2, 5)).moved((0, 0, tall * 0.9), yaw=a), leaf)
    elif kind == 1:
        d.add(rod((0, 0, tall * 0.8), (0, 0, tall + high * 0.5), 0.02), d.palette.wood())
        for _ in range(int(d.rng.integers(8, 20))):
            frond = pillow((d.u(0.25, 0.6), d.u(0.06, 0.22), 0.01), (0.2, 0, 0), sag=d.u(0, 0.12))
            d.add(frond.moved((0, 0, tall + high * d.u(0.3, 0.6)), yaw=d.u(0, 6.3), pitch=d.u(-1.0, 0.4)), leaf)
    elif kind == 2:
        d.add(rod((0, 0, tall * 0.8), (0, 0, tall + high), 0.02), d.palette.wood())
        for _ in range(int(d.rng.integers(25, 70))):
            v = d.rng.normal(size=3)
            v *= d.u(0.3, 1.0) * 0.3 * high / np.linalg.norm(v)
            piece = pillow((d.u(0.05, 0.12), d.u(0.03, 0.06), 0.006))
            d.add(piece.moved((v[0], v[1], tall + high + v[2]), yaw=d.u(0, 6.3), roll=d.u(-1, 1)), leaf)
    else:
        for _ in range(int(d.rng.integers(1, 4))):
            body = soft_box((d.u(0.06, 0.14), d.u(0.06, 0.14), high * d.u(0.4, 1)), radius=0.04)
            d.add(body.moved((d.u(-0.4, 0.4) * r, d.u(-0.4, 0.4) * r, tall * 0.9)), leaf)


def screen_on_stand(d: Draft) -> None:
    """A television or monitor, flat or bent, on feet, a column or a plate."""
    w = d.u(0.4, 1.6)
    h, paint, rise = w * d.u(0.5, 0.65), d.palette.paint(), d.u(0.03, 0.2)
    n, bent = 6, d.u(0.0, 0.12) * w if d.chance(0.3) else 0.0
    for k in range(n):
        u = (k + 0.5) / n * 2 - 1
        yaw = float(np.arctan(4 * bent * u / w))
        d.add(box((w / n + 0.002, 0.03, h)).moved((u * w / 2, bent * u * u, rise), yaw=yaw), paint)
        d.add(
            box((w / n, 0.002, h - 0.03)).moved((u * w / 2, bent * u * u + 0.018, rise + 0.015), yaw=yaw),
            d.palette.screen(),
        )
    if d.chance(0.5):
        d.add(bar((0, -0.03, 0), (0, -0.03, rise + h * 0.4), d.u(0.04, 0.12), 0.02), paint)
        d.add(box((d.u(0.18, 0.5) * min(1, w * 1.5), d.u(0.14, 0.25), 0.012), (0, -0.02, 0)), paint)
    else:
        for side in (-1, 1):
            d.add(bar((side * w * 0.35, -0.12, 0.01), (side * w * 0.35, 0.12, 0.01), 0.03, 0.015), paint)
            d.add(bar((side * w * 0.35, 0, 0), (side * w * 0.35, 0, rise + 0.02), 0.03, 0.02), paint)


def bin_(d: Draft) -> None:
    """A bin or basket, open or with a lid."""
    r, h = d.u(0.1, 0.22), d.u(0.22, 0.65)
    upper, m = r * d.u(0.9, 1.4), d.palette.paint() if d.chance(0.7) else d.palette.metal()
    if d.chance(0.6):
        d.add(lathe([(0, 0), (r, 0), (upper, h), (upper * 0.94, h), (r * 0.9, 0.02), (0, 0.02)], sides=24), m)
    else:
        for x, y, sx, sy in ((0, -r, 2 * r, 0.01), (0, r, 2 * r, 0.01), (-r, 0, 0.01, 2 * r), (r, 0, 0.01, 2 * r)):
            d.add(box((sx, sy, h), (x, y, 0)), m)
        d.add(box((2 * r, 2 * r, 0.01)), m)
    if d.chance(0.4):
        d.add(
            soft_box((2 * upper, 2 * upper, d.u(0.03, 0.12)), (0, 0, h), 0.02),
            m if d.chance(0.5) else d.palette.paint(),
        )


def kitchen(d: Draft) -> None:
    """A run of kitchen units, straight or round a corner, or with a tall unit at its end."""
    case((1.2, 3.6), (0.5, 0.68), (0.82, 0.95))(d)
    low, high = d.bounds()
    top, w, t = float(high[2]), float(high[0] - low[0]), 0.6
    board = d.palette.wood() if d.chance(0.5) else d.palette.paint()
    d.add(box((w + 0.02, t + 0.06, 0.04), (0, 0.02, top)), board)
    if d.chance(0.35):
        side, long = d.rng.choice([-1, 1]), d.u(0.6, 1.5)
        x = side * (w / 2 - t / 2)
        d.add(box((t, long, top), (x, t / 2 + long / 2, 0)), d.parts[0][1])
        d.add(box((t + 0.03, long, 0.04), (x, t / 2 + long / 2, top)), board)
    elif d.chance(0.4):
        x = d.rng.choice([-1, 1]) * (w / 2 + 0.31)
        d.add(box((0.6, t, d.u(1.9, 2.2)), (x, 0, 0)), d.parts[0][1])
        for z in np.linspace(0.1, 1.7, int(d.rng.integers(2, 5))):
            d.add(box((0.56, 0.02, 0.36), (x, t / 2, float(z))), d.parts[0][1])
    d.add(box((d.u(0.4, 0.8), 0.42, 0.01), (d.u(-0.3, 0.3) * w, 0, top + 0.036)), d.palette.metal())
    d.zones = [zone for zone in d.zones if zone.use == "shelf"]
    d.zones.append(Zone((-w / 2 + 0.05, -t / 2 + 0.05), (w / 2 - 0.05, t / 2 - 0.03), top + 0.046, 0.5))


def bench_seats(d: Draft) -> None:
    """Seats side by side on one frame, as where people wait, or a padded bench with a back."""
    count, each, seat = int(d.rng.integers(2, 5)), d.u(0.48, 0.6), d.u(0.4, 0.47)
    frame, cover, w = _hard(d), _soft(d), 0.0
    w = count * each
    _legs(d, (w * 0.9, 0.45), seat, frame)
    d.add(box((w, 0.06, 0.04), (0, 0, seat - 0.06)), frame)
    lean, tall = d.u(0.05, 0.3), d.u(0.25, 0.5)
    for k in range(count):
        x = (k + 0.5) * each - w / 2
        d.add(soft_box((each * d.u(0.88, 1.0), 0.46, 0.06), (x, 0, seat - 0.03), 0.02), cover)
        d.add(soft_box((each * 0.92, 0.05, tall), (0, 0, 0), 0.02).moved((x, -0.23, seat + 0.03), roll=lean), cover)
    d.zones.append(Zone((-w / 2 + 0.05, -0.12), (w / 2 - 0.05, 0.18), seat + 0.035, 0.5, "seat"))


def hanging_lamp(d: Draft) -> None:
    """A lamp below the ceiling: a globe, a bowl, a ring or arms with lights; its origin is at the ceiling."""
    m, shade, drop, kind = _hard(d), d.palette.fabric(), d.u(0.1, 0.8), int(d.rng.integers(4))
    r = d.u(0.1, 0.3)
    d.add(rod((0, 0, -drop), (0, 0, 0), 0.006), m)
    if kind == 0:
        d.add(
            lathe([(0.01, r), (r * 0.7, r * 0.7), (r, 0), (r * 0.7, -r * 0.7), (0.01, -r)], (0, 0, -drop - r), 20),
            shade,
        )
    elif kind == 1:
        d.add(lathe([(0.03, 0.0), (r, -d.u(0.1, 0.3))], (0, 0, -drop), 26), m)
    elif kind == 2:
        a = np.linspace(0, 2 * np.pi, 25)
        d.add(tube(np.stack([r * np.cos(a), r * np.sin(a), np.full(25, -drop)], 1), 0.02), m)
    else:
        for k in range(int(d.rng.integers(3, 8))):
            a = k * 2 * np.pi / 5
            tip = (1.5 * r * float(np.cos(a)), 1.5 * r * float(np.sin(a)), -drop + d.u(-0.05, 0.1))
            d.add(rod((0, 0, -drop), tip, 0.008), m)
            d.add(lathe([(0.05, 0.0), (0.08, -0.12)], tip, 14), shade)


def door(d: Draft) -> None:
    """A door in its frame, panelled, glazed or plain, shut or open into the room; its origin is at the wall."""
    w, h, paint = d.u(0.7, 1.1), d.u(1.95, 2.2), _hard(d)
    frame = paint if d.chance(0.5) else _hard(d)
    e, out = d.u(0.05, 0.14), d.u(0.02, 0.09)
    for x in (-w / 2 - e / 2, w / 2 + e / 2):
        d.add(box((e, out, h + e), (x, out / 2, 0)), frame)
    d.add(box((w, out, e), (0, out / 2, h)), frame)
    leaf = [(box((w, 0.035, h), (w / 2, 0.0175, 0)), paint)]
    rows, columns = int(d.rng.integers(1, 4)), int(d.rng.integers(1, 3))
    if d.chance(0.6):
        pane = d.palette.glass() if d.chance(0.3) else paint
        for r in range(rows):
            for c in range(columns):
                size = (w / columns - 0.14, 0.012, h / rows - 0.2)
                leaf.append((box(size, (w * (c + 0.5) / columns, 0.041, h * r / rows + 0.1)), pane))
    leaf.append((rod((w * 0.88, 0.08, 1.0), (w * 0.76, 0.08, 1.0), 0.01), d.palette.metal()))
    angle = d.u(0.3, 1.5) if d.chance(0.2) else 0.0
    for mesh, material in leaf:
        d.add(mesh.moved((-w / 2, 0.005, 0.005), yaw=angle), material)


def window(d: Draft) -> None:
    """A window with a sill, bars, and panes that depth passes or not; its origin is its lower edge at the wall."""
    w, h, frame = d.u(0.5, 2.4), d.u(0.6, 1.7), _hard(d)
    e, out = d.u(0.03, 0.1), d.u(0.015, 0.08)
    pane = replace(d.palette.glass(), glass=float(d.rng.choice([0.0, 0.3, 0.95])))
    d.add(box((w, 0.008, h), (0, 0.01, 0)), pane)
    columns, rows = int(d.rng.integers(1, 5)), int(d.rng.integers(1, 4))
    for x in np.linspace(-w / 2, w / 2, columns + 1):
        d.add(box((e, out, h), (float(x), out / 2, 0)), frame)
    for z in np.linspace(0, h, rows + 1):
        d.add(box((w + e, out, e), (0, out / 2, float(z) - e / 2)), frame)
    if d.chance(0.5):
        d.add(box((w + 0.12, d.u(0.06, 0.2), 0.03), (0, 0.06, -e / 2 - 0.03)), frame)


def vary(d: Draft) -> None:
    """Stretch a thing, with what lies and stands on it, and paint some of its parts in other colours, at times."""
    if d.chance(0.5):
        f = np.exp(np.clip(d.rng.normal(0, 0.13, 3), -0.3, 0.3))
        factors = (float(f[0]), float(f[1]), float(f[2]))
        d.parts = [(mesh.scaled(factors), material) for mesh, material in d.parts]
        d.zones = [
            replace(
                z,
                low=(z.low[0] * f[0], z.low[1] * f[1]),
                high=(z.high[0] * f[0], z.high[1] * f[1]),
                z=z.z * f[2],
                clearance=z.clearance * f[2],
            )
            for z in d.zones
        ]
        d.loose = [(name, child, _shifted(pose, f)) for name, child, pose in d.loose]
    if d.chance(0.25):
        others = [_hard(d) if d.chance(0.6) else d.palette.fabric() for _ in range(int(d.rng.integers(1, 3)))]
        share = d.u(0.1, 0.6)
        d.parts = [
            (mesh, others[int(d.rng.integers(len(others)))] if d.chance(share) else material)
            for mesh, material in d.parts
        ]


def _shifted(pose: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
    out = pose.copy()
    out[:3, 3] *= factors
    return out
