"""What bounds the room rather than standing in it: floor, ceiling, walls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from list3r.memory.core.geometry import Array
from list3r.memory.library.relations.instance_geometry import InstanceGeometry


@dataclass(frozen=True)
class StructureSettings:
    """Sizes of rooms."""

    level_deg: float = 15.0
    """A surface this near to level or upright counts as that."""
    thickness_m: float = 0.12
    """An instance thicker than this is not a surface,"""
    thickness: float = 0.04
    """nor one thicker than this share of its second longest edge: depth noise grows with the room."""
    floor_band_m: float = 0.12
    """Level surfaces this near to the floor, and no thicker, are floor,"""
    computed_floor_band_m: float = 0.2
    """and this near where depth was computed: rooms bend, and up is known to two degrees."""
    least_flagged: float = 0.5
    """Of those, one of which the chunks took less than this share for structure lies on the floor, if they took what
    is beside it for floor: a rug. Likewise what is like a wall is none, if they took another surface nearby for one: a
    door. 0 where depth was computed: by that a floor that bends looks like a rug."""
    bordered: float = 0.1
    """Share of a rug's outline at least that has floor beside it,"""
    beside_m: float = 0.15
    """so near."""
    min_area_m2: float = 0.25
    wall_height_m: float = 1.2
    wall_width_m: float = 0.8
    depth_m: float = 0.8
    """How far behind a surface something still tells that it does not bound the room."""
    behind: float = 0.1
    """Share of the points before and behind a bounding surface that may lie just behind it."""
    under_ceiling: float = 0.02
    """Share of the points near a ceiling that may lie above it."""
    trim: float = 0.1
    """Share of the points at either side of a surface that noise may misplace, as its thickness is measured."""
    low_cameras: float = 0.25
    """Share of the cameras that saw a floor that may come as near to it as to a table: fewer saw one place than all, so
    that a person who squats there weighs more."""
    eye_level: float = 0.9
    """Share of the cameras that lie below eye level."""
    above_eyes_m: float = 0.2
    """A ceiling is higher than the cameras by this."""
    over_ceiling_m: float = 0.1
    """What is higher than a ceiling by this lies above it."""
    behind_m: float = 0.15
    """What lies further behind a surface than this, and nearer than `depth_m`, lies just behind it."""
    near_m: float = 3.0
    """What lies further from a surface has no say."""


def classify_structure(
    instances: Sequence[InstanceGeometry],
    floor_height: float | None,
    eye_level: Callable[[InstanceGeometry], float],
    unit: float,
    settings: StructureSettings | None = None,
    around: Sequence[InstanceGeometry] | None = None,
) -> list[str | None]:
    """floor, ceiling, wall, plane or None for each instance; z must be up.

    `floor_height` is the z of the floor at that place, None where it was not seen; `eye_level` gives the height of the
    cameras that saw an instance (90 % of them are below); `unit` is what a metre is in world units. A floor is level,
    lies at the floor, and is no rug, which chunks distinguish from the floor beside it; a ceiling is level, above
    the cameras, and faces down; a wall is upright, tall and wide, (nearly) nothing lies behind it, and it is no door or
    curtain, which chunks distinguish from a wall nearby. What the chunks flagged in the main and is none of these is
    `plane`: a bit of a wall, a ledge, a corner. A table top or a cabinet front stands in the room and is no structure.
    What lies near an instance decides, so `around` may be all instances (the default: those given) or those within
    `near_m`.
    """
    s = settings or StructureSettings()
    known = instances if around is None else around
    cloud = [b.points[:: max(1, len(b.points) // 100)] for b in known]
    box = np.array([b.aabb for b in known]).reshape(-1, 2, 3)
    out: list[str | None] = []
    for b in instances:
        if b.normal is None:
            out += flagged_only([b])
            continue
        gap = np.maximum(box[:, 0] - b.aabb[1], b.aabb[0] - box[:, 1]).max(axis=1)
        rows = np.flatnonzero(gap <= s.near_m * unit).tolist()
        kind = _classify(b, floor_height, eye_level, np.concatenate([cloud[n] for n in rows]), unit, s)
        flagged = [known[n] for n in rows if known[n].flagged >= s.least_flagged] if b.flagged < s.least_flagged else []
        if kind == "floor" and floor_height is not None:
            floors = [n.points for n in flagged if _low(n, floor_height, unit, s)]
            kind = None if floors and _bordered(b.points, np.concatenate(floors), unit, s) else kind
        elif kind == "wall" and any(_is_upright(n, s) for n in flagged):
            kind = None
        out.append(kind or flagged_only([b])[0])
    return out


def _bordered(sheet: Array, floor: Array, unit: float, s: StructureSettings) -> bool:
    """Return whether floor is seen beside a sheet: what no floor surrounds is the floor. Shape (N, 3) each."""
    cell = s.beside_m * unit / 3.0
    cells = np.unique(np.floor(sheet[:, :2] / cell).astype(np.int64), axis=0)
    filled = {(x, y) for x, y in cells.tolist()}
    around = ((1, 0), (-1, 0), (0, 1), (0, -1))
    outline = [c for c in cells.tolist() if any((c[0] + x, c[1] + y) not in filled for x, y in around)]
    away, _ = cKDTree(floor[:, :2]).query((np.array(outline) + 0.5) * cell, distance_upper_bound=s.beside_m * unit)
    return float(np.isfinite(away).mean()) >= s.bordered


def flagged_only(instances: Sequence[InstanceGeometry]) -> list[str | None]:
    """`plane` for what the chunks took for structure in the main, else None: no more is known without gravity."""
    return ["plane" if b.flagged > 0.5 else None for b in instances]


def _classify(
    instance: InstanceGeometry,
    floor_height: float | None,
    eye_level: Callable[[InstanceGeometry], float],
    cloud: Array,
    unit: float,
    s: StructureSettings,
) -> str | None:
    if instance.normal is None:
        return None
    along = instance.points @ instance.normal
    thickness = float(np.ptp(np.quantile(along, [s.trim, 1.0 - s.trim])))
    edges = np.sort(instance.box.size)
    height, most = float(np.median(instance.points[:, 2])), max(s.thickness_m * unit, s.thickness * edges[1])
    level = is_level(instance, s)
    low = floor_height is not None and _low(instance, floor_height, unit, s)
    most = max(most, s.floor_band_m * unit) if low else most
    if thickness > most or edges[1] * edges[2] < s.min_area_m2 * unit**2:
        return None
    if level:
        if low:
            return "floor"
        above = instance.normal[2] < 0 and height > eye_level(instance) + s.above_eyes_m * unit
        if above and (cloud[:, 2] > height + s.over_ceiling_m * unit).mean() < s.under_ceiling:
            return "ceiling"
        return None
    if not _bounds(instance, cloud, unit, s):
        return None
    if _is_upright(instance, s):
        wide = float(max(instance.box.size[0], instance.box.size[1]))
        tall = float(instance.box.size[2])
        if tall >= s.wall_height_m * unit and wide >= s.wall_width_m * unit:
            return "wall"
    return None


def is_level(instance: InstanceGeometry, s: StructureSettings) -> bool:
    """Return whether an instance is a level surface; z must be up."""
    return instance.normal is not None and bool(abs(instance.normal[2]) > np.cos(np.radians(s.level_deg)))


def _is_upright(instance: InstanceGeometry, s: StructureSettings) -> bool:
    return instance.normal is not None and abs(float(instance.normal[2])) < np.sin(np.radians(s.level_deg))


def _low(instance: InstanceGeometry, floor_height: float, unit: float, s: StructureSettings) -> bool:
    """Return whether a surface is level and lies at the floor."""
    away = abs(float(np.median(instance.points[:, 2])) - floor_height)
    return is_level(instance, s) and away < s.floor_band_m * unit


def _bounds(instance: InstanceGeometry, cloud: Array, unit: float, s: StructureSettings) -> bool:
    """Return whether (nearly) nothing stands just behind the surface; what lies further back may be another room."""
    assert instance.normal is not None
    depth = float(np.median(instance.points @ instance.normal)) - cloud @ instance.normal
    just_behind = (depth > s.behind_m * unit) & (depth < s.depth_m * unit)
    across = cloud - np.outer(cloud @ instance.normal, instance.normal)
    own = instance.points - np.outer(instance.points @ instance.normal, instance.normal)
    inside = np.all((across >= own.min(axis=0)) & (across <= own.max(axis=0)), axis=1)
    return float((just_behind & inside).sum()) <= s.behind * max(float(inside.sum()), 1.0)
