"""Things that no catalogue knows: random assemblies of simple bodies, so that what belongs together is learned by how
it hangs together and not by heart. Only worlds for training contain them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from training.worlds.draft import Draft
from training.worlds.materials import Material
from training.worlds.mesh import Mesh, Vector, ball, bar, box, cylinder, lathe, pillow, rod, soft_box, tube, waves

Size = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


def oddment(size: Size, *, hung: bool = False, below: bool = False) -> Callable[[Draft], None]:
    """Return what builds a random thing of at most a size (ranges of width, depth, height, metres).

    `hung` ones have their back at y = 0, those `below` their upper end at the origin.
    """

    def build(d: Draft) -> None:
        grammar = _GRAMMARS[int(d.rng.integers(len(_GRAMMARS)))]
        grammar(d)
        _fit(d, np.array([d.u(*limits) for limits in size]), hung=hung, below=below)

    return build


def _fit(d: Draft, size: NDArray[np.float64], *, hung: bool, below: bool) -> None:
    """Turn and stretch what was built into a size, partly keeping its shape, and put it where it belongs."""
    if d.chance(0.3):
        yaw = float(d.rng.integers(4)) * np.pi / 2
        d.parts = [(mesh.moved(yaw=yaw), material) for mesh, material in d.parts]
    low, high = d.bounds()
    span = np.maximum(high - low, 1e-3)
    factor = size / span
    even = float(factor.min())
    factor = even * (factor / even) ** d.u(0.2, 1.0)
    base = np.array([(low[0] + high[0]) / 2, low[1] if hung else (low[1] + high[1]) / 2, high[2] if below else low[2]])
    d.parts = [(Mesh((m.vertices - base) * factor, m.triangles), material) for m, material in d.parts]


def _material(d: Draft) -> Material:
    p = d.palette
    makers = (p.paint, p.paint, p.wood, p.fabric, p.printed, p.metal)
    return makers[int(d.rng.integers(len(makers)))]()


def _materials(d: Draft) -> list[Material]:
    """One to three, the first of them for most parts."""
    return [_material(d) for _ in range(int(d.rng.integers(1, 4)))]


def _pick(d: Draft, materials: list[Material]) -> Material:
    return materials[0] if d.chance(0.55) else materials[int(d.rng.integers(len(materials)))]


def _body(d: Draft, size: Vector, base: Vector) -> Mesh:
    """A closed body of a size that stands on `base`."""
    w, deep, h = size
    kind = int(d.rng.integers(6))
    if kind <= 1:
        return box(size, base)
    if kind == 2:
        return soft_box(size, base, radius=min(size) * d.u(0.1, 0.5), puff=d.u(0, 0.15))
    if kind == 3:
        return cylinder(0.5, 1.0, top=0.5 * d.u(0.4, 1.0) if d.chance(0.4) else None, sides=20).scaled(size).moved(base)
    if kind == 4:
        return ball(0.5).scaled(size).moved(base)
    return _turned(d).scaled((w, deep, h)).moved(base)


def _turned(d: Draft) -> Mesh:
    """A turned body one metre high and wide."""
    count = int(d.rng.integers(4, 9))
    radii = 0.5 * np.clip(np.cumsum(d.rng.normal(0, 0.25, count)) * 0.6 + d.u(0.4, 0.9), 0.08, 1.0)
    radii = radii / radii.max() * 0.5
    heights = np.linspace(0, 1, count)
    if d.chance(0.6):
        fine = np.linspace(0, 1, 16)
        radii, heights = np.interp(fine, heights, radii), fine
        radii = np.convolve(np.pad(radii, 2, mode="edge"), np.full(5, 0.2), "valid")
    line = [(0.0, 0.0), *zip(radii.tolist(), heights.tolist(), strict=True)]
    if d.chance(0.5):
        line.append((0.0, 1.0))
    else:
        line += [(float(radii[-1]) * 0.9, 1.0), (float(radii[0]) * 0.8, 0.06), (0.0, 0.06)]
    return lathe(line, sides=22)


def _vessel(d: Draft) -> None:
    """A turned thing, with a handle, a neck or a lid."""
    m = _materials(d)
    d.add(_turned(d).scaled((1.0, 1.0, d.u(0.5, 2.2))), m[0])
    low, high = d.bounds()
    tall = float(high[2] - low[2])
    if d.chance(0.4):
        a = np.linspace(-1.4, 1.4, 9)
        reach = d.u(0.1, 0.3)
        middle, half = tall * d.u(0.35, 0.65), tall * d.u(0.15, 0.35)
        points = np.stack([0.4 + reach * np.cos(a), np.zeros(9), middle + half * np.sin(a)], 1)
        d.add(tube(points, d.u(0.03, 0.07)), _pick(d, m))
    if d.chance(0.4):
        d.add(_body(d, (d.u(0.15, 0.6), d.u(0.15, 0.6), d.u(0.05, 0.5)), (0, 0, tall * 0.99)), _pick(d, m))


def _stack(d: Draft) -> None:
    """Bodies one on the other."""
    m, z, w = _materials(d), 0.0, 1.0
    for _ in range(int(d.rng.integers(1, 5))):
        size = (w * d.u(0.8, 1.2), w * d.u(0.6, 1.1), d.u(0.1, 0.9))
        d.add(_body(d, size, (d.u(-0.05, 0.05), d.u(-0.05, 0.05), z)), _pick(d, m))
        z += size[2] * 0.98
        w *= d.u(0.5, 1.1)


def _on_legs(d: Draft) -> None:
    """A body on legs or a foot, with things fixed to it."""
    m = _materials(d)
    w, deep, h, rise = 1.0, d.u(0.4, 1.0), d.u(0.1, 0.8), d.u(0.2, 1.0)
    if d.chance(0.65):
        d.legs((w * d.u(0.7, 1), deep * d.u(0.7, 1)), rise * 1.02, d.u(0.03, 0.09), _pick(d, m), splay=d.u(0, 0.1))
    else:
        d.add(rod((0, 0, 0), (0, 0, rise * 1.02), d.u(0.03, 0.1)), _pick(d, m))
        d.add(_body(d, (d.u(0.4, 0.9), d.u(0.4, 0.9), d.u(0.03, 0.1)), (0, 0, 0)), _pick(d, m))
    d.add(_body(d, (w, deep, h), (0, 0, rise)), m[0])
    if d.chance(0.5):
        back = d.u(0.3, 1.0)
        d.add(_body(d, (w * d.u(0.7, 1), d.u(0.05, 0.2), back), (0, -deep * 0.42, rise + h * 0.9)), _pick(d, m))
    if d.chance(0.35):
        for side in (-1, 1):
            arm = (d.u(0.06, 0.2), deep * d.u(0.5, 1), d.u(0.15, 0.5))
            d.add(_body(d, arm, (side * w * 0.47, 0, rise + h * 0.8)), _pick(d, m))


def _with_parts(d: Draft) -> None:
    """A body with smaller ones on its faces, as machines have."""
    m = _materials(d)
    w, deep, h = 1.0, d.u(0.3, 1.0), d.u(0.3, 1.6)
    d.add(_body(d, (w, deep, h), (0, 0, 0)), m[0])
    for _ in range(int(d.rng.integers(1, 7))):
        size = (d.u(0.05, 0.5), d.u(0.03, 0.25), d.u(0.05, 0.5))
        face = int(d.rng.integers(3))
        x, y, z = d.u(-0.4, 0.4) * w, d.u(-0.4, 0.4) * deep, d.u(0.0, 0.8) * h
        spots: tuple[Vector, ...] = ((x, deep * 0.48, z), (w * d.rng.choice([-0.48, 0.48]), y, z), (x, y, h * 0.97))
        d.add(_body(d, size, spots[face]), _pick(d, m))


def _branching(d: Draft) -> None:
    """A foot and a stem with branches that end in something."""
    m = _materials(d)
    d.add(_body(d, (d.u(0.2, 0.5), d.u(0.2, 0.5), d.u(0.04, 0.3)), (0, 0, 0)), _pick(d, m))
    thick, kind, size = d.u(0.015, 0.05), int(d.rng.integers(4)), d.u(0.1, 0.4)
    tip = _pick(d, m)
    d.add(rod((0, 0, 0), (0, 0, 1.0), thick), m[0])
    for _ in range(int(d.rng.integers(2, 12))):
        z, angle, reach = d.u(0.3, 1.0), d.u(0, 2 * np.pi), d.u(0.15, 0.5)
        end = (reach * np.cos(angle), reach * np.sin(angle), z + d.u(-0.1, 0.4))
        d.add(rod((0, 0, z), end, thick * 0.7), m[0])
        if kind == 0:
            d.add(ball(size / 2, (end[0], end[1], end[2] - size / 2)), tip)
        elif kind == 1:
            leaf = pillow((size * 1.6, size * 0.5, 0.015), sag=size * 0.2)
            d.add(leaf.moved(end, yaw=angle, pitch=d.u(-0.6, 0.6)), tip)
        elif kind == 2:
            d.add(cylinder(size * 0.3, size * 0.6, end, top=size * 0.5), tip)


def _panels(d: Draft) -> None:
    """Thin boards at right angles or aslant, as racks and stands have."""
    m, thick = _materials(d), d.u(0.015, 0.06)
    d.add(box((1.0, d.u(0.3, 0.8), thick)), m[0])
    for _ in range(int(d.rng.integers(1, 6))):
        h = d.u(0.2, 1.0)
        if d.chance(0.5):
            part = box((d.u(0.3, 1.0), thick, h)).moved((0, d.u(-0.3, 0.3), 0), roll=d.u(-0.3, 0.3) * d.chance(0.5))
        else:
            part = box((thick, d.u(0.2, 0.7), h)).moved((d.u(-0.48, 0.48), 0, 0))
        d.add(part, _pick(d, m))
    if d.chance(0.5):
        d.add(box((d.u(0.6, 1.0), d.u(0.3, 0.7), thick), (0, 0, d.u(0.2, 0.9))), _pick(d, m))


def _row(d: Draft) -> None:
    """Many of one part side by side on what holds them, as radiators, crates and racks have."""
    m, state = _materials(d), d.rng.bit_generator.state
    across, deep = int(d.rng.integers(2, 9)), int(d.rng.integers(1, 4))
    size = (0.9 / across * d.u(0.6, 1.05), 0.6 / deep * d.u(0.6, 1.05), d.u(0.2, 1.0))
    rise = d.u(0.02, 0.3)
    d.add(box((1.0, 0.65, rise)), m[0])
    state = d.rng.bit_generator.state
    for i in range(across):
        for j in range(deep):
            d.rng.bit_generator.state = state
            at = ((i + 0.5) / across * 0.92 - 0.46, ((j + 0.5) / deep - 0.5) * 0.6, rise * 0.95)
            d.add(_body(d, size, at), m[-1])


def _soft(d: Draft) -> None:
    """A soft lump, with straps or folds."""
    m = [d.palette.fabric(), d.palette.fabric()]
    body = soft_box((1.0, d.u(0.3, 1.0), d.u(0.3, 1.2)), radius=0.3, puff=d.u(0, 0.3), cells=12)
    shift = waves(d.rng, (1, len(body.vertices)), d.u(0, 0.03), 6.0)[0]
    d.add(Mesh(body.vertices * (1 + shift[:, None]), body.triangles), m[0])
    high = float(body.vertices[:, 2].max())
    if d.chance(0.5):
        a = np.linspace(0, np.pi, 10)
        points = np.stack([d.u(0.15, 0.35) * np.cos(a), np.full(10, d.u(-0.2, 0.2)), high * 0.95 + 0.3 * np.sin(a)], 1)
        d.add(tube(points, d.u(0.015, 0.04)), m[1])


def _frame(d: Draft) -> None:
    """Bars between the corners of a block, with sheets in some of its faces."""
    m, thick = _materials(d), d.u(0.02, 0.08)
    w, deep, h = 1.0, d.u(0.2, 0.9), d.u(0.3, 1.8)
    x, y = w / 2, deep / 2
    for sx in (-x, x):
        for sy in (-y, y):
            d.add(bar((sx, sy, 0), (sx, sy, h), thick, thick), m[0])
    for z in d.rng.uniform(0.05, 1.0, int(d.rng.integers(1, 5))).tolist():
        if d.chance(0.5):
            d.add(box((w, deep, thick * 0.5), (0, 0, z * h)), _pick(d, m))
        else:
            for sy in (-y, y):
                d.add(bar((-x, sy, z * h), (x, sy, z * h), thick, thick), m[0])
            for sx in (-x, x):
                d.add(bar((sx, -y, z * h), (sx, y, z * h), thick, thick), m[0])
    if d.chance(0.4):
        d.add(box((w, thick * 0.3, h), (0, -y, 0)), _pick(d, m))


_GRAMMARS = (
    _vessel,
    _vessel,
    _stack,
    _on_legs,
    _on_legs,
    _with_parts,
    _with_parts,
    _branching,
    _panels,
    _row,
    _soft,
    _frame,
)
