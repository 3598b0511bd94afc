"""Procedural surfaces: small tileable pictures, so that feature trackers have something to hold on to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Rgb = tuple[int, int, int]

TEXTURE_PX = 256
"""Side of a baked texture."""


@dataclass(frozen=True)
class Material:
    """Appearance of a surface."""

    kind: str
    """A key of the table at the end of this file: plain, plaster, wood, fabric, stripes, checker, dots, print."""
    color: Rgb
    accent: Rgb
    tile_m: float = 1.0
    """Length after which the pattern repeats, metres."""
    seed: int = 0


def bake(material: Material) -> Floats:
    """Return the tile of a material, RGB in [0, 255]. Shape (TEXTURE_PX, TEXTURE_PX, 3)."""
    rng = np.random.default_rng([material.seed, 77])
    return np.asarray(np.clip(_KINDS[material.kind](material, rng), 0, 255), dtype=np.float32)


def mip_levels(tile: Floats, count: int) -> list[Floats]:
    """Return the tile and its halvings by 2x2 means, as an image pyramid against aliasing."""
    levels = [tile]
    for _ in range(count - 1):
        t = levels[-1]
        quarters = t[0::2, 0::2] + t[1::2, 0::2] + t[0::2, 1::2] + t[1::2, 1::2]
        levels.append((quarters / 4).astype(np.float32))
    return levels


def periodic_noise(
    rng: np.random.Generator, low: float, high: float, stretch: float = 1.0, falloff: float = 1.0
) -> Floats:
    """Tileable noise of unit deviation with `low` to `high` waves in a tile, longer along u by `stretch`."""
    size = TEXTURE_PX
    spectrum = np.fft.fft2(rng.standard_normal((size, size)))
    waves = np.fft.fftfreq(size, 1 / size)
    radius = np.hypot(waves[None, :] * stretch, waves[:, None])
    gain = np.where((radius >= low) & (radius <= high), np.maximum(radius, 1e-9) ** -falloff, 0)
    noise = np.fft.ifft2(spectrum * gain).real
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _mix(material: Material, amount: Floats) -> Floats:
    low, high = np.array(material.color, np.float32), np.array(material.accent, np.float32)
    return np.asarray(low + np.clip(amount, 0, 1)[..., None] * (high - low))


def _grid() -> tuple[Floats, Floats]:
    """Coordinates (u, v) of the tile in [0, 1)."""
    axis = (np.arange(TEXTURE_PX, dtype=np.float32) + 0.5) / TEXTURE_PX
    u, v = np.meshgrid(axis, axis)
    return u.astype(np.float32), v.astype(np.float32)


def _plain(material: Material, rng: np.random.Generator) -> Floats:
    base = _mix(material, 0.15 + 0.12 * periodic_noise(rng, 1, 6))
    return base + 3.0 * periodic_noise(rng, 8, 100, falloff=0.5)[..., None]


def _plaster(material: Material, rng: np.random.Generator) -> Floats:
    blotches = periodic_noise(rng, 1, 12, falloff=1.2)
    flecks = np.maximum(periodic_noise(rng, 6, 40, falloff=0.6) - 1.6, 0)
    grain = periodic_noise(rng, 20, 120, falloff=0.3)
    return _mix(material, 0.3 + 0.2 * blotches + 0.5 * flecks) + 2.0 * grain[..., None]


def _wood(material: Material, rng: np.random.Generator) -> Floats:
    _, v = _grid()
    boards = 6
    bend = 0.5 * periodic_noise(rng, 1, 4, stretch=3)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (boards * 3 * v + bend))
    fibre = periodic_noise(rng, 6, 120, stretch=10, falloff=0.5)
    tone = rng.uniform(-0.25, 0.25, boards)[np.minimum((v * boards).astype(int), boards - 1)]
    seam = ((v * boards) % 1.0 < 0.03).astype(np.float32)
    return _mix(material, 0.35 + 0.3 * rings + 0.16 * fibre + tone) * (1 - 0.35 * seam[..., None])


def _fabric(material: Material, rng: np.random.Generator) -> Floats:
    u, v = _grid()
    weave = 0.5 + 0.25 * (np.sin(2 * np.pi * 40 * u) + np.sin(2 * np.pi * 40 * v))
    return _mix(material, 0.25 * weave + 0.2 + 0.22 * periodic_noise(rng, 2, 30, falloff=0.8))


def _stripes(material: Material, rng: np.random.Generator) -> Floats:
    _, v = _grid()
    edges = np.sort(rng.uniform(0, 1, 10))
    band = (np.searchsorted(edges, v) % 2).astype(np.float32)
    return _mix(material, band) + 4.0 * periodic_noise(rng, 4, 60, falloff=0.6)[..., None]


def _checker(material: Material, rng: np.random.Generator) -> Floats:
    u, v = _grid()
    cells = 4
    tone = rng.uniform(-0.15, 0.15, (cells, cells))
    i, j = (u * cells).astype(int), (v * cells).astype(int)
    return _mix(material, 0.15 + 0.7 * ((i + j) % 2) + tone[i, j]) + 5.0 * periodic_noise(rng, 4, 80)[..., None]


def _dots(material: Material, rng: np.random.Generator) -> Floats:
    u, v = _grid()
    out = np.zeros_like(u)
    for x, y, r in zip(rng.uniform(0, 1, 26), rng.uniform(0, 1, 26), rng.uniform(0.03, 0.09, 26), strict=True):
        du, dv = np.abs(u - x), np.abs(v - y)
        out[np.hypot(np.minimum(du, 1 - du), np.minimum(dv, 1 - dv)) < r] = 1
    return _mix(material, out) + 4.0 * periodic_noise(rng, 4, 60, falloff=0.6)[..., None]


def _print(material: Material, rng: np.random.Generator) -> Floats:
    """Patches of five colours, like a poster or the cover of a book."""
    field = periodic_noise(rng, 1, 9, falloff=1.1)
    steps = np.digitize(field, [-0.9, -0.2, 0.35, 1.1])
    low, high = np.array(material.color, float), np.array(material.accent, float)
    palette = np.stack([low, (low + high) / 2, high, 255 - 0.35 * (255 - high), 0.45 * low])
    return np.asarray(palette[steps] + 4.0 * periodic_noise(rng, 6, 80, falloff=0.5)[..., None])


_KINDS: dict[str, Callable[[Material, np.random.Generator], NDArray[np.floating]]] = {
    "plain": _plain,
    "plaster": _plaster,
    "wood": _wood,
    "fabric": _fabric,
    "stripes": _stripes,
    "checker": _checker,
    "dots": _dots,
    "print": _print,
}
