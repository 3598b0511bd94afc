"""Draw what stands round the map of a plan view: header, scale bar, axes and legend."""

from __future__ import annotations

import numpy as np

from list3r.exporters.plan.sheet import GREY, INK, OVERSAMPLING, Sheet, font_of, plain_text
from list3r.memory.records import Instance


def draw_scale_bar(sheet: Sheet, unit: str) -> None:
    """Draw a bar of a round length at the right under the map."""
    k = OVERSAMPLING
    length = round_length(260 * k / sheet.frame.pixels_per_unit)
    x1, y = float(sheet.left + sheet.map_size[0]), sheet.top + sheet.map_size[1] + 38.0 * k
    x0 = x1 - length * sheet.frame.pixels_per_unit
    sheet.draw.line([(x0, y - 6 * k), (x0, y), (x1, y), (x1, y - 6 * k)], fill=INK, width=2 * k)
    words = f"{length:g} m" if unit == "m" else f"{length:g} units of the memory (relative scale)"
    sheet.text((x1, y - 11 * k), words, sheet.text_font, INK, anchor="rs")


def draw_grid(sheet: Sheet, unit: str) -> None:
    """Draw a grid of round lengths from the world's origin, with ticks and numbers, and a cross at the origin."""
    k, frame = OVERSAMPLING, sheet.frame
    step = round_length(130 * k / frame.pixels_per_unit)
    width, height = sheet.map_size
    left, top, right, bottom = sheet.left, sheet.top, sheet.left + width, sheet.top + height
    reach = np.array([width, height]) / (2 * frame.pixels_per_unit)
    low, high = np.ceil((frame.center - reach) / step), np.floor((frame.center + reach) / step)
    for n in np.arange(low[0], high[0] + 1):
        x = left + width / 2 + (n * step - frame.center[0]) * frame.pixels_per_unit
        sheet.draw.line([(x, top), (x, bottom)], fill=(*INK, 22), width=k)
        sheet.draw.line([(x, bottom), (x, bottom + 5 * k)], fill=GREY, width=k)
        sheet.text((x, bottom + 6 * k), f"{n * step + 0.0:g}", font_of(11), GREY, anchor="ma")
    for n in np.arange(low[1], high[1] + 1):
        y = top + height / 2 - (n * step - frame.center[1]) * frame.pixels_per_unit
        sheet.draw.line([(left, y), (right, y)], fill=(*INK, 22), width=k)
        sheet.draw.line([(left - 5 * k, y), (left, y)], fill=GREY, width=k)
        sheet.text((left - 6 * k, y), f"{n * step + 0.0:g}", font_of(11), GREY, anchor="rm")
    x, y = (float(v) for v in sheet.px(np.zeros((1, 3)))[0])
    if left < x < right and top < y < bottom:
        for dx, dy in ((9 * k, 0), (0, 9 * k)):
            sheet.draw.line([(x - dx, y - dy), (x + dx, y + dy)], fill=INK, width=2 * k)
        # Below and left: a camera that starts at the origin has its word at the right.
        sheet.text((x - 5 * k, y + 4 * k), f"0 {unit}", font_of(11), INK, anchor="ra", halo=True)


def draw_axes(sheet: Sheet, remark: str) -> None:
    """Draw the world's axes as they lie on the page, what is up, and a remark, under the map."""
    k = OVERSAMPLING
    origin = np.array([sheet.left + 24.0 * k, sheet.top + sheet.map_size[1] + 37.0 * k])
    for axis, (name, color) in enumerate((("x", (200, 60, 60)), ("y", (40, 140, 60)), ("z", (50, 90, 200)))):
        arrow = sheet.frame.R_plan_world[:2, axis] * [1.0, -1.0] * 14 * k
        if np.linalg.norm(arrow) < 5 * k:
            continue
        tip = origin + arrow
        sheet.stroke(origin, tip, color, 2)
        side = np.array([-arrow[1], arrow[0]]) * 0.16
        head = [tip + arrow * 0.18, tip - arrow * 0.16 + side, tip - arrow * 0.16 - side]
        sheet.draw.polygon([(float(p[0]), float(p[1])) for p in head], fill=color)
        at = tip + arrow * 0.45
        sheet.text((float(at[0]), float(at[1])), name, font_of(12), color, anchor="mm")
    sheet.text(
        (sheet.left + 66.0 * k, sheet.top + sheet.map_size[1] + 37.0 * k),
        sheet.frame.note + remark,
        sheet.text_font,
        GREY,
        "lm",
    )


def draw_header(sheet: Sheet, title: str, subtitle: str) -> None:
    """Write the name of the memory and what is in it."""
    k = OVERSAMPLING
    sheet.text((sheet.left, 14 * k), title, font_of(24), INK)
    sheet.text((sheet.left, 47 * k), subtitle, font_of(15), GREY)


def draw_legend(sheet: Sheet, things: list[Instance], unit: str) -> None:
    """Draw a table of ids, descriptions and sizes; where it is too long, those that were seen most."""
    k, layout = OVERSAMPLING, sheet.layout
    chosen = seen_most(things, layout.columns * layout.rows)
    x, y = layout.legend_xy[0] * k, layout.legend_xy[1] * k
    for column in range(layout.columns):
        rows = chosen[column * layout.rows : (column + 1) * layout.rows]
        if rows:
            _legend_column(sheet, rows, unit, x, y)
        x += (layout.column_px + sheet.settings.margin_px) * k
    if len(things) > len(chosen):
        below = (layout.legend_xy[0] + 46) * k, y + (32 + layout.rows * sheet.settings.row_px) * k
        words = f"and {len(things) - len(chosen):,} more, seen in fewer frames"
        sheet.text(below, words, sheet.text_font, GREY)


def _legend_column(sheet: Sheet, rows: list[Instance], unit: str, x: float, y: float) -> None:
    k = OVERSAMPLING
    right = x + sheet.layout.column_px * k
    sizes = [" x ".join(f"{v:.2f}" if v < 10 else f"{v:.1f}" for v in i.box.size) for i in rows]
    reserved = max(sheet.draw.textlength(s, font=sheet.text_font) for s in sizes) + 12 * k
    sheet.text((x + 46 * k, y + 4 * k), "name or description", sheet.text_font, GREY)
    sheet.text((right, y + 4 * k), f"size, {unit}", sheet.text_font, GREY, anchor="ra")
    sheet.draw.line([(x, y + 25 * k), (right, y + 25 * k)], fill=(205, 207, 212), width=k)
    for row, (instance, size) in enumerate(zip(rows, sizes, strict=True)):
        middle = y + 28 * k + (row + 0.5) * sheet.settings.row_px * k
        sheet.chip((x + 18 * k, middle), (max(30.0 * k, sheet.chip_width(instance.id)), 18.0 * k), instance.id)
        room = right - reserved - x - 46 * k
        words = _shorten(sheet, sheet.name(instance), room)
        sheet.text((x + 46 * k, middle), words, sheet.text_font, INK, anchor="lm")
        sheet.text((right, middle), size, sheet.text_font, GREY, anchor="rm")


def seen_most(things: list[Instance], limit: int) -> list[Instance]:
    """Return at most this many things, those with the most observations, by id."""
    return sorted(sorted(things, key=lambda i: (-i.observations, i.id))[:limit], key=lambda i: i.id)


def _shorten(sheet: Sheet, text: str, width: float) -> str:
    text = text if sheet.vector is not None else plain_text(text)
    if sheet.draw.textlength(text, font=sheet.text_font) <= width:
        return text
    while text and sheet.draw.textlength(text + "…", font=sheet.text_font) > width:
        text = text[:-1]
    return text.rstrip() + "…"


def round_length(limit: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not over the limit."""
    power = 10.0 ** np.floor(np.log10(limit))
    return float(power * max(m for m in (1, 2, 5) if m * power <= limit))
