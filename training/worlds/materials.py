"""Solid textures: the colour of a surface as a function of the place on the thing, so that no unwrapping is needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_LATTICE, _FINE = 16, 8
"""Cells of the noise along each axis, and samples in each."""

PATTERNS = ("plain", "noise", "wood", "stripes", "checks", "dots", "print", "bricks", "speckle")
HELD_OUT_PATTERNS = ("checks", "print")
"""Not used in worlds for training, so that tests see textures of another kind."""


@dataclass(frozen=True)
class Material:
    """What a surface looks like."""

    pattern: str
    first: tuple[float, float, float]
    """RGB in [0, 255]."""
    second: tuple[float, float, float]
    scale: float
    """Size of the pattern, metres."""
    angle: float = 0.0
    """Turn of the pattern, radians."""
    glass: float = 0.0
    """Share of depth readings that fail on it: mirrors and windows 1, glossy screens less."""


class MaterialTable:
    """The materials of a world as arrays, evaluated many points at a time."""

    def __init__(self, materials: list[Material], seed: int) -> None:
        self._pattern = np.array([PATTERNS.index(m.pattern) for m in materials])
        self._first = np.array([m.first for m in materials], np.float32)
        self._second = np.array([m.second for m in materials], np.float32)
        self._scale = np.array([m.scale for m in materials], np.float32)
        angle = np.array([m.angle for m in materials])
        self._cos, self._sin = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
        self.glass = np.array([m.glass for m in materials], np.float32)
        self._volume = _smooth_volume(np.random.default_rng([seed, 71]))

    def color(self, material: NDArray[np.int64], points: Floats, normals: Floats) -> Floats:
        """Return RGB in [0, 255] of points on things, given in their own frames. Shapes (N,), (N, 3), (N, 3)."""
        share = np.zeros(len(material), np.float32)
        scale = self._scale[material]
        uv = self._flattened(material, points, normals) / scale[:, None]
        for number, pattern in enumerate(PATTERNS):
            mine = np.flatnonzero(self._pattern[material] == number)
            if len(mine):
                share[mine] = self._share(pattern, uv[mine], points[mine] / scale[mine, None])
        dirt = 0.92 + 0.16 * self._noise(points / 0.13)
        mixed = self._first[material] * (1 - share[:, None]) + self._second[material] * share[:, None]
        return np.asarray(mixed * dirt[:, None], np.float32)

    def _flattened(self, material: NDArray[np.int64], points: Floats, normals: Floats) -> Floats:
        """The two coordinates across the axis that a surface faces most, turned by the pattern's angle. (N, 2)."""
        axis = np.abs(normals).argmax(axis=1)
        rows = np.arange(len(points))
        u = points[rows, np.where(axis == 0, 1, 0)]
        v = points[rows, np.where(axis == 2, 1, 2)]
        c, s = self._cos[material], self._sin[material]
        return np.stack([c * u - s * v, s * u + c * v], axis=1)

    def _share(self, pattern: str, uv: Floats, xyz: Floats) -> Floats:
        """How much of the second colour is in each point. Shape (N,)."""
        u, v = uv.T % 1.0
        if pattern in ("noise", "speckle", "wood", "print"):
            return np.asarray(self._grown(pattern, uv, xyz), np.float32)
        drawn = {
            "plain": lambda: np.full(len(uv), 0.1),
            "stripes": lambda: u < 0.4,
            "checks": lambda: 0.5 * ((u < 0.5) * 1.0 + (v < 0.5)),
            "dots": lambda: np.hypot(u - 0.5, v - 0.5) < 0.28,
            "bricks": lambda: ((uv[:, 0] + np.floor(uv[:, 1] * 2) % 2 * 0.5) % 1.0 < 0.06) | (uv[:, 1] * 2 % 1.0 < 0.1),
        }
        return np.asarray(drawn[pattern](), np.float32)

    def _grown(self, pattern: str, uv: Floats, xyz: Floats) -> NDArray[np.generic]:
        """The same for patterns made of noise."""
        if pattern == "noise":
            return self._noise(xyz)
        if pattern == "speckle":
            return self._noise(xyz * 4) > 0.7
        if pattern == "wood":
            rings = uv[:, 0] * 3 + 1.5 * self._noise(np.column_stack([uv[:, 0], uv[:, 1] * 0.15, xyz[:, 0] * 0.1]))
            return np.abs(rings % 1.0 - 0.5)
        flat = np.column_stack([uv, uv[:, 0]]) * np.float32(1.3)
        return np.floor(3 * self._noise(flat) + 2 * self._noise(xyz * np.float32(0.6))) % 2

    def _noise(self, xyz: Floats) -> Floats:
        """Smooth noise in [0, 1] of about one wave in two units. Shape (N, 3) -> (N,)."""
        cell = (xyz * np.float32(_FINE)).astype(np.int32) & (_LATTICE * _FINE - 1)
        return self._volume[(cell[:, 0] * (_LATTICE * _FINE) + cell[:, 1]) * (_LATTICE * _FINE) + cell[:, 2]]


def _smooth_volume(rng: np.random.Generator) -> Floats:
    """A periodic volume of value noise, `_FINE` samples a unit, flat. Shape ((_LATTICE * _FINE) ** 3,)."""
    volume = rng.random((_LATTICE, _LATTICE, _LATTICE), dtype=np.float32)
    part = (np.arange(_FINE, dtype=np.float32) + 0.5) / _FINE
    part = part * part * (3 - 2 * part)
    for axis in range(3):
        following = np.roll(volume, -1, axis)
        fine = [volume * (1 - p) + following * p for p in part]
        shape = list(volume.shape)
        shape[axis] *= _FINE
        volume = np.stack(fine, axis + 1).reshape(shape)
    return np.ascontiguousarray(volume.ravel())


def _hsv(h: float, s: float, v: float) -> tuple[float, float, float]:
    k = (np.array([5.0, 3.0, 1.0]) + h * 6) % 6
    rgb = v - v * s * np.clip(np.minimum(k, 4 - k), 0, 1)
    return (float(rgb[0] * 255), float(rgb[1] * 255), float(rgb[2] * 255))


class Palette:
    """Draws materials; the patterns of a world for training are not those of all worlds."""

    def __init__(self, rng: np.random.Generator, *, held_out: bool) -> None:
        self._rng, self._held_out = rng, held_out
        self._woods = [self._wood() for _ in range(3)]

    def _allowed(self, patterns: tuple[str, ...]) -> str:
        usual = [p for p in patterns if p not in HELD_OUT_PATTERNS]
        known = list(patterns) if self._held_out else usual or ["noise"]
        return str(self._rng.choice(known))

    def _wood(self) -> Material:
        r = self._rng
        value = r.uniform(0.25, 0.9)
        base = _hsv(r.uniform(0.05, 0.11), r.uniform(0.2, 0.65), value)
        dark = tuple(c * r.uniform(0.6, 0.85) for c in base)
        return Material("wood", base, dark, r.uniform(0.05, 0.2), r.choice([0.0, np.pi / 2]))

    def wood(self) -> Material:
        """Return one of the world's few woods, or a painted board."""
        if self._rng.random() < 0.35:
            return self.paint()
        return self._woods[int(self._rng.integers(3))]

    def paint(self) -> Material:
        """Return a coat of paint or a plastic, nearly of one colour; white and grey most often."""
        r = self._rng
        grey = r.random() < 0.55
        base = _hsv(
            r.random(), 0.06 if grey else r.uniform(0.3, 0.9), r.choice([r.uniform(0.8, 1.0), r.uniform(0.05, 0.9)])
        )
        return Material("plain", base, tuple(0.9 * c for c in base), 0.1)

    def fabric(self) -> Material:
        """Return a cloth: plain weave or a pattern."""
        r = self._rng
        pattern = self._allowed(("noise", "noise", "noise", "speckle", "stripes", "dots", "checks", "print"))
        a = _hsv(r.random(), r.uniform(0.05, 0.7), r.uniform(0.15, 0.95))
        close = r.random() < 0.6 or pattern == "noise"
        b = (
            tuple(c * r.uniform(0.75, 0.95) for c in a)
            if close
            else _hsv(r.random(), r.uniform(0, 0.8), r.uniform(0.1, 1))
        )
        return Material(pattern, a, b, r.uniform(0.02, 0.12), r.uniform(0, 3))

    def printed(self) -> Material:
        """Return paper with something on it: covers, labels, packages, pictures."""
        r = self._rng
        pattern = self._allowed(("print", "noise", "stripes", "dots", "plain", "speckle"))
        a, b = (_hsv(r.random(), r.uniform(0, 0.9), r.uniform(0.1, 1)) for _ in range(2))
        return Material(pattern, a, b, r.uniform(0.02, 0.15), r.uniform(0, 3))

    def metal(self) -> Material:
        """Return a dull metal."""
        value = self._rng.uniform(0.1, 0.75)
        return Material("plain", _hsv(0.6, 0.05, value), _hsv(0.6, 0.05, value * 0.9), 0.1)

    def leaf(self) -> Material:
        """Return a green."""
        r = self._rng
        base = _hsv(r.uniform(0.2, 0.42), r.uniform(0.3, 0.8), r.uniform(0.2, 0.7))
        return Material("noise", base, tuple(c * 0.7 for c in base), 0.04)

    def wall(self) -> Material:
        """Return paint or paper of a wall."""
        r = self._rng
        pattern = self._allowed(("plain", "plain", "plain", "noise", "stripes", "print", "bricks"))
        base = _hsv(r.random(), r.uniform(0, 0.25), r.uniform(0.55, 0.98))
        return Material(pattern, base, tuple(c * r.uniform(0.85, 0.97) for c in base), r.uniform(0.08, 0.4))

    def floor(self) -> Material:
        """Return boards, tiles or carpet."""
        r = self._rng
        pattern = self._allowed(("wood", "wood", "noise", "bricks", "checks"))
        base = _hsv(r.uniform(0.03, 0.12), r.uniform(0.05, 0.5), r.uniform(0.25, 0.85))
        return Material(pattern, base, tuple(c * r.uniform(0.65, 0.95) for c in base), r.uniform(0.1, 0.6))

    def glass(self) -> Material:
        """Return a pane or mirror, on which depth fails."""
        value = self._rng.uniform(0.5, 0.95)
        return Material("plain", _hsv(0.55, 0.1, value), _hsv(0.55, 0.1, value), 0.2, 0.0, 0.95)

    def screen(self) -> Material:
        """Return a dark glossy front."""
        base = _hsv(0.6, 0.1, self._rng.uniform(0.02, 0.15))
        return Material("plain", base, base, 0.2, 0.0, self._rng.choice([0.0, 0.4]))
