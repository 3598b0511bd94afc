"""What an instance stands on and what it is in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from list3r.memory.core.geometry import Array
from list3r.memory.library.relations.instance_geometry import InstanceGeometry, neighbours_of
from list3r.memory.library.relations.scene import (
    Found,
    Held,
    RelationScene,
    Sure,
    certainty,
    contact_of,
    hull_under,
    spacing_of,
    wall_touched,
)
from list3r.memory.library.relations.settings import SupportSettings

# ---------------------------------------------------------------------------------------------- on


def supports(scene: RelationScene, taken: set[int]) -> list[Found]:
    """Each instance on at most one other: the one whose surface it touches best."""
    s, out = scene.s.on, []
    holds = np.array([b.structure not in ("wall", "ceiling") for b in scene.instances], dtype=bool)
    for a, instance in enumerate(scene.instances):
        if a in taken or instance.structure is not None:
            continue
        best: Held | None = None
        reach = contact_of(scene, a) + s.reach_m * scene.unit
        middle = instance.points[:, :2].mean(axis=0)
        aside = np.maximum(scene.low[:, :2] - middle, middle - scene.high[:, :2]).max(axis=1)
        near = holds & (scene.box_gap[a] <= reach) & (scene.low[:, 2] <= scene.low[a, 2] + reach)
        near &= aside <= s.aside_m * scene.unit
        near[a] = False
        for b in np.flatnonzero(near).tolist():
            found = scene.measure("on", a, b, _stands_on)
            if found is not None and (best is None or found[0] > best[1]):
                best = (b, *found)
        if best is not None:
            out.append((a, *best))
    on = {a: b for a, b, _, _ in out}
    base = [float(np.prod(b.box.size[:2])) for b in scene.instances]
    return [f for f in out if not (on.get(f[1]) == f[0] and (base[f[0]], f[0]) > (base[f[1]], f[1]))]


def on_hidden_feet(scene: RelationScene, held: set[int]) -> list[Found]:
    """Return instances that must stand on the floor or on the instance under them, for nothing else holds them, though
    their feet were not seen.
    """
    s = scene.s
    out = []
    floors = [n for n, b in enumerate(scene.instances) if b.structure == "floor"]
    for a, instance in enumerate(scene.instances):
        if a in held or instance.structure is not None or wall_touched(scene, a) is not None:
            continue
        z = instance.points[:, 2]
        middle, limit = instance.box.center[:2], min(s.hidden_feet * instance.size, s.hidden_feet_m * scene.unit)
        gaps = []
        for b in floors:
            aside = np.maximum(scene.low[b, :2] - middle, middle - scene.high[b, :2]).max()
            if np.isfinite(scene.box_gap[a, b]) and aside <= s.on.aside_m * scene.unit:
                plan = scene.plan(b)
                near = neighbours_of(instance.box.center[None, :2], plan.tree, min(12, len(plan.points)))[1]
                gaps.append((float(np.quantile(z, s.on.lowest) - np.median(plan.points[near[0], 2])), b))
        gaps += [(gap, b) for gap, b in _beneath(scene, a) if gap < s.on.aside_m * scene.unit]
        if gaps and 0.0 <= min(gaps)[0] < limit:
            gap, b = min(gaps)
            out.append((a, b, s.on.hidden * (1.0 - 0.5 * gap / limit), limit - gap))
    return out


def _beneath(scene: RelationScene, a: int) -> list[tuple[float, int]]:
    """Return (clearance, position) of the instances wholly below a that have a surface under its middle and are wide
    enough to hold it.
    """
    s, middle = scene.s.on, scene.instances[a].box.center[:2]
    bottom = float(np.quantile(scene.instances[a].points[:, 2], s.lowest))
    below = scene.in_room & (scene.high[:, 2] < bottom) & np.isfinite(scene.box_gap[a])
    slack = s.aside_m * scene.unit
    below &= np.all((scene.low[:, :2] - slack <= middle) & (scene.high[:, :2] + slack >= middle), axis=1)
    base = float(np.prod(scene.instances[a].box.size[:2]))
    out = []
    for b in np.flatnonzero(below).tolist():
        plan = scene.plan(b)
        if float(np.prod(scene.instances[b].box.size[:2])) < 0.5 * base:
            continue
        distance, at = neighbours_of(middle[None], plan.tree, min(6, len(plan.points)))
        if distance[0, 0] < max(s.beneath_m * scene.unit, s.beneath_spacings * plan.spacing):
            out.append((bottom - float(np.max(plan.points[at[0], 2])), b))
    return out


def _stands_on(scene: RelationScene, a: int, b: int) -> Sure | None:
    """Return whether a stands on a surface of b: near its bottom, under its middle, with a above it."""
    s, subject, other = scene.s.on, scene.instances[a], scene.instances[b]
    z = subject.points[:, 2]
    bottom, tolerance = float(np.quantile(z, s.lowest)), contact_of(scene, a)
    sink = scene.s.contact_m * scene.unit + 0.5 * scene.s.contact_per_height * min(float(np.ptp(z)), scene.unit)
    layer = other.points[(other.points[:, 2] > bottom - tolerance) & (other.points[:, 2] < bottom + sink)]
    if len(layer) < 3:
        return None
    middle = subject.points[:, :2].mean(axis=0)
    aside = np.maximum(layer[:, :2].min(axis=0) - middle, middle - layer[:, :2].max(axis=0)).max()
    if aside > s.aside_m * scene.unit:
        return None
    spacing = spacing_of(layer)
    hold = max(s.hold_m * scene.unit, min(spacing, s.aside_m * scene.unit))
    outside, area = hull_under(middle, layer[:, :2])
    if outside > hold or area < scene.s.least_base * float(np.prod(subject.box.size[:2])):
        return None
    border = max(s.around_m * scene.unit, s.around_spacings * spacing)
    radius = 0.5 * float(np.linalg.norm(subject.box.size[:2])) + border
    around = layer[np.linalg.norm(layer[:, :2] - middle, axis=1) < radius]
    if len(around) < 3:
        return None
    distance = neighbours_of(around[:, :2], cKDTree(subject.points[:, :2]))[0][:, 0]
    close = around[np.argsort(distance, kind="stable")[:24]]
    surface = float(np.median(close[:, 2]))
    if float((z > surface - s.sunk * sink).mean()) < s.above:
        return None
    gap = bottom - surface
    margin = tolerance - gap if gap >= 0 else sink + gap
    if margin < 0:
        return None
    noise = scene.s.noise_m * scene.unit
    below = float((other.points[:, 2] <= float(np.median(z))).mean()) if other.structure is None else 1.0
    confidence = certainty(margin, noise) * (0.5 + 0.5 * min(1.0, below * 2.0)) * _steady(subject, around, s)
    return confidence, margin


def _steady(subject: InstanceGeometry, around: Array, s: SupportSettings) -> float:
    """1 where the surface is seen all round the instance's middle, less where only on one side of it: what lies beside
    an instance on a table is as high as the table, to the noise, but does not go round it.
    """
    away = around[:, :2] - subject.points[:, :2].mean(axis=0)
    sectors = np.unique(np.floor((np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) % 1.0) * 8).astype(int) % 8)
    return s.beside + (1.0 - s.beside) * min(1.0, len(sectors) / s.sectors)


# ---------------------------------------------------------------------------------------------- in


def containments(scene: RelationScene) -> list[Found]:
    """Each instance in at most one container, the smallest that encloses it."""
    out = []
    for a, instance in enumerate(scene.instances):
        if instance.structure is not None:
            continue
        volume = float(np.prod(instance.box.size))
        holders = [
            (float(np.prod(scene.instances[b].box.size)), b)
            for b in np.flatnonzero(scene.in_room & (scene.box_gap[a] == 0.0)).tolist()
            if a != b and volume <= scene.s.within.most_volume * float(np.prod(scene.instances[b].box.size))
        ]
        for _, b in sorted(holders):
            found = scene.measure("in", a, b, _held_inside)
            if found is not None:
                out.append((a, b, *found))
                break
    return out


def _held_inside(scene: RelationScene, a: int, b: int) -> Sure | None:
    """Return whether a is in b: inside its box, with b's sides round it or b's boards under and over it, or down in an
    open container whose sides go round it as far as they are seen. A seat or a table top holds nothing so.
    """
    subject, holder = scene.instances[a], scene.instances[b]
    local = (subject.points - holder.box.center) @ holder.box.rotation
    inside = float(np.all(np.abs(local) <= holder.box.size / 2 + scene.s.within.slack_m * scene.unit, axis=1).mean())
    sides = _sides_round(scene, a, b)
    width = float(np.min(subject.box.size[:2]))
    if inside >= scene.s.inside:
        enclosed = np.radians(scene.s.enclosed_deg)
        if sides.open_rad <= enclosed and _rests_on(scene, a, b):
            return inside * (1.0 - sides.open_rad / (4 * np.pi)), 0.5 * (enclosed - sides.open_rad) * width
        covered = _between_boards(scene, a, b, walled=sides.share > 0.5 and sides.open_rad < np.pi)
        if covered is not None:
            return scene.s.within.boards * inside, covered
    if sides.share < scene.s.around and _is_hollow(scene, b):
        sides = _sides_round(scene, a, b, sunk=True)
    if sides.share >= scene.s.around and sides.uneven < scene.s.uneven and _down_in(scene, a, b):
        return 0.5 + 0.5 * min(sides.share, scene.s.within.sure_sides), (sides.share - scene.s.around) * width
    return None


@dataclass(frozen=True)
class _Sides:
    """Where round an instance its holder has a surface."""

    share: float
    """Share of the directions in which there is one."""
    uneven: float
    """How far they are from being equally far away: the deviation of their distances over the mean."""
    open_rad: float
    """The widest angle without any. One flat side leaves at least a half circle."""


def _sides_round(scene: RelationScene, a: int, b: int, *, sunk: bool = False) -> _Sides:
    """Return b's surfaces round a at a's height, above a's lowest part.

    Of what is `sunk` in a container only the upper part is seen, so surfaces somewhat below it count too, of which
    the farthest are the rim.
    """
    s, subject, holder = scene.s.within, scene.instances[a], scene.instances[b]
    low, high = _heights(scene, a)
    noise = s.side_noises * scene.s.noise_m * scene.unit
    brim = low - noise if sunk else low + max(s.side_height * (high - low), noise)
    z = holder.points[:, 2]
    sides = holder.points[(z > brim) & (z < max(high, brim) + s.side_height * (high - low))]
    away = sides[:, :2] - subject.points[:, :2].mean(axis=0)
    away = away[np.linalg.norm(away, axis=1) > s.clear * float(np.min(subject.box.size[:2]))]
    if len(away) == 0:
        return _Sides(0.0, np.inf, 2 * np.pi)
    angle = np.sort(np.arctan2(away[:, 1], away[:, 0]) % (2 * np.pi))
    sector = np.floor(np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) % 1.0 * 12).astype(int) % 12
    distance = np.linalg.norm(away, axis=1)
    side = np.max if sunk else np.min
    reach = np.array([side(distance[sector == n]) for n in np.unique(sector)])
    opening = float(np.max(np.diff(angle, append=angle[0] + 2 * np.pi)))
    return _Sides(len(reach) / 12, float(reach.std() / reach.mean()), opening)


def _is_hollow(scene: RelationScene, b: int) -> bool:
    """Return whether b is seen to be open above: over its middle most of its surface lies below its rim."""
    seen = _within(scene, b)
    return seen is not None and seen >= scene.s.hollow


def _within(scene: RelationScene, b: int) -> float | None:
    """Return the share of the surface over the middle of b that lies well below its rim; None where hardly any is
    seen."""
    holder = scene.instances[b]
    aside = np.abs((holder.points - holder.box.center) @ holder.box.rotation)[:, :2]
    z = holder.points[np.all(aside < scene.s.within.middle * holder.box.size[:2], axis=1), 2]
    depth = max(2.0 * scene.s.noise_m * scene.unit, scene.s.within.depth * float(holder.box.size[2]))
    return float((z < _rim(scene, b) - depth).mean()) if len(z) >= 10 else None


def _rim(scene: RelationScene, b: int) -> float:
    return _heights(scene, b)[1]


def _heights(scene: RelationScene, n: int) -> tuple[float, float]:
    """Return the height of the lowest and of the highest points of an instance."""
    trim = scene.s.within.trim
    low, high = np.quantile(scene.instances[n].points[:, 2], [trim, 1.0 - trim])
    return float(low), float(high)


def _rests_on(scene: RelationScene, a: int, b: int) -> bool:
    low, high = _heights(scene, a)
    limit = low + scene.s.within.side_height * (high - low)
    return int((scene.instances[b].points[:, 2] < limit).sum()) >= 3


def _between_boards(scene: RelationScene, a: int, b: int, *, walled: bool) -> float | None:
    """Return how far the board over a is above it, where b has surfaces both under a and over it: a shelf.

    Where b is not round a on more than one side (`walled`), what is over a's border alone is no board: a headboard
    rises behind a pillow. A large shelf is sampled so thinly that one point is all that is left of a board over a book;
    it is enough where a rests on b.
    """
    subject, holder = scene.instances[a], scene.instances[b]
    low, high = _heights(scene, a)
    noise = 2.0 * scene.s.noise_m * scene.unit
    aside = np.abs((holder.points - subject.box.center) @ subject.box.rotation)[:, :2]
    half = subject.box.size[:2] / 2
    within = np.all(aside <= half + noise, axis=1)
    inner = within if walled else np.all(aside <= 0.5 * half, axis=1)
    z = holder.points[:, 2]
    under = z[within & (z < low + noise) & (z > low - contact_of(scene, a) - noise)]
    over = z[inner & (z > high + noise)]
    least = 1 if _rests_on(scene, a, b) else 2
    return float(over.min() - high - noise) if len(under) >= least and len(over) >= least else None


def _down_in(scene: RelationScene, a: int, b: int) -> bool:
    """Return whether a sits below the rim of an open container not much wider than it, over the container's middle."""
    subject, holder = scene.instances[a], scene.instances[b]
    width, noise = float(np.max(subject.box.size[:2])), scene.s.noise_m * scene.unit
    footprints = float(np.prod(subject.box.size[:2])) / max(float(np.prod(holder.box.size[:2])), 1e-12)
    wide = float(np.max(holder.box.size[:2])) > scene.s.most_wider * width
    if wide or footprints > scene.s.within.most_footprint or holder.size > scene.s.open_m * scene.unit:
        return False
    seen, bottom = _within(scene, b), _heights(scene, a)[0]
    deep = bottom <= _rim(scene, b) - max(noise, scene.s.within.depth * float(subject.box.size[2]))
    if not deep or bottom < scene.low[b, 2] - 2.0 * noise or (seen is not None and seen < scene.s.hollow):
        return False
    outside, _ = hull_under(subject.points[:, :2].mean(axis=0), holder.points[:, :2])
    return outside <= scene.s.within.depth * width
