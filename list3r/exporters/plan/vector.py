"""Draw shapes and texts as SVG by the verbs of Pillow that a plan uses."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import escape

from PIL import Image, ImageDraw, ImageFont

from list3r.memory.description.printable import shown

Fill = Sequence[int] | None


class VectorDraw:
    """A page of SVG; lengths are px of the page as it is drawn."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._parts: list[str] = []
        self._ruler = ImageDraw.Draw(Image.new("L", (1, 1)))

    def svg(self, width_px: int) -> str:
        """Return the document, shown at a width."""
        width, height = self._size
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width_px}"'
            f' height="{round(height * width_px / width)}" font-family="Helvetica, Arial, sans-serif">'
        )
        return "\n".join([head, '<rect width="100%" height="100%" fill="#fff"/>', *self._parts, "</svg>"]) + "\n"

    def picture(self, image: Image.Image, xy: tuple[int, int], size: tuple[int, int]) -> None:
        """Put a picture on the page."""
        buffer = io.BytesIO()
        image.save(buffer, format="PNG")
        data = base64.b64encode(buffer.getvalue()).decode("ascii")
        place = f'x="{xy[0]}" y="{xy[1]}" width="{size[0]}" height="{size[1]}"'
        self._parts.append(f'<image {place} preserveAspectRatio="none" href="data:image/png;base64,{data}"/>')

    def line(self, xy: Any, fill: Fill = None, width: float = 1, joint: str | None = None) -> None:
        """Draw a line through points."""
        self._parts.append(f'<polyline points="{_points(xy)}" fill="none"{_stroke(fill, width)}/>')

    def polygon(self, xy: Any, fill: Fill = None, outline: Fill = None, width: float = 1) -> None:
        """Draw a closed shape."""
        self._parts.append(f'<polygon points="{_points(xy)}"{_fill(fill)}{_stroke(outline, width)}/>')

    def rectangle(self, xy: Any, fill: Fill = None, outline: Fill = None, width: float = 1) -> None:
        """Draw a rectangle from its corners."""
        self.rounded_rectangle(xy, 0, fill, outline, width)

    def rounded_rectangle(
        self, xy: Any, radius: float = 0, fill: Fill = None, outline: Fill = None, width: float = 1
    ) -> None:
        """Draw a rectangle with round corners."""
        x0, y0, x1, y1 = xy
        shape = f'x="{_n(x0)}" y="{_n(y0)}" width="{_n(x1 - x0)}" height="{_n(y1 - y0)}" rx="{_n(radius)}"'
        self._parts.append(f"<rect {shape}{_fill(fill)}{_stroke(outline, width)}/>")

    def ellipse(self, xy: Any, fill: Fill = None, outline: Fill = None, width: float = 1) -> None:
        """Draw an ellipse in its box."""
        x0, y0, x1, y1 = xy
        shape = f'cx="{_n((x0 + x1) / 2)}" cy="{_n((y0 + y1) / 2)}" rx="{_n((x1 - x0) / 2)}" ry="{_n((y1 - y0) / 2)}"'
        self._parts.append(f"<ellipse {shape}{_fill(fill)}{_stroke(outline, width)}/>")

    def text(
        self,
        xy: tuple[float, float],
        text: str,
        fill: Fill = None,
        font: Any = None,
        anchor: str = "la",
        stroke_width: float = 0,
        stroke_fill: Fill = None,
    ) -> None:
        """Write a text; it takes the width that Pillow's font gives it, whichever font shows it."""
        size = float(getattr(font, "size", 20))
        down = {"a": 0.8, "m": 0.32, "s": 0.0, "d": -0.2, "t": 0.72, "b": -0.2}[anchor[1]] * size
        side = {"l": "start", "m": "middle", "r": "end"}[anchor[0]]
        halo = f'{_stroke(stroke_fill, 2 * stroke_width)} paint-order="stroke" stroke-linejoin="round"'
        width = f' textLength="{_n(self.textlength(text, font))}"' if text.isascii() and len(text) > 1 else ""
        place = f'x="{_n(xy[0])}" y="{_n(xy[1] + down)}" font-size="{_n(size)}" text-anchor="{side}"{width}'
        self._parts.append(f"<text {place}{_fill(fill)}{halo if stroke_width else ''}>{escape(shown(text))}</text>")

    def textlength(self, text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont | None = None) -> float:
        """Return the width of a text, px."""
        return float(self._ruler.textlength(text, font=font))


def _n(value: float) -> str:
    return f"{float(value):.1f}".rstrip("0").rstrip(".")


def _points(xy: Any) -> str:
    return " ".join(f"{_n(x)},{_n(y)}" for x, y in xy)


def _color(fill: Sequence[int], name: str) -> str:
    r, g, b, *rest = (int(v) for v in fill)
    opacity = f' {name}-opacity="{rest[0] / 255:.3g}"' if rest and rest[0] < 255 else ""
    return f' {name}="#{r:02x}{g:02x}{b:02x}"{opacity}'


def _fill(fill: Fill) -> str:
    return ' fill="none"' if fill is None else _color(fill, "fill")


def _stroke(fill: Fill, width: float) -> str:
    return "" if fill is None else f'{_color(fill, "stroke")} stroke-width="{_n(width)}"'
