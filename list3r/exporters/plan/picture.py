"""Draw a plan view: walls, instances with their ids, the camera path, a scale bar and a legend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from list3r.exporters.components import Component, component_files, has_box, thinned_support
from list3r.exporters.output import units, write_together
from list3r.exporters.plan.colors import plan_colors
from list3r.exporters.plan.drawing import (
    draw_boxes,
    draw_camera_path,
    draw_loops,
    draw_picture,
    draw_tags,
    draw_tracks,
)
from list3r.exporters.plan.frame import PlanFrame, choose_rotation, quarter_turn
from list3r.exporters.plan.layout import Layout, PlanSettings, choose_layout
from list3r.exporters.plan.loops import loop_ends
from list3r.exporters.plan.margins import draw_axes, draw_grid, draw_header, draw_legend, draw_scale_bar, seen_most
from list3r.exporters.plan.sheet import OVERSAMPLING, Sheet
from list3r.memory.records import Support
from list3r.memory.store.store import Store


def write_plan(store: Store, path: str | Path, settings: PlanSettings | None = None) -> tuple[Path, ...]:
    """Write the plan view of every component as PNG or SVG, the main one to `path`. Returns the files written."""
    chosen, vector = settings or PlanSettings(), Path(path).suffix.lower() == ".svg"

    def write(component: Component, to: Path) -> None:
        if vector:
            sheet = _drawn(store, component, chosen, vector=True)
            assert sheet.vector is not None
            to.write_text(sheet.vector.svg(chosen.width_px), encoding="utf-8")
        else:
            plan_image(store, component, chosen).save(to, format="PNG")

    return write_together(component_files(store, path), write)


def plan_image(store: Store, component: Component, settings: PlanSettings | None = None) -> Image.Image:
    """Draw the plan view of one component."""
    return _drawn(store, component, settings or PlanSettings(), vector=False).finish()


def _drawn(store: Store, component: Component, settings: PlanSettings, *, vector: bool) -> Sheet:
    share = settings.points_of_instances // max(len(component.instances), 1)
    limits = (min(settings.points_per_instance, max(share, 1)), settings.points_per_structure)
    supports = {i.id: thinned_support(store, i, limits[i.structure is not None]) for i in component.instances}
    things = [i for i in component.instances if not i.structure and has_box(i)]
    tagged = seen_most(things, settings.max_tags)
    frame, layout = _frame(store, component, supports, settings, len(things))
    middles = frame.to_px(np.array([i.box.center for i in things]).reshape(-1, 3))
    colors = plan_colors(dict(zip((i.id for i in things), middles, strict=True)))
    sheet = Sheet(frame, layout, settings, colors, vector=vector)
    draw_picture(sheet, component, supports)
    draw_grid(sheet, units(store))
    draw_boxes(sheet, things, {i.id for i in tagged})
    moved = {i.id: store.tracks.of(i.id)[1] for i in component.instances if i.dynamic}
    draw_tracks(sheet, {n: places[np.isfinite(places).all(axis=1)] for n, places in moved.items()})
    draw_loops(sheet, loop_ends(store, component))
    draw_camera_path(sheet, component)
    draw_tags(sheet, tagged)
    draw_scale_bar(sheet, units(store))
    remark = "" if len(tagged) == len(things) else f"; the {len(tagged)} things seen most have tags"
    draw_axes(sheet, f"; hatched: not seen{remark}")
    draw_header(sheet, _title(store, component), _subtitle(store, component))
    draw_legend(sheet, things, units(store))
    return sheet


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
        f"{len(component.instances) - len(structure):,} things",
        f"structure: {kinds}" if kinds else "no structure",
        f"{len(component.poses):,} posed frames",
        f"scale {(store.facts.scale_kind or 'relative')}",
    ]
    return "  ·  ".join(words)


def _frame(
    store: Store, component: Component, supports: dict[int, Support], settings: PlanSettings, things: int
) -> tuple[PlanFrame, Layout]:
    """Choose a view with the walls along the page, everything inside, as large as the page allows."""
    rotation, note = choose_rotation(component, store.facts.gravity)
    low, high = _extent(component, supports, rotation)
    if high[1] - low[1] > high[0] - low[0]:
        rotation = quarter_turn(rotation)
        low, high = _extent(component, supports, rotation)
    span = np.maximum(high - low, 1e-6) * 1.06
    layout = choose_layout(span, things, settings)
    size = (layout.map_px[0] * OVERSAMPLING, layout.map_px[1] * OVERSAMPLING)
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
