"""How things stand to each other: deterministic geometry, each relation with confidence and margin.

Vertical relations (on, in, above, under, and their inverses; attached_to) exist only where gravity is known or
estimated. Inverses are relations of their own, so that a reader never has to know which is which: `on` comes with
`supports`, `in` with `contains`, `above` with `below`; `next_to` and `near` come in both directions. `near` holds
wherever `next_to` holds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from list3r.memory.bodies import Body, neighbours_of
from list3r.memory.geometry import Array
from list3r.memory.records import Relation

T = TypeVar("T")

INVERSE = {
    "on": "supports",
    "supports": "on",
    "in": "contains",
    "contains": "in",
    "above": "below",
    "below": "above",
    "next_to": "next_to",
    "near": "near",
}
"""The inverse of each predicate that has one; `under` and `attached_to` have none."""
PREDICATES = (*INVERSE, "under", "attached_to")


@dataclass(frozen=True)
class RelationSettings:
    """Decision boundaries. Metres are turned into units of a relative memory by what a metre is there."""

    noise_m: float = 0.015
    """Standard deviation of a height or gap: depth noise and drift between chunks."""
    contact_m: float = 0.035
    """A thing may float or sink by this much and still stand on a surface: its lowest points are seldom seen."""
    contact_per_height: float = 0.12
    """More of it for tall things, whose thin legs are seldom seen."""
    hidden_feet: float = 0.6
    """A thing that stands on nothing and touches no wall stands on the floor if its lowest visible point is nearer to
    it than this share of its longest edge: legs under a table are often not seen."""
    hidden_feet_m: float = 0.8
    """And nearer than this."""
    least_base: float = 0.25
    """Least area of the surface under a thing over the thing's own footprint: a floor does not stand on table legs."""
    enclosed: float = 0.7
    """Share of directions round a thing in which a container has a side."""
    inside: float = 0.8
    """Share of a thing's points inside its container's box."""
    overhead: float = 0.4
    """Share of a thing's points that have something over them, to be under it."""
    above_m: float = 1.5
    """Higher than this over something is no longer said to be above it."""
    next_to_m: tuple[float, float] = (0.1, 0.4)
    """Gap between surfaces: half the mean size of the two, within these."""
    near_m: tuple[float, float] = (0.3, 1.0)
    """Gap between surfaces: twice the size of the smaller one, within these."""
    attached_m: float = 0.05


class Measured:
    """What was measured between pairs of bodies before, by their stamps: a run computes only what is new."""

    def __init__(self, known: dict[tuple[object, ...], object] | None = None) -> None:
        self._known = known or {}
        self.used: dict[tuple[object, ...], object] = {}

    def get(self, what: str, a: Body, b: Body, compute: Callable[[], T]) -> T:
        """The measure `what` of a and b, computed if it is new."""
        if not (a.stamp and b.stamp):
            return compute()
        key = (what, a.stamp, b.stamp, a.structure, b.structure)
        if key not in self.used:
            self.used[key] = self._known[key] if key in self._known else compute()
        return cast(T, self.used[key])


def relations(
    bodies: Sequence[Body],
    *,
    gravity_known: bool,
    unit: float = 1.0,
    settings: RelationSettings | None = None,
    measured: Measured | None = None,
) -> list[Relation]:
    """All relations among bodies, in the order of (subject, predicate, object).

    `unit` is what a metre is in world units (1 for a metric memory). Bodies of different components have none.
    `measured` holds what a run before found for the same bodies, unit and settings.
    """
    s = settings or RelationSettings()
    bodies = sorted(bodies, key=lambda b: b.id)
    scene = _Scene(bodies, unit, s, measured or Measured())
    out: list[Relation] = []
    holding: set[tuple[int, int]] = set()
    if gravity_known:
        inside = _containments(scene)
        supported = _supports(scene, {a for a, _, _, _ in inside})
        supported += _on_hidden_feet(scene, {a for a, _, _, _ in (*inside, *supported)})
        for predicate, found in (("in", inside), ("on", supported)):
            for a, b, confidence, margin in found:
                holding |= {(a, b), (b, a)}
                out += _both(bodies, a, predicate, b, confidence, margin)
        out += _overhead(scene, holding)
        out += _attached(scene, {a for a, _, _, _ in (*inside, *supported)})
    out += _beside(scene, holding, gravity_known)
    return sorted(out, key=lambda r: (r.subject, r.predicate, r.object))


_Found = tuple[int, int, float, float]
"""Subject and object by position, confidence, margin."""
_Held = tuple[int, float, float]
"""Object by position, confidence, margin."""
_Sure = tuple[float, float]
"""Confidence, margin."""


class _Scene:
    """Bodies with what is derived from them once."""

    def __init__(self, bodies: Sequence[Body], unit: float, settings: RelationSettings, measured: Measured) -> None:
        self.bodies = bodies
        self._measured = measured
        self.unit = unit
        self.s = settings
        self._trees: dict[int, cKDTree] = {}
        self._plans: dict[int, _Plan] = {}
        low = np.array([b.aabb[0] for b in bodies]).reshape(-1, 3)
        high = np.array([b.aabb[1] for b in bodies]).reshape(-1, 3)
        gap = np.maximum(0, np.maximum(low[:, None] - high[None], low[None] - high[:, None]))
        self.box_gap = np.linalg.norm(gap, axis=2)
        component = np.array([b.component for b in bodies])
        self.box_gap[component[:, None] != component[None]] = np.inf
        self.low, self.high = low, high
        self.size = np.array([b.size for b in bodies])
        self.thing = np.array([b.structure is None for b in bodies], dtype=bool)

    def tree(self, n: int) -> cKDTree:
        """KD-tree of a body's points."""
        if n not in self._trees:
            self._trees[n] = cKDTree(self.bodies[n].points)
        return self._trees[n]

    def measure(self, what: str, a: int, b: int, compute: Callable[[_Scene, int, int], T]) -> T:
        """A measure of two bodies, from memory where it is known."""
        return self._measured.get(what, self.bodies[a], self.bodies[b], lambda: compute(self, a, b))

    def gap(self, a: int, b: int) -> float:
        """Distance between surfaces: of the nearest support points."""
        return self.measure("gap", min(a, b), max(a, b), _gap)

    def plan(self, n: int) -> _Plan:
        """A body as it is seen from above."""
        if n not in self._plans:
            points = self.bodies[n].points
            sample = points[:: -(-len(points) // _SAMPLE)]
            self._plans[n] = _Plan(sample, cKDTree(sample[:, :2]), _spacing(sample))
        return self._plans[n]


def _gap(scene: _Scene, a: int, b: int) -> float:
    small, large = sorted((a, b), key=lambda n: (len(scene.bodies[n].points), n))
    return float(neighbours_of(scene.plan(small).points, scene.tree(large))[0].min())


_SAMPLE = 200
"""Points that stand for a body where its outline matters, not its detail."""


@dataclass(frozen=True)
class _Plan:
    points: Array
    tree: cKDTree
    spacing: float


def _both(bodies: Sequence[Body], a: int, predicate: str, b: int, confidence: float, margin: float) -> list[Relation]:
    x, y = bodies[a].id, bodies[b].id
    c, m = round(min(max(confidence, 0.0), 1.0), 4), round(margin, 5)
    return [Relation(x, predicate, y, c, m), Relation(y, INVERSE[predicate], x, c, m)]


def _sure(margin: float, noise: float) -> float:
    """How likely a decision stands when its margin is measured with this noise: 0.5 at the boundary."""
    return 1.0 / (1.0 + math.exp(-min(1.7 * margin / max(noise, 1e-12), 700.0)))


# ---------------------------------------------------------------------------------------------- on


def _supports(scene: _Scene, taken: set[int]) -> list[_Found]:
    """Each thing on at most one other: the one whose surface it touches best."""
    out = []
    holds = np.array([b.structure not in ("wall", "ceiling") for b in scene.bodies], dtype=bool)
    for a, body in enumerate(scene.bodies):
        if a in taken or body.structure is not None:
            continue
        best: _Held | None = None
        reach = _contact(scene, a) + 0.05 * scene.unit
        middle = body.points[:, :2].mean(axis=0)
        aside = np.maximum(scene.low[:, :2] - middle, middle - scene.high[:, :2]).max(axis=1)
        near = holds & (scene.box_gap[a] <= reach) & (scene.low[:, 2] <= scene.low[a, 2] + reach)
        near &= aside <= 0.25 * scene.unit
        near[a] = False
        for b in np.flatnonzero(near).tolist():
            found = scene.measure("on", a, b, _stands_on)
            if found is not None and (best is None or found[0] > best[1]):
                best = (b, *found)
        if best is not None:
            out.append((a, *best))
    on = {a: b for a, b, _, _ in out}
    base = [float(np.prod(b.box.size[:2])) for b in scene.bodies]
    return [f for f in out if not (on.get(f[1]) == f[0] and (base[f[0]], f[0]) > (base[f[1]], f[1]))]


def _on_hidden_feet(scene: _Scene, held: set[int]) -> list[_Found]:
    """Things that must stand on the floor, for nothing else holds them, though their feet were not seen."""
    s = scene.s
    out = []
    floors = [n for n, b in enumerate(scene.bodies) if b.structure == "floor"]
    for a, body in enumerate(scene.bodies):
        if a in held or body.structure is not None or _hangs(scene, a) is not None:
            continue
        z = body.points[:, 2]
        limit = min(s.hidden_feet * body.size, s.hidden_feet_m * scene.unit)
        gaps = []
        for b in floors:
            aside = np.maximum(scene.low[b, :2] - body.box.center[:2], body.box.center[:2] - scene.high[b, :2]).max()
            if np.isfinite(scene.box_gap[a, b]) and aside <= 0.25 * scene.unit:
                near = neighbours_of(body.box.center[None, :2], scene.plan(b).tree, min(12, len(scene.plan(b).points)))[
                    1
                ]
                gaps.append((float(np.quantile(z, 0.01) - np.median(scene.plan(b).points[near[0], 2])), b))
        if gaps and 0.0 <= min(gaps)[0] < limit:
            gap, b = min(gaps)
            out.append((a, b, 0.8 * (1.0 - 0.5 * gap / limit), limit - gap))
    return out


def _hangs(scene: _Scene, a: int) -> tuple[float, int] | None:
    """The wall that a thing touches: (gap, position), the nearest one."""
    limit = scene.s.attached_m * scene.unit
    walls = [
        (scene.gap(a, b), b)
        for b, other in enumerate(scene.bodies)
        if other.structure in ("wall", "plane") and scene.box_gap[a, b] < limit
    ]
    return min(walls) if walls and min(walls)[0] < limit else None


def _contact(scene: _Scene, a: int) -> float:
    height = float(scene.bodies[a].box.size[2])
    return scene.s.contact_m * scene.unit + scene.s.contact_per_height * min(height, scene.unit)


def _stands_on(scene: _Scene, a: int, b: int) -> _Sure | None:
    """Whether a stands on a surface of b: near its bottom, under its middle, with a above it."""
    subject, other = scene.bodies[a], scene.bodies[b]
    z = subject.points[:, 2]
    bottom, tolerance = float(np.quantile(z, 0.01)), _contact(scene, a)
    sink = scene.s.contact_m * scene.unit + 0.5 * scene.s.contact_per_height * min(float(np.ptp(z)), scene.unit)
    layer = other.points[(other.points[:, 2] > bottom - tolerance) & (other.points[:, 2] < bottom + sink)]
    if len(layer) < 3:
        return None
    middle = subject.points[:, :2].mean(axis=0)
    spacing = _spacing(layer)
    hold = max(0.02 * scene.unit, min(spacing, 0.25 * scene.unit))
    outside, area = _hull_under(middle, layer[:, :2])
    if outside > hold or area < scene.s.least_base * float(np.prod(subject.box.size[:2])):
        return None
    radius = 0.5 * float(np.linalg.norm(subject.box.size[:2])) + max(0.06 * scene.unit, 2.0 * spacing)
    around = layer[np.linalg.norm(layer[:, :2] - middle, axis=1) < radius]
    if len(around) < 3:
        return None
    distance = neighbours_of(around[:, :2], cKDTree(subject.points[:, :2]))[0][:, 0]
    close = around[np.argsort(distance, kind="stable")[:24]]
    surface = float(np.median(close[:, 2]))
    if float((z > surface - 0.7 * sink).mean()) < 0.6:
        return None
    gap = bottom - surface
    margin = tolerance - gap if gap >= 0 else sink + gap
    if margin < 0:
        return None
    noise = scene.s.noise_m * scene.unit
    below = float((other.points[:, 2] <= float(np.median(z))).mean()) if other.structure is None else 1.0
    confidence = _sure(margin, noise) * (0.5 + 0.5 * min(1.0, below * 2.0)) * _steady(subject, around)
    return confidence, margin


def _steady(subject: Body, around: Array) -> float:
    """1 where the surface is seen all round the thing's middle, less where only on one side of it: what lies beside
    a thing on a table is as high as the table, to the noise, but does not go round it.
    """
    away = around[:, :2] - subject.points[:, :2].mean(axis=0)
    sectors = np.unique(np.floor((np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) % 1.0) * 8).astype(int) % 8)
    return 0.6 + 0.4 * min(1.0, len(sectors) / 7)


def _spacing(points: Array) -> float:
    """Typical distance between neighbouring points of a layer."""
    if len(points) < 3:
        return 0.0
    sample = points[:: max(1, len(points) // 100)]
    return float(np.median(neighbours_of(sample, cKDTree(points), 2)[0][:, 1]))


def _hull_under(point: Array, xy: Array) -> tuple[float, float]:
    """How far a point lies outside the convex hull of others in the plane, 0 inside, and the area of the hull."""
    try:
        hull = ConvexHull(xy)
    except (QhullError, ValueError):
        return float(np.linalg.norm(xy - point, axis=1).min()), 0.0
    return float(max(0.0, (hull.equations[:, :2] @ point + hull.equations[:, 2]).max())), float(hull.volume)


# ---------------------------------------------------------------------------------------------- in


def _containments(scene: _Scene) -> list[_Found]:
    """Each thing in at most one container, the smallest that encloses it."""
    out = []
    for a, body in enumerate(scene.bodies):
        if body.structure is not None:
            continue
        holders = [
            (float(np.prod(scene.bodies[b].box.size)), b)
            for b in range(len(scene.bodies))
            if a != b and scene.bodies[b].structure is None and scene.box_gap[a, b] == 0.0
            if np.prod(body.box.size) <= 0.7 * np.prod(scene.bodies[b].box.size)
        ]
        for _, b in sorted(holders):
            found = scene.measure("in", a, b, _enclosed)
            if found is not None:
                out.append((a, b, *found))
                break
    return out


def _enclosed(scene: _Scene, a: int, b: int) -> _Sure | None:
    """Whether b's box holds a and b has sides round a: a shelf or a box does, a seat or a table top does not."""
    subject, holder = scene.bodies[a], scene.bodies[b]
    local = (subject.points - holder.box.center) @ holder.box.rotation
    inside = float(np.all(np.abs(local) <= holder.box.size / 2 + 0.01 * scene.unit, axis=1).mean())
    if inside < scene.s.inside:
        return None
    low, high = np.quantile(subject.points[:, 2], [0.03, 0.97])
    rise = high - low
    brim = low + max(0.3 * rise, 2.5 * scene.s.noise_m * scene.unit)
    sides = holder.points[(holder.points[:, 2] > brim) & (holder.points[:, 2] < max(high, brim) + 0.3 * rise)]
    away = sides[:, :2] - subject.points[:, :2].mean(axis=0)
    reach = 0.25 * float(np.min(subject.box.size[:2]))
    away = away[np.linalg.norm(away, axis=1) > reach]
    sectors = np.unique(np.floor((np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) % 1.0) * 12).astype(int) % 12)
    share = len(sectors) / 12
    floor = (holder.points[:, 2] < low + 0.3 * rise).sum()
    if share < scene.s.enclosed or floor < 3:
        return None
    margin = (share - scene.s.enclosed) * float(np.min(subject.box.size[:2]))
    return inside * min(1.0, 0.5 + share / 2), margin


# ---------------------------------------------------------------------------------------------- above, below, under


def _overhead(scene: _Scene, holding: set[tuple[int, int]]) -> list[Relation]:
    """above and below for things apart in height, under for what stands beneath a surface of another."""
    s, unit = scene.s, scene.unit
    out: list[Relation] = []
    low, high = scene.low, scene.high
    meet = np.all(low[:, None, :2] <= high[None, :, :2], axis=2)
    pairs = meet & meet.T & np.isfinite(scene.box_gap) & (high[:, None, 2] > high[None, :, 2])
    pairs &= (low[:, None, 2] - high[None, :, 2] <= s.above_m * unit) & scene.thing[:, None] & scene.thing[None]
    noise = s.noise_m * unit
    for a, b in np.argwhere(pairs).tolist():
        found = None if (a, b) in holding else scene.measure("over", a, b, _over)
        if found is None:
            continue
        share, covered, gap = found
        if gap < 2.0 * noise or gap > s.above_m * unit:
            continue
        sure = _sure(gap - 2.0 * noise, noise) * min(1.0, 0.5 + share / 2)
        if covered >= s.overhead and low[a, 2] < high[b, 2]:
            upper, lower = scene.bodies[a].id, scene.bodies[b].id
            out.append(Relation(lower, "under", upper, round(sure, 4), round(gap, 5)))
        elif share >= s.overhead and low[a, 2] >= low[b, 2]:
            out += _both(scene.bodies, a, "above", b, sure, gap)
    return out


def _over(scene: _Scene, a: int, b: int) -> tuple[float, float, float] | None:
    """How far a is over b: (share of the smaller footprint where it is, share of the lower one's points
    that it covers, clearance there), None where it is nowhere.
    """
    upper, lower = scene.plan(a), scene.plan(b)
    reach = max(0.03 * scene.unit, 1.5 * max(upper.spacing, lower.spacing))
    covered = float((neighbours_of(lower.points[:, :2], upper.tree)[0][:, 0] < reach).mean())
    back, under = neighbours_of(upper.points[:, :2], lower.tree)
    hit = back[:, 0] < reach
    if not hit.any():
        return None
    gap = float(np.quantile(upper.points[hit, 2], 0.1) - np.quantile(lower.points[under[hit, 0], 2], 0.9))
    return max(covered, float(hit.mean())), covered, gap


# ---------------------------------------------------------------------------------------------- attached, beside


def _attached(scene: _Scene, held: set[int]) -> list[Relation]:
    """Things that hang on a wall: touching it, standing on nothing."""
    limit = scene.s.attached_m * scene.unit
    out = []
    for a, body in enumerate(scene.bodies):
        if a in held or body.structure is not None:
            continue
        touched = _hangs(scene, a)
        if touched is not None:
            gap, b = touched
            c = round(_sure(limit - gap, scene.s.noise_m * scene.unit), 4)
            out.append(Relation(body.id, "attached_to", scene.bodies[b].id, c, round(limit - gap, 5)))
    return out


def _beside(scene: _Scene, holding: set[tuple[int, int]], gravity_known: bool) -> list[Relation]:
    """next_to and near, from the gap between surfaces relative to the sizes of the two."""
    s, unit = scene.s, scene.unit
    noise = s.noise_m * unit
    reach = np.clip(2.0 * np.minimum(scene.size[:, None], scene.size[None]), s.near_m[0] * unit, s.near_m[1] * unit)
    mean = 0.5 * (scene.size[:, None] + scene.size[None])
    close = np.clip(0.5 * mean, s.next_to_m[0] * unit, s.next_to_m[1] * unit)
    pairs = np.triu(scene.thing[:, None] & scene.thing[None] & (scene.box_gap <= reach), 1)
    out: list[Relation] = []
    for a, b in np.argwhere(pairs).tolist():
        if (a, b) in holding:
            continue
        gap, near, beside = scene.gap(a, b), float(reach[a, b]), float(close[a, b])
        if gap > near:
            continue
        out += _both(scene.bodies, a, "near", b, _sure(near - gap, noise), near - gap)
        if gap <= beside and (not gravity_known or _side_by_side(scene, a, b)):
            out += _both(scene.bodies, a, "next_to", b, _sure(beside - gap, noise), beside - gap)
    return out


def _side_by_side(scene: _Scene, a: int, b: int) -> bool:
    """Whether two things share a good part of their heights."""
    low = max(scene.low[a, 2], scene.low[b, 2])
    high = min(scene.high[a, 2], scene.high[b, 2])
    shorter = min(scene.high[a, 2] - scene.low[a, 2], scene.high[b, 2] - scene.low[b, 2])
    return bool(high - low >= 0.3 * shorter - scene.s.noise_m * scene.unit)
