"""What a person would call a colour: the dominant colours of an instance, seen in the light of the whole memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import Array

_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_WHITE = np.array([0.95047, 1.0, 1.08883])
_SAMPLE = 160
"""Points of one instance whose colours are compared."""
_HALF_LIGHT = np.array([0.5, 1.0, 1.0])
"""Lightness counts half between two points of one instance: shading changes it most."""
_ALIKE = 11.0
"""Within this, colours are one colour (CIE L*a*b*, lightness at half weight)."""
_DARK_L, _DARK_WEIGHT = 22.0, 0.5
"""What is darker may be shadow or the gap behind an instance, so it counts less when something else is there."""
_NEUTRAL_CHROMA = 14.0
_FULL_WHITE_L = 96.0
_MAX_GAIN, _MAX_CAST = 1.5, 6.0


@dataclass(frozen=True)
class Swatch:
    """One of the colours of an instance."""

    rgb: tuple[int, int, int]
    lab: tuple[float, float, float]
    """CIE L*a*b* (D65) of it."""
    share: float
    """Of the instance's points, in [0, 1]."""


@dataclass(frozen=True)
class Reference:
    """The light of a memory: how bright its white is, and which way its greys lean."""

    white_l: float = _FULL_WHITE_L
    """CIE L* of the brightest neutral surfaces."""
    cast_ab: tuple[float, float] = (0.0, 0.0)
    """CIE a*, b* of them."""

    def corrected(self, lab: Sequence[float]) -> tuple[float, float, float]:
        """Return a colour as it would look in white light that shows white as white."""
        gain = min(max(_FULL_WHITE_L / max(self.white_l, 1e-6), 1.0), _MAX_GAIN)
        lightness, share = min(100.0, lab[0] * gain), min(1.0, lab[0] / max(self.white_l, 1e-6))
        return lightness, gain * (lab[1] - share * self.cast_ab[0]), gain * (lab[2] - share * self.cast_ab[1])


def lab_from_rgb(rgb: NDArray[np.uint8]) -> Array:
    """Return CIE L*a*b* (D65) of sRGB colours. Shape (..., 3) -> (..., 3)."""
    c = np.asarray(rgb, dtype=np.float64) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    t = linear @ _XYZ.T / _WHITE
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def scene_reference(lab: Array) -> Reference:
    """Return the white patch and grey world, both bounded: the light from a sample of all surfaces, CIE L*a*b*. Shape
    (N, 3).

    White is the 98th percentile of lightness among the nearly neutral points; the cast is the median of the bright ones
    among them. Where hardly anything is neutral nothing is corrected.
    """
    neutral = lab[np.hypot(lab[:, 1], lab[:, 2]) < _NEUTRAL_CHROMA]
    if len(neutral) < max(20, 0.05 * len(lab)):
        return Reference()
    white = float(np.quantile(neutral[:, 0], 0.98))
    cast = np.median(neutral[neutral[:, 0] > 0.8 * white][:, 1:], axis=0)
    length = float(np.linalg.norm(cast))
    cast *= min(1.0, _MAX_CAST / max(length, 1e-9))
    return Reference(white, (float(cast[0]), float(cast[1])))


def dominant_colors(rgb: NDArray[np.uint8], most: int = 3) -> tuple[Swatch, ...]:
    """Return the colours of an instance, the commonest first: modes of its points' colours. Shape (N, 3); grey for
    none.

    A mode is the point with most others alike, and takes them with it; the swatch is their median. What is mixed
    (edges, blur) lies between the modes and is counted to none.
    """
    if len(rgb) == 0:
        return (Swatch((128, 128, 128), (53.6, 0.0, 0.0), 1.0),)
    sample = rgb[:: -(-len(rgb) // _SAMPLE)]
    lab = lab_from_rgb(sample)
    place = lab * _HALF_LIGHT
    alike = sum(np.subtract.outer(channel, channel) ** 2 for channel in place.T) < _ALIKE**2
    left = np.ones(len(sample), dtype=bool)
    out: list[Swatch] = []
    while left.any() and len(out) < most:
        count = (alike & left[None]).sum(axis=1) * left
        mode = alike[int(np.argmax(count))] & left
        share = float(mode.mean())
        if out and share < 0.12:
            break
        r, g, b = (int(x) for x in np.median(sample[mode], axis=0))
        light, green_red, blue_yellow = (round(float(x), 3) for x in np.median(lab[mode], axis=0))
        out.append(Swatch((r, g, b), (light, green_red, blue_yellow), round(share, 4)))
        left &= ~mode
    return tuple(out)


def color_names(swatches: Sequence[Swatch], reference: Reference | None = None) -> list[str]:
    """Return the name of each colour of an instance."""
    return [color_name(s.lab, reference) for s in swatches]


def main_color(swatches: Sequence[Swatch], names: Sequence[str]) -> tuple[str, tuple[int, int, int]]:
    """Return (name, RGB as seen) of the colour that most of an instance has, shades of one name counted together.

    `names` are the `color_names` of the swatches.
    """
    weight = [s.share * (_DARK_WEIGHT if s.lab[0] < _DARK_L else 1.0) for s in swatches]
    total = {n: sum(w for m, w in zip(names, weight, strict=True) if m == n) for n in names}
    best = max(range(len(names)), key=lambda k: (total[names[k]], weight[k], -k))
    return names[best], swatches[best].rgb


def color_words(swatches: Sequence[Swatch], names: Sequence[str]) -> str:
    """Return the name of the main colour, or "red and white" where two clearly different ones share an instance.

    `names` are the `color_names` of the swatches.
    """
    name, _ = main_color(swatches, names)
    share = dict.fromkeys(names, 0.0)
    for s, n in zip(swatches, names, strict=True):
        share[n] += s.share
    others = [(part, n) for n, part in share.items() if n != name and _kind(n) != _kind(name)]
    if not others or max(others)[0] < 0.3 or share[name] + max(others)[0] < 0.75:
        return name
    other = max(others)[1]
    one, two = (np.mean([s.lab for s, n in zip(swatches, names, strict=True) if n == m], axis=0) for m in (name, other))
    return f"{name} and {other}" if float(np.linalg.norm(one - two)) > 40.0 else name


def _kind(name: str) -> str:
    word = name.rsplit(maxsplit=1)[-1]
    return {"black": "grey", "white": "grey", "beige": "brown", "tan": "brown"}.get(word, word)


_HUES = (
    (45.0, "red"),
    (76.0, "orange"),
    (112.0, "yellow"),
    (172.0, "green"),
    (222.0, "teal"),
    (300.0, "blue"),
    (345.0, "purple"),
    (361.0, "red"),
)
"""Upper ends of the hue angles of CIE L*a*b*, degrees, of what most people call so."""


def color_name(lab: Sequence[float], reference: Reference | None = None) -> str:
    """Return the everyday name of one colour, CIE L*a*b* as seen, in the light of the reference."""
    light, a, b = (reference or Reference()).corrected(lab)
    chroma, hue = math.hypot(a, b), math.degrees(math.atan2(b, a)) % 360.0
    if (light < 14.0 and chroma < 20.0) or chroma < _least_chroma(light, hue):
        return _grey(light)
    if 300.0 <= hue < 310.0 and chroma > 50.0:
        hue = 299.0  # CIE L*a*b* bends pure blues towards purple
    family = next(name for end, name in _HUES if hue < end)
    if family in ("red", "orange", "yellow"):
        return _warm(family, light, chroma, hue)
    return _cold(family, light, hue)


def _least_chroma(light: float, hue: float) -> float:
    """What is duller is grey to people: more is asked of what is bright, and of bluish ones, as shadows are."""
    least = 5.0 + 0.1 * min(light, 50.0) if light < 82.0 else 11.0
    return least + (2.0 if 150.0 < hue < 300.0 else 0.0)


def _grey(light: float) -> str:
    for end, name in ((22.0, "black"), (42.0, "dark grey"), (63.0, "grey"), (80.0, "light grey")):
        if light < end:
            return name
    return "white"


def _warm(family: str, light: float, chroma: float, hue: float) -> str:
    """Name a colour among red, orange and yellow; when dull or dark, people see pink, brown, tan and beige."""
    if family == "red" and light > 66.0 and chroma < 55.0:
        return "pink" if hue < 35.0 or hue >= 345.0 else "tan" if light < 76.0 else "beige"
    if family == "red" and (hue < 28.0 or hue >= 345.0 or chroma > 12.0 + 0.5 * light):
        return "dark red" if light < 38.0 else "red"
    if family == "orange" and chroma >= 42.0 and light >= 50.0:
        return "orange"
    if family == "yellow" and chroma >= 42.0 and light >= 58.0:
        return "yellow"
    if hue > 100.0 and chroma > 20.0:
        return "green" if light >= 35.0 else "dark green"
    return "brown" if light < 56.0 else "tan" if light < 77.0 else "beige"


def _cold(family: str, light: float, hue: float) -> str:
    if family == "green":
        return "dark green" if light < 35.0 else "green"
    if family == "blue":
        return "dark blue" if light < 28.0 else "blue" if light < 64.0 else "light blue"
    if family == "purple":
        return "pink" if light > 68.0 and hue > 320.0 else "purple"
    return family
