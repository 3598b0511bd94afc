"""The page of a plan view while it is drawn: lines, marks, texts and tags."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from list3r.exporters.palette import Color, instance_color
from list3r.exporters.plan.frame import PlanFrame
from list3r.exporters.plan.layout import Layout, PlanSettings
from list3r.exporters.plan.vector import VectorDraw
from list3r.memory.description.printable import shown
from list3r.memory.records import Instance

INK: Color = (38, 42, 52)
GREY: Color = (120, 124, 134)
OVERSAMPLING = 2
"""Drawn this many times larger and averaged down: Pillow does not smooth its lines."""
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


class Sheet:
    """The page while it is drawn, at `OVERSAMPLING` times its size."""

    def __init__(
        self,
        frame: PlanFrame,
        layout: Layout,
        settings: PlanSettings,
        colors: Mapping[int, Color],
        *,
        vector: bool = False,
    ) -> None:
        self.frame, self.layout, self.settings = frame, layout, settings
        self._colors = colors
        k = OVERSAMPLING
        self.left, self.top = settings.margin_px * k, settings.header_px * k
        self.map_size = frame.size_px
        size = settings.width_px * k, layout.height_px * k
        self.image = Image.new("RGB", (1, 1) if vector else size, (255, 255, 255))
        self.vector = VectorDraw(size) if vector else None
        """The page as SVG in place of `image`, where it was asked for."""
        self.draw: Any = self.vector or ImageDraw.Draw(self.image, "RGBA")
        self.tag_font, self.text_font = font_of(13), font_of(14)

    def finish(self) -> Image.Image:
        """Return the page at its size."""
        return self.image.reduce(OVERSAMPLING)

    def color(self, instance_id: int) -> Color:
        """Return the colour of an instance on this page."""
        return self._colors.get(instance_id) or instance_color(instance_id)

    def paste(self, pixels: Image.Image) -> None:
        """Put the picture of what was seen into the frame of the map."""
        if self.vector is not None:
            self.vector.picture(pixels, (self.left, self.top), self.map_size)
        else:
            self.image.paste(pixels.resize(self.map_size, Image.Resampling.BICUBIC), (self.left, self.top))

    def px(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where world points are on the page, px. Shape (N, 3) -> (N, 2)."""
        return np.asarray(self.frame.to_px(points_world) + np.array([self.left, self.top]))

    def footprint(self, instance: Instance) -> list[tuple[float, float]]:
        """Return the outline of an instance on the page, px."""
        corners = self.px(instance.box.corners())
        outline = _outline(corners.tolist())
        if len(outline) > 2:
            return outline
        (left, top), (right, bottom) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        return [(left, top), (right + 1.0, bottom + 1.0)]

    def stroke(self, a: NDArray[np.float64], b: NDArray[np.float64], color: Color, width: float) -> None:
        """Draw a line between two places of the page."""
        ends = [(float(a[0]), float(a[1])), (float(b[0]), float(b[1]))]
        self.draw.line(ends, fill=(*color, 210), width=round(width * OVERSAMPLING))

    def mark(self, xy: NDArray[np.float64], color: Color, word: str, *, round_mark: bool, left: bool = False) -> None:
        """Draw a mark with a word at its right or left."""
        x, y = (float(v) for v in xy)
        r = 6 * OVERSAMPLING
        shape = self.draw.ellipse if round_mark else self.draw.rectangle
        shape((x - r, y - r, x + r, y + r), fill=color, outline=(255, 255, 255), width=2 * OVERSAMPLING)
        aside = -1.6 * r if left else 1.6 * r
        self.text((x + aside, y), word, self.text_font, color, anchor="rm" if left else "lm", halo=True)

    def text(
        self,
        xy: tuple[float, float],
        text: str,
        font: Font,
        color: Color,
        anchor: str = "la",
        *,
        halo: bool = False,
    ) -> None:
        """Write a text in the letters of the font."""
        stroke = 2 * OVERSAMPLING if halo else 0
        words = text if self.vector is not None else plain_text(text)
        self.draw.text(
            xy, words, fill=color, font=font, anchor=anchor, stroke_width=stroke, stroke_fill=(255, 255, 255)
        )

    def name(self, instance: Instance) -> str:
        """Return the label of an instance; where there is none, or the font lacks its letters, its description."""
        label, description = shown(instance.label or ""), shown(instance.description)
        lacking = self.vector is None and plain_text(label).count("?") > label.count("?")
        return description if not label or (lacking and description) else label

    def chip_width(self, instance_id: int) -> float:
        """Return the width of the tag of an id, px."""
        return float(self.draw.textlength(str(instance_id), font=self.tag_font)) + 9.0 * OVERSAMPLING

    def chip(self, xy: tuple[float, float], size: tuple[float, float], instance_id: int) -> None:
        """Draw the tag of an id, its middle at `xy`."""
        (x, y), (w, h) = xy, (size[0] / 2, size[1] / 2)
        color = self.color(instance_id)
        edge = OVERSAMPLING
        self.draw.rounded_rectangle(
            (x - w, y - h, x + w, y + h), radius=h * 0.5, fill=color, outline=(255, 255, 255), width=edge
        )
        self.text((x, y), str(instance_id), self.tag_font, _contrast(color), anchor="mm")


def _outline(points: list[list[float]]) -> list[tuple[float, float]]:
    """Return the corners of the convex hull in order, by Andrew's monotone chain: for eight points ten times as fast as
    Qhull."""
    ordered = sorted({(x, y) for x, y in points})
    return _half(ordered)[:-1] + _half(ordered[::-1])[:-1]


def _half(ordered: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the corners on one side, from the first point to the last."""
    chain: list[tuple[float, float]] = []
    for x, y in ordered:
        while len(chain) > 1 and _turn(chain[-2], chain[-1], x, y) <= 0:
            chain.pop()
        chain.append((x, y))
    return chain


def _turn(a: tuple[float, float], b: tuple[float, float], x: float, y: float) -> float:
    """Return twice the area of a triangle, positive to the left."""
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


def font_of(size_px: int) -> Font:
    return ImageFont.load_default(size_px * OVERSAMPLING)


def plain_text(text: str) -> str:
    """Return the text in the letters that Pillow's own font has, without emoji; ? for what it lacks."""
    kept = "".join(c for c in text if c in "·…" or c.isascii())
    if kept == text:
        return text
    spelled = (unicodedata.normalize("NFKD", c).encode("ascii", "ignore").decode() or "?" for c in text)
    drawn = "".join(
        c if c in "·…" else "" if unicodedata.category(c) == "So" else s for c, s in zip(text, spelled, strict=True)
    )
    return drawn.strip()


def _contrast(color: Color) -> Color:
    return (255, 255, 255) if 0.3 * color[0] + 0.59 * color[1] + 0.11 * color[2] < 165 else INK
