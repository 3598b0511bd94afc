"""Set-of-marks: the outline and the id of every instance on a stored picture, so that words can point at instances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from list3r.exporters.palette import Color, instance_color
from list3r.exporters.tags import TagTarget, place_tags
from list3r.memory.core.masks import decode_mask
from list3r.queries.pictures import InstanceSight, mask_border


@dataclass(frozen=True)
class MarkSettings:
    """How marks are drawn."""

    least_width_px: int = 960
    """Smaller pictures are enlarged to at least this, by a whole factor, so that marks hide little."""
    font_px: int = 18
    tint: float = 0.25
    """Share of the instance's colour over its pixels."""


def draw_marks(
    rgb: NDArray[np.uint8], sights: Sequence[InstanceSight], settings: MarkSettings | None = None
) -> Image.Image:
    """Return the picture with outlines in the instances' colours and their ids in tags that avoid each other.

    `rgb` has shape (H, W, 3); masks of another size are not drawn.
    """
    s = settings or MarkSettings()
    height, width = rgb.shape[:2]
    zoom = max(1, -(-s.least_width_px // width))
    image = Image.fromarray(_tinted(rgb, sights, s.tint)).resize(
        (width * zoom, height * zoom), Image.Resampling.BICUBIC
    )
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(s.font_px)
    targets = [_target(sight, (height, width), zoom, draw, font) for sight in sights]
    places = place_tags(targets, (2.0, 2.0, width * zoom - 2.0, height * zoom - 2.0))
    for sight, target, place in zip(sights, targets, places, strict=True):
        if abs(place[0] - target.xy[0]) > target.tag[0] or abs(place[1] - target.xy[1]) > target.tag[1]:
            draw.line([place, target.xy], fill=instance_color(sight.instance_id), width=2)
    for sight, target, place in zip(sights, targets, places, strict=True):
        _tag(draw, font, str(sight.instance_id), place, target.tag, instance_color(sight.instance_id))
    return image


def _tinted(rgb: NDArray[np.uint8], sights: Sequence[InstanceSight], tint: float) -> NDArray[np.uint8]:
    out = rgb.astype(np.float64)
    for sight in sorted(sights, key=lambda s: -s.area_px):
        mask = decode_mask(sight.mask, (rgb.shape[0], rgb.shape[1]))
        color = np.array(instance_color(sight.instance_id), np.float64)
        out[mask] = (1.0 - tint) * out[mask] + tint * color
        out[mask_border(mask, 1)] = color
    return np.round(out).astype(np.uint8)


def _target(
    sight: InstanceSight,
    size: tuple[int, int],
    zoom: int,
    draw: ImageDraw.ImageDraw,
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
) -> TagTarget:
    """Return where a tag belongs: on the pixel of the mask that is farthest from its edge."""
    from scipy.ndimage import distance_transform_edt

    mask = np.pad(decode_mask(sight.mask, size), 1)
    inside = np.asarray(distance_transform_edt(mask))
    y, x = np.unravel_index(int(np.argmax(inside)), inside.shape)
    reach = float(inside.max()) * zoom
    wide = draw.textlength(str(sight.instance_id), font=font) + 8.0
    tall = float(font.getbbox("0")[3]) + 6.0
    return TagTarget(((float(x) - 0.5) * zoom, (float(y) - 0.5) * zoom), (reach, reach), (wide, tall))


def _tag(
    draw: ImageDraw.ImageDraw,
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
    text: str,
    place: tuple[float, float],
    size: tuple[float, float],
    color: Color,
) -> None:
    x, y = place
    half = size[0] / 2, size[1] / 2
    draw.rectangle((x - half[0], y - half[1], x + half[0], y + half[1]), fill=(0, 0, 0), outline=color, width=2)
    draw.text((x, y), text, fill=(255, 255, 255), font=font, anchor="mm")
