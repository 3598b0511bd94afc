"""Furniture: each function makes the parts of one object, front towards +y, base at z = 0, metres."""

from __future__ import annotations

from list3r.simulation.worlds.materials import Material
from list3r.simulation.worlds.objects import BOX, CYLINDER, SPHERE, Part, Vec3

Parts = tuple[Part, ...]


def block(size: Vec3, center: Vec3, material: Material, yaw: float = 0.0) -> Part:
    """Return a box of full `size` about `center`."""
    return Part(BOX, center, (size[0] / 2, size[1] / 2, size[2] / 2), material, yaw)


def pillar(radius: float, height: float, base: Vec3, material: Material, *, open_top: bool = False) -> Part:
    """Return a cylinder standing on `base`."""
    x, y, z = base
    return Part(CYLINDER, (x, y, z + height / 2), (radius, radius, height / 2), material, open_top=open_top)


def globe(radius: float, center: Vec3, material: Material, *, open_top: bool = False) -> Part:
    """Return a sphere, or its lower half as a shell."""
    return Part(SPHERE, center, (radius, radius, radius), material, open_top=open_top)


def table(size: Vec3, material: Material, leg_m: float = 0.06, top_m: float = 0.04) -> Parts:
    """Return a top on four legs."""
    w, d, h = size
    x, y = w / 2 - leg_m, d / 2 - leg_m
    legs = [
        block((leg_m, leg_m, h - top_m), (i * x, j * y, (h - top_m) / 2), material) for i in (-1, 1) for j in (-1, 1)
    ]
    return (block((w, d, top_m), (0, 0, h - top_m / 2), material), *legs)


def chair(material: Material, cushion: Material, seat_m: float = 0.44, slats: int = 2) -> Parts:
    """Return a seat on four legs with a slatted back."""
    h, leg, back = 0.45, 0.04, 0.90
    e = seat_m / 2 - leg / 2
    parts = [block((seat_m, seat_m, 0.04), (0, 0, h - 0.04), material)]
    parts.append(block((seat_m - 0.04, seat_m - 0.06, 0.03), (0, 0.01, h - 0.005), cushion))
    for x in (-e, e):
        parts.append(block((leg, leg, h - 0.06), (x, e, (h - 0.06) / 2), material))
        parts.append(block((leg, leg, back), (x, -e, back / 2), material))
    for k in range(slats):
        z = back - 0.07 - k * 0.17
        parts.append(block((seat_m - leg, 0.025, 0.10), (0, -e, z), cushion))
    return tuple(parts)


def sofa(width: float, fabric: Material, cushion: Material) -> Parts:
    """Feet, base, back, two arms and two seat cushions."""
    d, arm = 0.85, 0.18
    seat = (width - 2 * arm) / 2
    feet = [
        block((0.06, 0.06, 0.05), (i * (width / 2 - 0.08), j * 0.34, 0.025), fabric) for i in (-1, 1) for j in (-1, 1)
    ]
    return (
        *feet,
        block((width, d, 0.26), (0, 0, 0.13 + 0.04), fabric),
        block((width, 0.22, 0.78 - 0.04), (0, -d / 2 + 0.11, 0.41), fabric),
        block((arm, d, 0.54), (-width / 2 + arm / 2, 0, 0.31), fabric),
        block((arm, d, 0.54), (width / 2 - arm / 2, 0, 0.31), fabric),
        block((seat - 0.01, d - 0.24, 0.14), (-seat / 2, 0.11, 0.37), cushion),
        block((seat - 0.01, d - 0.24, 0.14), (seat / 2, 0.11, 0.37), cushion),
    )


def bed(width: float, length: float, wood: Material, linen: Material, blanket: Material) -> Parts:
    """Frame, mattress, blanket, headboard at the back."""
    return (
        block((width, length, 0.22), (0, 0, 0.17), wood),
        block((width - 0.04, length - 0.08, 0.20), (0, 0, 0.36), linen),
        block((width + 0.02, length * 0.6, 0.21), (0, length * 0.2 - 0.02, 0.37), blanket),
        block((width, 0.06, 0.90), (0, -length / 2 + 0.03, 0.45), wood),
    )


def cabinet(size: Vec3, body: Material, front: Material, doors: int = 2) -> Parts:
    """Return a body with doors and knobs."""
    w, d, h = size
    parts = [block((w, d - 0.02, h), (0, -0.01, h / 2), body)]
    each = w / doors
    for k in range(doors):
        x = -w / 2 + (k + 0.5) * each
        parts.append(block((each - 0.03, 0.02, h - 0.12), (x, d / 2 - 0.01, h / 2), front))
    return tuple(parts)


def shelf(size: Vec3, wood: Material, boards: int = 4) -> Parts:
    """Two sides, a back and boards, open to the front."""
    w, d, h = size
    parts = [block((0.03, d, h), (x * (w / 2 - 0.015), 0, h / 2), wood) for x in (-1, 1)]
    parts.append(block((w - 0.06, 0.015, h), (0, -d / 2 + 0.0075, h / 2), wood))
    for z in shelf_boards(h, boards):
        parts.append(block((w - 0.06, d - 0.015, 0.03), (0, 0.0075, z - 0.015), wood))
    return tuple(parts)


def shelf_boards(height: float, boards: int) -> list[float]:
    """Heights of the upper faces of the boards of a shelf."""
    return [0.10 + k * (height - 0.10) / (boards - 1) for k in range(boards)]


def plant(pot: Material, leaf: Material) -> Parts:
    """Return a pot with a stem and round leaves."""
    leaves = [(0, 0, 0.78, 0.16), (0.13, 0.04, 0.62, 0.13), (-0.12, -0.06, 0.60, 0.13), (0.0, 0.13, 0.92, 0.11)]
    return (
        pillar(0.15, 0.30, (0, 0, 0), pot),
        pillar(0.02, 0.60, (0, 0, 0.28), pot),
        *(globe(r, (x, y, z), leaf) for x, y, z, r in leaves),
    )


def mug(radius: float, height: float, material: Material) -> Parts:
    """Return an open cylinder with a handle."""
    reach = 0.035
    return (
        pillar(radius, height, (0, 0, 0), material, open_top=True),
        block((reach, 0.014, 0.014), (radius + reach / 2 - 0.003, 0, height * 0.78), material),
        block((reach, 0.014, 0.014), (radius + reach / 2 - 0.003, 0, height * 0.28), material),
        block((0.014, 0.014, height * 0.5 + 0.014), (radius + reach - 0.007, 0, height * 0.53), material),
    )


def carton(size: Vec3, material: Material, tape: Material) -> Parts:
    """Return a closed box with a strip of tape."""
    _, d, h = size
    return (block(size, (0, 0, h / 2), material), block((0.04, d + 0.002, h + 0.001), (0, 0, (h + 0.001) / 2), tape))


def book(size: Vec3, cover: Material, paper: Material) -> Parts:
    """Two covers, a spine and pages."""
    w, d, h = size
    return (
        block((w, d, 0.006), (0, 0, 0.003), cover),
        block((w, d, 0.006), (0, 0, h - 0.003), cover),
        block((0.006, d, h), (-w / 2 + 0.003, 0, h / 2), cover),
        block((w - 0.012, d - 0.01, h - 0.012), (0, 0, h / 2), paper),
    )


def book_row(covers: tuple[Material, ...], depth: float = 0.17) -> Parts:
    """Upright books side by side."""
    parts, x = [], 0.0
    for k, cover in enumerate(covers):
        w, h = 0.035 + 0.008 * (k * 5 % 3), 0.21 + 0.02 * (k * 7 % 4)
        parts.append((w, h, x, cover))
        x += w
    return tuple(block((w - 0.001, depth, h), (left + w / 2 - x / 2, 0, h / 2), cover) for w, h, left, cover in parts)


def bowl(radius: float, material: Material) -> Parts:
    """Return a half sphere, open above, on a foot."""
    return (
        globe(radius, (0, 0, radius), material, open_top=True),
        pillar(radius * 0.5, 0.02, (0, 0, 0), material),
    )


def ball(radius: float, material: Material) -> Parts:
    """Return a sphere."""
    return (globe(radius, (0, 0, radius), material),)


def vase(radius: float, height: float, material: Material) -> Parts:
    """Return a belly with a neck."""
    return (
        globe(radius, (0, 0, radius), material),
        pillar(radius * 0.6, height - radius, (0, 0, radius), material, open_top=True),
    )


def lamp(height: float, base: Material, shade: Material) -> Parts:
    """Foot, pole and shade."""
    return (
        pillar(0.08, 0.025, (0, 0, 0), base),
        pillar(0.015, height - 0.1, (0, 0, 0), base),
        pillar(0.11, 0.17, (0, 0, height - 0.17), shade),
    )


def monitor(width: float, frame: Material, screen: Material) -> Parts:
    """Return a screen on a foot."""
    h = width * 0.58
    return (
        block((width * 0.45, 0.18, 0.02), (0, 0, 0.01), frame),
        block((0.05, 0.04, 0.16), (0, -0.02, 0.08), frame),
        block((width, 0.035, h), (0, 0, 0.10 + h / 2), frame),
        block((width - 0.03, 0.004, h - 0.03), (0, 0.0185, 0.10 + h / 2), screen),
    )


def basket(radius: float, height: float, material: Material) -> Parts:
    """Return an open cylinder."""
    return (pillar(radius, height, (0, 0, 0), material, open_top=True),)


def flat(size: Vec3, center: Vec3, material: Material) -> Parts:
    """One box: a rug, a picture, a cushion, a slab of wall."""
    return (block(size, center, material),)
