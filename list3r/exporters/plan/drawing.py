"""Draw the map of a plan view: what was seen, boxes, tracks, loop closures, the camera path and the tags."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from list3r.exporters.components import Component
from list3r.exporters.palette import Color
from list3r.exporters.plan.frame import is_wall
from list3r.exporters.plan.labels import TagTarget, place_tags
from list3r.exporters.plan.map import hatched, pale_picture
from list3r.exporters.plan.sheet import GREY, INK, OVERSAMPLING, Sheet
from list3r.memory.records import Instance, Support

_START: Color = (22, 140, 100)
_END: Color = (196, 48, 72)
_WORD_PX = (56, 18)
"""Room that the word of a mark takes; ends of a path that are nearer have their words on two sides."""
_LOOP: Color = (118, 84, 190)


def draw_picture(sheet: Sheet, component: Component, supports: dict[int, Support]) -> None:
    """Draw what was seen from above, in pale colours."""
    up = sheet.frame.R_plan_world[2]
    seen = [i for i in component.instances if len(supports[i.id].points) and i.structure != "ceiling"]
    walls = [supports[i.id] for i in seen if is_wall(i, up)]
    floors = [supports[i.id] for i in seen if i.structure and not is_wall(i, up)]
    things = [supports[i.id] for i in seen if not i.structure]
    pixels = pale_picture(sheet.frame.reduced(OVERSAMPLING), things, floors, walls)
    sheet.paste(Image.fromarray(np.round(hatched(pixels)).astype(np.uint8)))
    bare = [i for i in component.instances if is_wall(i, up) and not len(supports[i.id].points)]
    for instance in bare:
        sheet.draw.polygon(sheet.footprint(instance), fill=(62, 68, 82, 200))
    right, bottom = sheet.left + sheet.map_size[0] - 1, sheet.top + sheet.map_size[1] - 1
    sheet.draw.rectangle((sheet.left, sheet.top, right, bottom), outline=(205, 207, 212), width=OVERSAMPLING)


def draw_boxes(sheet: Sheet, things: list[Instance], tagged: set[int]) -> None:
    """Draw oriented boxes, the small ones over the large ones; faint outlines for those without a tag."""
    outlines = {i.id: sheet.footprint(i) for i in things}
    for instance in sorted(things, key=lambda i: (-_area(outlines[i.id]), i.id)):
        color, outline = sheet.color(instance.id), outlines[instance.id]
        if instance.id not in tagged:
            sheet.draw.line([*outline, outline[0], outline[1]], fill=(*color, 110), width=OVERSAMPLING)
            continue
        side_px = _area(outline) ** 0.5 / OVERSAMPLING
        sheet.draw.polygon(outline, fill=(*color, int(np.interp(side_px, [20, 120], [60, 14]))))
        sheet.draw.line([*outline, outline[0], outline[1]], fill=(*color, 255), width=2 * OVERSAMPLING)


def draw_tracks(sheet: Sheet, tracks: dict[int, NDArray[np.float64]]) -> None:
    """Draw where moving things went, in their colours: a dot where each was seen first, an arrow where last."""
    k = OVERSAMPLING
    for instance_id, places in sorted(tracks.items()):
        xy, color = sheet.px(places), sheet.color(instance_id)
        points = [(float(x), float(y)) for x, y in xy]
        if len(points) < 2:
            continue
        sheet.draw.line(points, fill=(*color, 230), width=3 * k, joint="curve")
        (x, y), end = points[0], xy[-1]
        sheet.draw.ellipse((x - 4 * k, y - 4 * k, x + 4 * k, y + 4 * k), fill=color)
        back = xy[max(0, len(xy) - 1 - len(xy) // 5)] - end
        back = back / max(float(np.linalg.norm(back)), 1e-9)
        for side in (-0.5, 0.5):
            turn = np.array([back[0] - side * back[1], back[1] + side * back[0]])
            sheet.stroke(end, end + 12 * k * turn, color, 3)


def draw_loops(sheet: Sheet, ends: NDArray[np.float64]) -> None:
    """Draw lines between cameras of the frames that closed a loop, (L, 2, 3), and what they are over the map."""
    if not len(ends):
        return
    k = OVERSAMPLING
    for a, b in zip(sheet.px(ends[:, 0]), sheet.px(ends[:, 1]), strict=True):
        sheet.draw.line([(float(a[0]), float(a[1])), (float(b[0]), float(b[1]))], fill=(*_LOOP, 120), width=k)
        for x, y in (a, b):
            sheet.draw.ellipse((x - 2.5 * k, y - 2.5 * k, x + 2.5 * k, y + 2.5 * k), fill=(*_LOOP, 200))
    words = f"{len(ends)} loop closure{'s' * (len(ends) > 1)}"
    x, y = sheet.left + float(sheet.map_size[0]), 25.0 * k
    start = x - sheet.draw.textlength(words, font=sheet.text_font) - 40 * k
    sheet.draw.line([(start, y), (start + 32 * k, y)], fill=_LOOP, width=2 * k)
    sheet.text((x, y), words, sheet.text_font, GREY, anchor="rm")


def draw_camera_path(sheet: Sheet, component: Component) -> None:
    """Draw where the camera went, from green to red, with short strokes where it looked; gaps where it was lost."""
    sessions = sorted({frame.session_id for frame, _ in component.poses})
    for session in sessions:
        poses = [p for p in component.poses if p[0].session_id == session]
        frames = np.array([frame.frame_index for frame, _ in poses])
        xy = sheet.px(np.stack([S_world_cam.translation for _, S_world_cam in poses]))
        gaps = np.diff(frames) > 1.5 * np.median(np.diff(frames)) if len(frames) > 1 else np.zeros(0, bool)
        for k in range(len(xy) - 1):
            if not gaps[k]:
                sheet.stroke(xy[k], xy[k + 1], _between(k / max(len(xy) - 1, 1)), 2)
        for k in range(0, len(xy), max(1, len(xy) // 30)):
            forward = sheet.frame.R_plan_world[:2] @ poses[k][1].rotation[:, 2]
            tip = xy[k] + forward * [1.0, -1.0] * 13 * OVERSAMPLING
            sheet.stroke(xy[k], tip, _between(k / max(len(xy) - 1, 1)), 1.5)
        sheet.mark(xy[0], _START, "start", round_mark=True)
        close = np.abs(xy[-1] - xy[0]) < np.array(_WORD_PX) * OVERSAMPLING
        sheet.mark(xy[-1], _END, "end", round_mark=False, left=bool(close.all()))


def draw_tags(sheet: Sheet, things: list[Instance]) -> None:
    """Draw the id of each thing on or beside it, a line to it where it is away, its name where there is room."""
    k = OVERSAMPLING
    anchors, names = [], []
    for instance in things:
        corners = np.array(sheet.footprint(instance))
        low, high = corners.min(axis=0), corners.max(axis=0)
        (x, y), half = ((low + high) / 2).tolist(), ((high - low) / 2).tolist()
        width, name = sheet.chip_width(instance.id), sheet.name(instance).split(",")[0]
        room = width + sheet.draw.textlength(name, font=sheet.text_font) + 8 * k
        names.append(name if room < 1.8 * half[0] and half[1] > 20 * k else "")
        anchors.append(TagTarget((x, y), (half[0], half[1]), (room if names[-1] else width, 18.0 * k)))
    page = (
        sheet.left + 4.0,
        sheet.top + 4.0,
        sheet.left + sheet.map_size[0] - 4.0,
        sheet.top + sheet.map_size[1] - 4.0,
    )
    places = place_tags(anchors, page)
    for anchor, place in zip(anchors, places, strict=True):
        _leader(sheet, anchor, place)
    for instance, anchor, name, (x, y) in zip(things, anchors, names, places, strict=True):
        width = sheet.chip_width(instance.id)
        left = x - anchor.tag[0] / 2
        sheet.chip((left + width / 2, y), (width, anchor.tag[1]), instance.id)
        sheet.text((left + width + 5 * k, y), name, sheet.text_font, INK, anchor="lm", halo=True)


def _leader(sheet: Sheet, anchor: TagTarget, place: tuple[float, float]) -> None:
    (x, y), k = anchor.xy, OVERSAMPLING
    reach = (anchor.tag[0] / 2, anchor.tag[1] / 2) if anchor.small else anchor.half
    if abs(place[0] - x) <= reach[0] and abs(place[1] - y) <= reach[1]:
        return
    sheet.draw.line([anchor.xy, place], fill=(*INK, 170), width=k)
    sheet.draw.ellipse((x - 2 * k, y - 2 * k, x + 2 * k, y + 2 * k), fill=(*INK, 220))


def _area(outline: list[tuple[float, float]]) -> float:
    x, y = np.array(outline).T
    return float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2)


def _between(share: float) -> Color:
    r, g, b = (round(a + (z - a) * share) for a, z in zip(_START, _END, strict=True))
    return r, g, b
