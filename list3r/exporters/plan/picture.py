"""Draw a plan view: walls, instances with their ids, the camera path, a scale bar and a legend."""

from __future__ import annotations

import contextlib
import unicodedata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import ConvexHull, QhullError

from list3r.exporters.components import Component, has_box, read_components, thinned_support
from list3r.exporters.output import part_path, replacing, units
from list3r.exporters.palette import Color, instance_color
from list3r.exporters.plan.frame import PlanFrame, choose_rotation, is_wall, quarter_turn
from list3r.exporters.plan.labels import TagTarget, place_tags
from list3r.exporters.plan.layout import Layout, PlanSettings, choose_layout
from list3r.exporters.plan.loops import loop_ends
from list3r.exporters.plan.map import pale_picture
from list3r.memory.records import Instance, Support
from list3r.memory.store.store import Store

_INK: Color = (38, 42, 52)
_GREY: Color = (120, 124, 134)
_START: Color = (22, 140, 100)
_END: Color = (196, 48, 72)
_LOOP: Color = (118, 84, 190)
_OVERSAMPLING = 2
"""Drawn so many times larger and averaged down: Pillow does not smooth its lines."""


def write_plan(store: Store, path: str | Path, settings: PlanSettings | None = None) -> tuple[Path, ...]:
    """Write the plan view of every component as PNG, the main one to `path`. Returns the files written."""
    path, settings = Path(path), settings or PlanSettings()
    written = []
    with contextlib.ExitStack() as stack:
        for component in read_components(store):
            target = part_path(path, component.name)
            temporary = stack.enter_context(replacing(target))
            plan_image(store, component, settings).save(temporary, format="PNG")
            written.append(target)
    return tuple(written)


def plan_image(store: Store, component: Component, settings: PlanSettings | None = None) -> Image.Image:
    """Draw the plan view of one component."""
    settings = settings or PlanSettings()
    limits = (settings.points_per_instance, settings.points_per_structure)
    supports = {i.id: thinned_support(store, i, limits[i.structure is not None]) for i in component.instances}
    things = [i for i in component.instances if not i.structure and has_box(i)]
    tagged = _seen_most(things, settings.max_tags)
    frame, layout = _frame(store, component, supports, settings, len(things))
    sheet = _Sheet(frame, layout, settings)
    sheet.picture(component, supports)
    sheet.boxes(things, {i.id for i in tagged})
    moved = {i.id: store.track(i.id)[1] for i in component.instances if i.dynamic}
    sheet.tracks({n: places[np.isfinite(places).all(axis=1)] for n, places in moved.items()})
    sheet.loops(loop_ends(store, component))
    sheet.camera_path(component)
    sheet.tags(tagged)
    sheet.scale_bar(units(store))
    sheet.axes("" if len(tagged) == len(things) else f"; the {len(tagged)} things seen most have tags")
    sheet.header(_title(store, component), _subtitle(store, component))
    sheet.legend(things, units(store))
    return sheet.finish()


def _title(store: Store, component: Component) -> str:
    extra = "" if component.main else f" (component {component.id}, not placed against the main one)"
    return store.path.name + extra


def _subtitle(store: Store, component: Component) -> str:
    structure = [i.structure for i in component.instances if i.structure]
    kinds = ", ".join(
        f"{structure.count(k)} {k}{'s' * (structure.count(k) > 1)}"
        for k in ("floor", "wall", "ceiling", "plane")
        if k in structure
    )
    words = [
        f"{len(component.instances) - len(structure)} things",
        f"structure: {kinds}" if kinds else "no structure",
        f"{len(component.poses):,} posed frames",
        f"scale {store.get_value('scale_kind', 'relative')}",
    ]
    return "  ·  ".join(words)


def _frame(
    store: Store, component: Component, supports: dict[int, Support], settings: PlanSettings, things: int
) -> tuple[PlanFrame, Layout]:
    """Choose a view with the walls along the page, everything inside, as large as the page allows."""
    rotation, note = choose_rotation(component, store.get_value("gravity", "unknown"))
    low, high = _extent(component, supports, rotation)
    if high[1] - low[1] > high[0] - low[0]:
        rotation = quarter_turn(rotation)
        low, high = _extent(component, supports, rotation)
    span = np.maximum(high - low, 1e-6) * 1.06
    layout = choose_layout(span, things, settings)
    size = (layout.map_px[0] * _OVERSAMPLING, layout.map_px[1] * _OVERSAMPLING)
    return PlanFrame(rotation, (low + high) / 2, float(min(size / span)), size, note), layout


def _extent(
    component: Component, supports: dict[int, Support], rotation: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lower and upper corner, plan coordinates, of boxes of things, camera, and structure but for its fringe."""
    page = rotation[:2].T
    parts = [i.box.corners() @ page for i in component.instances if not i.structure and has_box(i)]
    parts += [S_world_cam.translation[None] @ page for _, S_world_cam in component.poses]
    for i in component.instances:
        if i.structure and len(supports[i.id].points):
            parts.append(np.quantile(supports[i.id].points @ page, [0.01, 0.99], axis=0))
    flat = np.concatenate(parts) if parts else np.array([[-1.0, -1.0], [1.0, 1.0]])
    return flat.min(axis=0), flat.max(axis=0)


class _Sheet:
    """The page while it is drawn, at `_OVERSAMPLING` times its size."""

    def __init__(self, frame: PlanFrame, layout: Layout, settings: PlanSettings) -> None:
        self.frame, self.layout, self.settings = frame, layout, settings
        k = _OVERSAMPLING
        self.left, self.top = settings.margin_px * k, settings.header_px * k
        self.map_size = frame.size_px
        self.image = Image.new("RGB", (settings.width_px * k, layout.height_px * k), (255, 255, 255))
        self.draw = ImageDraw.Draw(self.image, "RGBA")
        self.tag_font, self.text_font = _font(13), _font(14)

    def finish(self) -> Image.Image:
        """Return the page at its size."""
        return self.image.reduce(_OVERSAMPLING)

    def px(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where world points are on the page, px. Shape (N, 3) -> (N, 2)."""
        return np.asarray(self.frame.to_px(points_world) + np.array([self.left, self.top]))

    # ------------------------------------------------------------------ the map

    def picture(self, component: Component, supports: dict[int, Support]) -> None:
        """Draw what was seen from above, in pale colours."""
        up = self.frame.R_plan_world[2]
        seen = [i for i in component.instances if len(supports[i.id].points) and i.structure != "ceiling"]
        walls = [supports[i.id] for i in seen if is_wall(i, up)]
        floors = [supports[i.id] for i in seen if i.structure and not is_wall(i, up)]
        things = [supports[i.id] for i in seen if not i.structure]
        pixels = pale_picture(self.frame.reduced(_OVERSAMPLING), things, floors, walls)
        picture = Image.fromarray(np.round(pixels).astype(np.uint8)).resize(self.map_size, Image.Resampling.BICUBIC)
        self.image.paste(picture, (self.left, self.top))
        bare = [i for i in component.instances if is_wall(i, up) and not len(supports[i.id].points)]
        for instance in bare:
            self.draw.polygon(self._footprint(instance), fill=(62, 68, 82, 200))
        right, bottom = self.left + self.map_size[0] - 1, self.top + self.map_size[1] - 1
        self.draw.rectangle((self.left, self.top, right, bottom), outline=(205, 207, 212), width=_OVERSAMPLING)

    def _footprint(self, instance: Instance) -> list[tuple[float, float]]:
        corners = self.px(instance.box.corners())
        try:
            corners = corners[ConvexHull(corners).vertices]
        except (QhullError, ValueError):
            corners = np.array([corners.min(axis=0), corners.max(axis=0) + 1.0])
        return [(float(x), float(y)) for x, y in corners]

    def boxes(self, things: list[Instance], tagged: set[int]) -> None:
        """Draw oriented boxes, the small ones over the large ones; faint outlines for those without a tag."""
        for instance in sorted(things, key=lambda i: (-_area(self._footprint(i)), i.id)):
            color, outline = instance_color(instance.id), self._footprint(instance)
            if instance.id not in tagged:
                self.draw.line([*outline, outline[0], outline[1]], fill=(*color, 110), width=_OVERSAMPLING)
                continue
            side_px = _area(outline) ** 0.5 / _OVERSAMPLING
            self.draw.polygon(outline, fill=(*color, int(np.interp(side_px, [20, 120], [60, 14]))))
            self.draw.line([*outline, outline[0], outline[1]], fill=(*color, 255), width=2 * _OVERSAMPLING)

    def tracks(self, tracks: dict[int, NDArray[np.float64]]) -> None:
        """Draw where moving things went, in their colours: a dot where each was seen first, an arrow where last."""
        k = _OVERSAMPLING
        for instance_id, places in sorted(tracks.items()):
            xy, color = self.px(places), instance_color(instance_id)
            points = [(float(x), float(y)) for x, y in xy]
            if len(points) < 2:
                continue
            self.draw.line(points, fill=(*color, 230), width=3 * k, joint="curve")
            (x, y), end = points[0], xy[-1]
            self.draw.ellipse((x - 4 * k, y - 4 * k, x + 4 * k, y + 4 * k), fill=color)
            back = xy[max(0, len(xy) - 1 - len(xy) // 5)] - end
            back = back / max(float(np.linalg.norm(back)), 1e-9)
            for side in (-0.5, 0.5):
                turn = np.array([back[0] - side * back[1], back[1] + side * back[0]])
                self._stroke(end, end + 12 * k * turn, color, 3)

    def loops(self, ends: NDArray[np.float64]) -> None:
        """Draw lines between cameras of the frames that closed a loop, (L, 2, 3), and what they are over the map."""
        if not len(ends):
            return
        k = _OVERSAMPLING
        for a, b in zip(self.px(ends[:, 0]), self.px(ends[:, 1]), strict=True):
            self.draw.line([(float(a[0]), float(a[1])), (float(b[0]), float(b[1]))], fill=(*_LOOP, 120), width=k)
            for x, y in (a, b):
                self.draw.ellipse((x - 2.5 * k, y - 2.5 * k, x + 2.5 * k, y + 2.5 * k), fill=(*_LOOP, 200))
        words = f"{len(ends)} loop closure{'s' * (len(ends) > 1)}"
        x, y = self.left + float(self.map_size[0]), 25.0 * k
        start = x - self.draw.textlength(words, font=self.text_font) - 40 * k
        self.draw.line([(start, y), (start + 32 * k, y)], fill=_LOOP, width=2 * k)
        self._text((x, y), words, self.text_font, _GREY, anchor="rm")

    def camera_path(self, component: Component) -> None:
        """Draw where the camera went, from green to red, with short strokes where it looked; gaps where it was lost."""
        sessions = sorted({frame.session_id for frame, _ in component.poses})
        for session in sessions:
            poses = [p for p in component.poses if p[0].session_id == session]
            frames = np.array([frame.frame_index for frame, _ in poses])
            xy = self.px(np.stack([S_world_cam.translation for _, S_world_cam in poses]))
            gaps = np.diff(frames) > 1.5 * np.median(np.diff(frames)) if len(frames) > 1 else np.zeros(0, bool)
            for k in range(len(xy) - 1):
                if not gaps[k]:
                    self._stroke(xy[k], xy[k + 1], _between(k / max(len(xy) - 1, 1)), 2)
            for k in range(0, len(xy), max(1, len(xy) // 30)):
                forward = self.frame.R_plan_world[:2] @ poses[k][1].rotation[:, 2]
                tip = xy[k] + forward * [1.0, -1.0] * 13 * _OVERSAMPLING
                self._stroke(xy[k], tip, _between(k / max(len(xy) - 1, 1)), 1.5)
            self._mark(xy[0], _START, "start", round_mark=True)
            self._mark(xy[-1], _END, "end", round_mark=False)

    def _stroke(self, a: NDArray[np.float64], b: NDArray[np.float64], color: Color, width: float) -> None:
        ends = [(float(a[0]), float(a[1])), (float(b[0]), float(b[1]))]
        self.draw.line(ends, fill=(*color, 210), width=round(width * _OVERSAMPLING))

    def _mark(self, xy: NDArray[np.float64], color: Color, word: str, *, round_mark: bool) -> None:
        x, y = (float(v) for v in xy)
        r = 6 * _OVERSAMPLING
        shape = self.draw.ellipse if round_mark else self.draw.rectangle
        shape((x - r, y - r, x + r, y + r), fill=color, outline=(255, 255, 255), width=2 * _OVERSAMPLING)
        self._text((x + r * 1.6, y), word, self.text_font, color, anchor="lm", halo=True)

    # ------------------------------------------------------------------ words

    def _text(
        self,
        xy: tuple[float, float],
        text: str,
        font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
        color: Color,
        anchor: str = "la",
        *,
        halo: bool = False,
    ) -> None:
        stroke = 2 * _OVERSAMPLING if halo else 0
        self.draw.text(
            xy, _plain(text), fill=color, font=font, anchor=anchor, stroke_width=stroke, stroke_fill=(255, 255, 255)
        )

    def tags(self, things: list[Instance]) -> None:
        """Draw the id of each thing on or beside it, a line to it where it is away, its name where there is room."""
        k = _OVERSAMPLING
        anchors, names = [], []
        for instance in things:
            corners = np.array(self._footprint(instance))
            low, high = corners.min(axis=0), corners.max(axis=0)
            (x, y), half = ((low + high) / 2).tolist(), ((high - low) / 2).tolist()
            width, name = self._chip_width(instance.id), _short_name(instance)
            room = width + self.draw.textlength(name, font=self.text_font) + 8 * k
            names.append(name if room < 1.8 * half[0] and half[1] > 20 * k else "")
            anchors.append(TagTarget((x, y), (half[0], half[1]), (room if names[-1] else width, 18.0 * k)))
        page = (self.left + 4.0, self.top + 4.0, self.left + self.map_size[0] - 4.0, self.top + self.map_size[1] - 4.0)
        places = place_tags(anchors, page)
        for anchor, place in zip(anchors, places, strict=True):
            self._leader(anchor, place)
        for instance, anchor, name, (x, y) in zip(things, anchors, names, places, strict=True):
            width = self._chip_width(instance.id)
            left = x - anchor.tag[0] / 2
            self._chip((left + width / 2, y), (width, anchor.tag[1]), instance.id)
            self._text((left + width + 5 * k, y), name, self.text_font, _INK, anchor="lm", halo=True)

    def _leader(self, anchor: TagTarget, place: tuple[float, float]) -> None:
        (x, y), k = anchor.xy, _OVERSAMPLING
        reach = (anchor.tag[0] / 2, anchor.tag[1] / 2) if anchor.small else anchor.half
        if abs(place[0] - x) <= reach[0] and abs(place[1] - y) <= reach[1]:
            return
        self.draw.line([anchor.xy, place], fill=(*_INK, 170), width=k)
        self.draw.ellipse((x - 2 * k, y - 2 * k, x + 2 * k, y + 2 * k), fill=(*_INK, 220))

    def _chip_width(self, instance_id: int) -> float:
        return float(self.draw.textlength(str(instance_id), font=self.tag_font)) + 9.0 * _OVERSAMPLING

    def _chip(self, xy: tuple[float, float], size: tuple[float, float], instance_id: int) -> None:
        (x, y), (w, h) = xy, (size[0] / 2, size[1] / 2)
        color = instance_color(instance_id)
        edge = _OVERSAMPLING
        self.draw.rounded_rectangle(
            (x - w, y - h, x + w, y + h), radius=h * 0.5, fill=color, outline=(255, 255, 255), width=edge
        )
        self._text((x, y), str(instance_id), self.tag_font, _contrast(color), anchor="mm")

    def scale_bar(self, unit: str) -> None:
        """Draw a bar of a round length at the right under the map."""
        k = _OVERSAMPLING
        length = _round_length(260 * k / self.frame.pixels_per_unit)
        x1, y = float(self.left + self.map_size[0]), self.top + self.map_size[1] + 38.0 * k
        x0 = x1 - length * self.frame.pixels_per_unit
        self.draw.line([(x0, y - 6 * k), (x0, y), (x1, y), (x1, y - 6 * k)], fill=_INK, width=2 * k)
        words = f"{length:g} m" if unit == "m" else f"{length:g} units of the memory (relative scale)"
        self._text((x1, y - 11 * k), words, self.text_font, _INK, anchor="rs")

    def axes(self, remark: str) -> None:
        """Draw the world's axes as they lie on the page, what is up, and a remark, under the map."""
        k = _OVERSAMPLING
        origin = np.array([self.left + 24.0 * k, self.top + self.map_size[1] + 32.0 * k])
        for axis, (name, color) in enumerate((("x", (200, 60, 60)), ("y", (40, 140, 60)), ("z", (50, 90, 200)))):
            arrow = self.frame.R_plan_world[:2, axis] * [1.0, -1.0] * 17 * k
            if np.linalg.norm(arrow) < 5 * k:
                continue
            tip = origin + arrow
            self._stroke(origin, tip, color, 2)
            side = np.array([-arrow[1], arrow[0]]) * 0.16
            head = [tip + arrow * 0.18, tip - arrow * 0.16 + side, tip - arrow * 0.16 - side]
            self.draw.polygon([(float(p[0]), float(p[1])) for p in head], fill=color)
            at = tip + arrow * 0.45
            self._text((float(at[0]), float(at[1])), name, _font(12), color, anchor="mm")
        self._text(
            (self.left + 66.0 * k, self.top + self.map_size[1] + 32.0 * k),
            self.frame.note + remark,
            self.text_font,
            _GREY,
            "lm",
        )

    def header(self, title: str, subtitle: str) -> None:
        """Write the name of the memory and what is in it."""
        k = _OVERSAMPLING
        self._text((self.left, 14 * k), title, _font(24), _INK)
        self._text((self.left, 47 * k), subtitle, _font(15), _GREY)

    def legend(self, things: list[Instance], unit: str) -> None:
        """Draw a table of ids, descriptions and sizes; where it is too long, those that were seen most."""
        k, layout = _OVERSAMPLING, self.layout
        chosen = _seen_most(things, layout.columns * layout.rows)
        x, y = layout.legend_xy[0] * k, layout.legend_xy[1] * k
        for column in range(layout.columns):
            rows = chosen[column * layout.rows : (column + 1) * layout.rows]
            if rows:
                self._legend_column(rows, unit, x, y)
            x += (layout.column_px + self.settings.margin_px) * k
        if len(things) > len(chosen):
            below = (layout.legend_xy[0] + 46) * k, y + (32 + layout.rows * self.settings.row_px) * k
            words = f"and {len(things) - len(chosen)} more, seen in fewer frames"
            self._text(below, words, self.text_font, _GREY)

    def _legend_column(self, rows: list[Instance], unit: str, x: float, y: float) -> None:
        k = _OVERSAMPLING
        right = x + self.layout.column_px * k
        sizes = [_size_text(i) for i in rows]
        reserved = max(self.draw.textlength(s, font=self.text_font) for s in sizes) + 12 * k
        self._text((x + 46 * k, y + 4 * k), "description", self.text_font, _GREY)
        self._text((right, y + 4 * k), f"size, {unit}", self.text_font, _GREY, anchor="ra")
        self.draw.line([(x, y + 25 * k), (right, y + 25 * k)], fill=(205, 207, 212), width=k)
        for row, (instance, size) in enumerate(zip(rows, sizes, strict=True)):
            middle = y + 28 * k + (row + 0.5) * self.settings.row_px * k
            self._chip((x + 18 * k, middle), (max(30.0 * k, self._chip_width(instance.id)), 18.0 * k), instance.id)
            room = right - reserved - x - 46 * k
            words = _shorten(self.draw, instance.label or instance.description, self.text_font, room)
            self._text((x + 46 * k, middle), words, self.text_font, _INK, anchor="lm")
            self._text((right, middle), size, self.text_font, _GREY, anchor="rm")


def _seen_most(things: list[Instance], limit: int) -> list[Instance]:
    """Return at most so many things, those with the most observations, by id."""
    return sorted(sorted(things, key=lambda i: (-i.observations, i.id))[:limit], key=lambda i: i.id)


def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size_px * _OVERSAMPLING)


def _plain(text: str) -> str:
    """Return the text in the letters that Pillow's own font has."""
    kept = "".join(c for c in text if c in "·…" or c.isascii())
    if kept == text:
        return text
    return "".join(
        c if c in "·…" else unicodedata.normalize("NFKD", c).encode("ascii", "ignore").decode() or "?" for c in text
    )


def _shorten(
    draw: ImageDraw.ImageDraw, text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float
) -> str:
    text = _plain(text)
    if draw.textlength(text, font=font) <= width:
        return text
    while text and draw.textlength(text + "…", font=font) > width:
        text = text[:-1]
    return text.rstrip() + "…"


def _short_name(instance: Instance) -> str:
    return _plain(instance.label or instance.description.split(",")[0])


def _size_text(instance: Instance) -> str:
    return " x ".join(f"{v:.2f}" if v < 10 else f"{v:.1f}" for v in instance.box.size)


def _area(outline: list[tuple[float, float]]) -> float:
    x, y = np.array(outline).T
    return float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2)


def _between(share: float) -> Color:
    r, g, b = (round(a + (z - a) * share) for a, z in zip(_START, _END, strict=True))
    return r, g, b


def _contrast(color: Color) -> Color:
    return (255, 255, 255) if 0.3 * color[0] + 0.59 * color[1] + 0.11 * color[2] < 165 else _INK


def _round_length(limit: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not over the limit."""
    power = 10.0 ** np.floor(np.log10(limit))
    return float(power * max(m for m in (1, 2, 5) if m * power <= limit))
