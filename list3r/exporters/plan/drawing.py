"""Draw a plan view with matplotlib: walls, instances with their ids, the camera path, a grid and a legend."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.colors
import matplotlib.font_manager
import matplotlib.patheffects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from list3r.exporters.components import Component, component_files, has_box, thinned_support
from list3r.exporters.output import write_together
from list3r.exporters.palette import instance_color
from list3r.exporters.plan.loops import loop_ends
from list3r.exporters.plan.raster import picture_from_above
from list3r.exporters.plan.view import PlanView, choose_view, is_wall
from list3r.exporters.tags import TagTarget, place_tags
from list3r.memory.core.description.printable import shown
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Instance
from list3r.memory.library.rooms.naming import named_rooms
from list3r.memory.library.world.gravity import gravity_of
from list3r.memory.library.world.scale import lengths_of
from list3r.memory.store.store import Store
from list3r.queries.views.footprint import large_footprints

_INK, _GREY, _LINE = "#262a34", "#787c86", "#cdcfd4"
_ROOM = "#2f5fa8"
_START, _END, _LOOP = "#168c64", "#c43048", "#7654be"
_STYLE: Any = {"font.family": "sans-serif", "svg.fonttype": "none", "svg.hashsalt": "list3r", "hatch.linewidth": 0.5}
_DPI = 100
_EDGE_PX, _HEAD_PX, _FOOT_PX, _ROW_PX, _COLUMN_PX = 56, 84, 74, 22, 480
"""Rim of the page, room above the map for the title and below it for the axis, height of a row of the legend and the
least width of its columns."""


@dataclass(frozen=True)
class PlanSettings:
    """How the picture is laid out."""

    width_px: int = 1600
    max_map_px: int = 1000
    """Height of the map, at most."""
    max_rows: int = 16
    """Rows of a column of the legend, at most."""
    max_tags: int = 80
    """The instances seen most have tags; where there are more, the others are faint outlines."""
    points_per_instance: int = 8000
    """At most this many points of each instance are drawn,"""
    points_of_instances: int = 10_000_000
    """and of all together;"""
    points_per_structure: int = 40000
    """and of each floor, wall and the like."""

    def __post_init__(self) -> None:
        if self.width_px < 700:
            raise OptionError(f"the picture is {self.width_px} px wide; at least 700 px are needed")


def write_plan(store: Store, path: str | Path, settings: PlanSettings | None = None) -> tuple[Path, ...]:
    """Write the plan view of every component as PNG or SVG, the main one to `path`. Returns the files written."""
    kind = Path(path).suffix.lower().lstrip(".")

    def write(component: Component, to: Path) -> None:
        with mpl.rc_context(_STYLE):
            figure = plan_figure(store, component, settings)
            figure.savefig(to, format=kind, dpi=_DPI, metadata={"Date": None} if kind == "svg" else None)

    return write_together(component_files(store, path), write)


def plan_figure(store: Store, component: Component, settings: PlanSettings | None = None) -> Figure:
    """Draw the plan view of one component; coordinates of its map are those of the page (`PlanView.on_page`)."""
    s = settings or PlanSettings()
    share = s.points_of_instances // max(len(component.instances), 1)
    limits = (min(s.points_per_instance, max(share, 1)), s.points_per_structure)
    supports = {i.id: thinned_support(store, i, limits[i.structure is not None]) for i in component.instances}
    view = choose_view(component, supports, gravity_of(store, component.id))
    instances = [i for i in component.instances if not i.structure and has_box(i)]
    tagged = _seen_most(instances, s.max_tags)

    page = _Page(view, s, len(instances))
    ax = page.map
    seen = [i for i in component.instances if len(supports[i.id].points) and i.structure != "ceiling"]
    walls = [i for i in seen if is_wall(i, view.R_plan_world[2])]
    floors = [i for i in seen if i.structure and i not in walls]
    layers = ([i for i in seen if not i.structure], floors, walls)
    picture = picture_from_above(view, *([supports[i.id] for i in layer] for layer in layers))
    ax.imshow(picture, extent=(view.low[0], view.high[0], view.low[1], view.high[1]), zorder=1)
    draw_grid(ax, view, str(lengths_of(store)))
    if component.id == min((c.component for c in store.chunks.all()), default=0):
        _draw_rooms(ax, view, store)
    _draw_footprints(ax, view, instances, {i.id for i in tagged}, store)
    _draw_tracks(ax, view, store, component)
    _draw_loops(ax, view, loop_ends(store, component))
    _draw_camera_path(ax, view, component)
    _draw_tags(page, tagged)
    remark = "" if len(tagged) == len(instances) else f"; the {len(tagged)} instances seen most have tags"
    page.write((_EDGE_PX, 34), _title(store, component), size=17)
    page.write((_EDGE_PX, 60), _subtitle(store, component), size=10, color=_GREY)
    page.write((_EDGE_PX, page.below_map + 44), f"{view.note}; hatched: not seen{remark}", size=10, color=_GREY)
    _draw_legend(page, instances, str(lengths_of(store)))
    return page.figure


class _Page:
    """A figure with lengths in px from its upper left corner and the axes of the map."""

    def __init__(self, view: PlanView, settings: PlanSettings, rows: int) -> None:
        width, span = settings.width_px, view.high - view.low
        map_width = width - 2 * _EDGE_PX
        map_height = float(np.clip(map_width * span[1] / span[0], 300, settings.max_map_px))
        self.columns = max(1, map_width // _COLUMN_PX)
        self.rows = min(-(-rows // self.columns), settings.max_rows)
        self.below_map = _HEAD_PX + map_height
        height = self.below_map + _FOOT_PX + (self.rows + 2.5) * _ROW_PX * bool(rows)
        self.size = (width, round(height))
        self.figure = Figure(figsize=(width / _DPI, self.size[1] / _DPI), dpi=_DPI, facecolor="white")
        FigureCanvasAgg(self.figure)
        place = (_EDGE_PX / width, 1 - self.below_map / self.size[1], map_width / width, map_height / self.size[1])
        self.map = self.figure.add_axes(place)
        half = np.array([map_width, map_height]) / 2 * max(span[0] / map_width, span[1] / map_height)
        (left, bottom), (right, top) = (view.low + view.high) / 2 - half, (view.low + view.high) / 2 + half
        self.map.add_patch(Rectangle((left, bottom), *(2 * half), hatch="//", fill=False, ec="#c4c8d0", lw=0, zorder=0))
        self.map.set(xlim=(left, right), ylim=(bottom, top))
        self.map.spines[:].set_color(_LINE)
        self.view, self.pixels_per_unit = view, map_width / (right - left)

    def write(self, xy: tuple[float, float], text: str, *, size: float, **how: Any) -> None:
        """Write a text at a place of the page, px."""
        place = (xy[0] / self.size[0], 1 - xy[1] / self.size[1])
        how = {"color": _INK, "va": "center", **how}
        self.figure.text(*place, text, fontsize=size, parse_math=False, **how)


def draw_grid(ax: Axes, view: PlanView, unit: str) -> None:
    """Mark world x and y where the page shows them, turned as it is; else lengths along the page."""
    corners = np.array([(x, y) for x in ax.get_xlim() for y in ax.get_ylim()])
    turn = view.R_plan_world[:2, :2] if view.shows_world_axes else np.eye(2)
    left, bottom = ax.get_xlim()[0], ax.get_ylim()[0]
    marks: dict[bool, list[tuple[float, str]]] = {False: [], True: []}
    heads: dict[bool, str] = {}
    for axis, name in enumerate("xy" if view.shows_world_axes else ("along the page", "up the page")):
        across = turn[:, axis]  # of the page, in which this coordinate grows
        rises = bool(abs(across[1]) > abs(across[0]))
        values = corners @ across
        along = np.array([-across[1], across[0]])
        heads[rises] = f"{name}, {unit}"
        for value in MaxNLocator(10, steps=[1, 2, 5, 10]).tick_values(values.min(), values.max()):
            on, off = across * value, across * value + along
            ax.axline((on[0], on[1]), (off[0], off[1]), color=_INK, lw=0.5, alpha=0.12, zorder=2)
            edge = (value - across[0] * left) / across[1] if rises else (value - across[1] * bottom) / across[0]
            marks[rises].append((edge, f"{value:g}"))
    for rises, set_ticks, limits in ((False, ax.set_xticks, ax.get_xlim()), (True, ax.set_yticks, ax.get_ylim())):
        inside = [(at, text) for at, text in marks[rises] if limits[0] <= at <= limits[1]]
        set_ticks([at for at, _ in inside], [text for _, text in inside])
    ax.tick_params(colors=_GREY, labelsize=8, color=_LINE)
    ax.set_xlabel(heads[False], color=_GREY, fontsize=8, loc="right", labelpad=2)
    ax.set_ylabel(heads[True], color=_GREY, fontsize=8, loc="top", labelpad=2)
    if view.shows_world_axes:
        ax.plot(0, 0, "+", color=_INK, ms=11, mew=1.3, zorder=6, scalex=False, scaley=False)


def footprints(view: PlanView, instances: list[Instance]) -> NDArray[np.float64]:
    """Return the outlines of boxes on the page, plan coordinates: six corners each, in order. Shape (N, 6, 2).

    The shadow of a box is the sum of its three edges: they are walked by their direction, then back.
    """
    edges = np.array([i.box.rotation.T * i.box.size[:, None] for i in instances]).reshape(-1, 3, 3)
    flat = view.on_page(edges)
    flat *= np.where((flat[..., 1] < 0) | ((flat[..., 1] == 0) & (flat[..., 0] < 0)), -1.0, 1.0)[..., None]
    order = np.argsort(np.arctan2(flat[..., 1], flat[..., 0]), axis=1)
    steps = np.take_along_axis(flat, order[..., None], axis=1)
    start = view.on_page(np.array([i.box.center for i in instances]).reshape(-1, 3)) - steps.sum(axis=1) / 2
    return np.asarray(
        start[:, None] + np.cumsum(np.concatenate([np.zeros_like(steps[:, :1]), steps, -steps[:, :2]], 1), 1)
    )


def _color(instance_id: int, alpha: float = 1.0) -> tuple[float, float, float, float]:
    r, g, b = instance_color(instance_id)
    return r / 255, g / 255, b / 255, alpha


def _draw_rooms(ax: Axes, view: PlanView, store: Store) -> None:
    """Draw outlines and names of rooms, dashed where a room is partial, and a diamond in each doorway."""
    for room in named_rooms(store):
        corners = view.on_page(np.column_stack([room.outline, np.full(len(room.outline), room.floor_z)]))
        style = (0, (4, 3)) if room.partial else "-"
        ax.add_patch(Polygon(corners, fill=False, ec=_ROOM, lw=1.4, ls=style, alpha=0.8, zorder=2.5))
        x, y = (corners.min(axis=0) + corners.max(axis=0)) / 2
        name = shown(room.name or f"room {room.id}")
        halo = [matplotlib.patheffects.withStroke(linewidth=3, foreground="white", alpha=0.8)]
        ax.text(x, y, name, color=_ROOM, size=12, ha="center", va="center", zorder=4.5, path_effects=halo)
    for d in store.rooms.doorways():
        ax.plot(*view.on_page(d.position), "D", color=_ROOM, ms=5, mfc="white", zorder=4)


def _draw_footprints(ax: Axes, view: PlanView, instances: list[Instance], tagged: set[int], store: Store) -> None:
    """Draw what large things cover and the boxes of others, small ones over large ones; faint where without a tag."""
    if not instances:
        return
    outlines = footprints(view, instances)
    order = np.argsort(-np.ptp(outlines, axis=1).prod(axis=1), kind="stable")
    known = [instances[k].id in tagged for k in order]
    covered = large_footprints(store, instances) if view.shows_world_axes else {}
    tops = {i.id: float(i.aabb[1, 2]) for i in instances}
    shapes = {n: view.on_page(np.column_stack([xy, np.full(len(xy), tops[n])])) for n, xy in covered.items()}
    ids = [instances[k].id for k in order]
    edges = [_color(n, 1.0 if has else 0.4) for n, has in zip(ids, known, strict=True)]
    fills = [_color(n, 0.12 if has else 0.0) for n, has in zip(ids, known, strict=True)]
    widths = [1.6 if has else 0.7 for has in known]
    ax.add_collection(
        PolyCollection(
            [shapes.get(instances[k].id, outlines[k]) for k in order],
            facecolors=fills,
            edgecolors=edges,
            linewidths=widths,
            zorder=3,
        )
    )


def _draw_tracks(ax: Axes, view: PlanView, store: Store, component: Component) -> None:
    """Draw where moving instances went: a dot where each was seen first, an arrow where last."""
    for instance in (i for i in component.instances if i.dynamic):
        places = store.tracks.of(instance.id)[1]
        xy = view.on_page(places[np.isfinite(places).all(axis=1)])
        if len(xy) < 2:
            continue
        color = _color(instance.id)
        ax.plot(*xy.T, color=color, lw=2.2, zorder=4)
        ax.plot(*xy[0], "o", color=color, ms=6, zorder=4)
        arrow = {"arrowstyle": "->", "color": color, "lw": 2.2}
        ax.annotate("", xy[-1], xy[-1 - max(1, len(xy) // 5)], arrowprops=arrow, zorder=4)


def _draw_loops(ax: Axes, view: PlanView, ends: NDArray[np.float64]) -> None:
    """Draw lines between cameras of the frames that closed a loop, (L, 2, 3), and their legend over the map."""
    if not len(ends):
        return
    xy = view.on_page(ends)
    ax.add_collection(LineCollection(list(xy), colors=_LOOP, linewidths=0.8, alpha=0.5, zorder=4))
    ax.plot(*xy.reshape(-1, 2).T, ".", color=_LOOP, ms=4, alpha=0.8, zorder=4)
    words = f"— {len(ends)} loop closure{'s' * (len(ends) > 1)}"
    ax.text(1.0, 1.015, words, transform=ax.transAxes, ha="right", va="bottom", color=_LOOP, fontsize=9)


def _draw_camera_path(ax: Axes, view: PlanView, component: Component) -> None:
    """Draw the camera's path from green to red, with short strokes in its viewing direction; gaps where it was lost."""
    fade = mpl.colors.LinearSegmentedColormap.from_list("path", [_START, _END])
    reach = 0.012 * float((view.high - view.low).max())
    for session in sorted({frame.session_id for frame, _ in component.poses}):
        poses = [p for p in component.poses if p[0].session_id == session]
        frames = np.array([frame.frame_index for frame, _ in poses])
        xy = view.on_page(np.stack([S_world_cam.translation for _, S_world_cam in poses]))
        steps = np.diff(frames)
        joined = np.flatnonzero(steps <= 1.5 * np.median(steps)) if len(frames) > 1 else np.zeros(0, int)
        lines = [xy[k : k + 2] for k in joined]
        ax.add_collection(LineCollection(lines, colors=fade(joined / len(xy)), linewidths=1.6, zorder=5))
        shown_at = np.arange(0, len(xy), max(1, len(xy) // 30))
        ahead = view.on_page(np.stack([poses[k][1].rotation[:, 2] for k in shown_at])) * reach
        strokes = [(xy[k], xy[k] + step) for k, step in zip(shown_at, ahead, strict=True)]
        ax.add_collection(LineCollection(strokes, colors=fade(shown_at / len(xy)), linewidths=1.1, zorder=5))
        close = bool(np.linalg.norm(xy[-1] - xy[0]) < 4 * reach)
        for at, word, color, mark, side in (
            (xy[0], "start", _START, "o", 1),
            (xy[-1], "end", _END, "s", 1 - 2 * close),
        ):
            ax.plot(*at, mark, color=color, ms=9, mec="white", mew=1.5, zorder=7)
            align = "left" if side > 0 else "right"
            text = ax.annotate(word, at, (9 * side, 0), textcoords="offset points", color=color, ha=align, va="center")
            text.set(fontsize=10, zorder=7, path_effects=_halo())


def _halo() -> list[mpl.patheffects.AbstractPathEffect]:
    return [mpl.patheffects.withStroke(linewidth=2.5, foreground="white")]


def _draw_tags(page: _Page, instances: list[Instance]) -> None:
    """Draw the id of each instance on or near it, a line to it where it is away, its name where there is room."""
    if not instances:
        return
    ax, k = page.map, page.pixels_per_unit
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    targets, names = [], []
    for instance, outline in zip(instances, footprints(page.view, instances), strict=True):
        low, high = outline.min(axis=0), outline.max(axis=0)
        half = tuple((high - low) / 2 * k)
        width, name = _tag_px(instance.id), _name(instance).split(",")[0]
        room = width + 7.5 * len(name) + 8
        names.append(name if room < 1.8 * half[0] and half[1] > 20 else "")
        middle = (low + high) / 2
        at = (float(middle[0] - left) * k, float(top - middle[1]) * k)
        targets.append(TagTarget(at, (float(half[0]), float(half[1])), (room if names[-1] else width, 19.0)))
    places = place_tags(targets, (3.0, 3.0, (right - left) * k - 3, (top - bottom) * k - 3))
    for instance, target, name, (x, y) in zip(instances, targets, names, places, strict=True):
        if abs(x - target.xy[0]) > target.half[0] or abs(y - target.xy[1]) > target.half[1]:
            (x0, y0), (x1, y1) = target.xy, (x, y)
            ends = np.array([(left + x0 / k, top - y0 / k), (left + x1 / k, top - y1 / k)])
            ax.plot(*ends.T, color=_INK, lw=0.7, alpha=0.7, marker=".", markevery=[0], ms=4, zorder=7)
        start = x - target.tag[0] / 2 + _tag_px(instance.id) / 2
        _chip(ax.text(left + start / k, top - y / k, str(instance.id), zorder=9), instance.id)
        if name:
            at = (left + (start + _tag_px(instance.id) / 2 + 4) / k, top - y / k)
            how: dict[str, Any] = {"fontsize": 10, "color": _INK, "va": "center", "zorder": 8, "path_effects": _halo()}
            ax.text(*at, name, parse_math=False, **how)


def _tag_px(instance_id: int) -> float:
    return 9.0 + 8.0 * len(str(instance_id))


def _chip(text: mpl.text.Text, instance_id: int) -> None:
    """Make a text the tag of an id."""
    color = instance_color(instance_id)
    ink = "white" if np.dot((0.3, 0.59, 0.11), color) < 165 else _INK
    box = {"boxstyle": "round,pad=0.28", "fc": _color(instance_id), "ec": "white", "lw": 0.8}
    text.set(fontsize=8.5, color=ink, ha="center", va="center_baseline", bbox=box)


def _draw_legend(page: _Page, instances: list[Instance], unit: str) -> None:
    """Write ids, names or descriptions and sizes below the map; where they are too many, the most seen ones."""
    chosen = _seen_most(instances, page.columns * page.rows)
    width = (page.size[0] - 2 * _EDGE_PX) / page.columns
    top = page.below_map + _FOOT_PX
    for column in range(page.columns):
        rows = chosen[column * page.rows : (column + 1) * page.rows]
        x, right = _EDGE_PX + column * width, _EDGE_PX + (column + 1) * width - 30
        for n, instance in enumerate(rows):
            y = top + (n + 1) * _ROW_PX
            at = ((x + 18) / page.size[0], 1 - y / page.size[1])
            _chip(page.figure.text(*at, str(instance.id)), instance.id)
            size = " x ".join(f"{v:.2f}" if v < 10 else f"{v:.1f}" for v in instance.box.size)
            room = int((right - x - 46 - 7 * len(size)) / 7)
            name = _name(instance)
            page.write((x + 46, y), name if len(name) <= room else name[: room - 1].rstrip() + "…", size=10)
            page.write((right, y), size, size=10, color=_GREY, ha="right")
        if rows:
            page.write((x + 46, top), "name or description", size=9, color=_GREY)
            page.write((right, top), f"size, {unit}", size=9, color=_GREY, ha="right")
    if len(instances) > len(chosen):
        words = f"and {len(instances) - len(chosen):,} more, seen in fewer frames"
        page.write((_EDGE_PX + 46, top + (page.rows + 1) * _ROW_PX), words, size=9, color=_GREY)


def _name(instance: Instance) -> str:
    """Return the label of an instance; where there is none, or the font lacks its letters, its description."""
    label = shown(instance.label or "")
    font = mpl.font_manager.get_font(mpl.font_manager.findfont(mpl.font_manager.FontProperties()))
    lacking = any(not font.get_char_index(ord(c)) for c in label)
    description = shown(instance.description)
    return description if not label or (lacking and description) else label


def _seen_most(instances: list[Instance], limit: int) -> list[Instance]:
    """Return at most this many instances, with the most observations, by id."""
    return sorted(sorted(instances, key=lambda i: (-i.observations, i.id))[:limit], key=lambda i: i.id)


def _title(store: Store, component: Component) -> str:
    extra = "" if component.main else f" (component {component.id}, not placed against the main one)"
    return shown(store.path.name) + extra


def _subtitle(store: Store, component: Component) -> str:
    structure = [i.structure for i in component.instances if i.structure]
    kinds = ", ".join(
        f"{structure.count(k)} {k}{'s' * (structure.count(k) > 1)}"
        for k in ("floor", "wall", "ceiling", "plane")
        if k in structure
    )
    words = [
        f"{len(component.instances) - len(structure):,} instances",
        f"structure: {kinds}" if kinds else "no structure",
        f"{len(component.poses):,} posed frames",
        f"scale {(store.facts.scale_kind or 'relative')}",
    ]
    return "  ·  ".join(words)
