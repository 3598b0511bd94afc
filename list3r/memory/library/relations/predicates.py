"""How instances stand to each other: deterministic geometry, each relation with confidence and margin.

Vertical relations (on, in, above, under, and their inverses; attached_to) exist only where gravity is known or
estimated. Inverses are relations of their own, so that a reader never has to know which is which: `on` comes with
`supports`, `in` with `contains`, `above` with `below`; `next_to` and `near` come in both directions.

`near`: the gap between two instances is at most half their mean size, in any direction. `next_to`: the same, and they
stand side by side (they share heights). Size is the longest edge; bounds in metres stand in the settings. Neither is
said of structure, nor of two instances of which one holds the other, nor where it is hardly likelier than not.

The gap is that of the nearest points, without readings amidst an edge, and with the backs of round instances (decision
0021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from list3r.memory.core.records import Relation
from list3r.memory.library.relations.instance_geometry import InstanceGeometry, neighbours_of
from list3r.memory.library.relations.scene import Found, PairMeasures, RelationScene, certainty, wall_touched
from list3r.memory.library.relations.settings import RelationSettings
from list3r.memory.library.relations.support import containments, on_hidden_feet, supports

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
_SLACK_M = 0.08
"""Boxes leave out strays and surfaces lie nearer than their points, so boxes are looked at that are this much apart."""


def relations(
    instances: Sequence[InstanceGeometry],
    *,
    gravity_known: bool,
    unit: float = 1.0,
    settings: RelationSettings | None = None,
    measured: PairMeasures | None = None,
    sure_of_up: float = 1.0,
) -> list[Relation]:
    """Return all relations among instances, in the order of (subject, predicate, object).

    `unit` is what a metre is in world units (1 for a metric memory). Instances of different components have none.
    `measured` holds what was found for the same instances, unit and settings before. What needs up is as sure as
    `sure_of_up` at most.
    """
    s = settings or RelationSettings()
    instances = sorted(instances, key=lambda b: b.id)
    scene = RelationScene(instances, unit, s, measured or PairMeasures(), upright=gravity_known)
    out: list[Relation] = []
    support: set[tuple[int, int]] = set()
    if gravity_known:
        inside = containments(scene)
        supported = supports(scene, {a for a, _, _, _ in inside})
        supported += on_hidden_feet(scene, {a for a, _, _, _ in (*inside, *supported)})
        for predicate, found in [("in", f) for f in inside] + [("on", f) for f in supported]:
            a, b, _, _ = found
            support |= {(a, b), (b, a)}
            if instances[b].structure == "floor":
                scene.foot[a] = min(scene.foot[a], float(np.median(instances[b].points[:, 2])))
                scene.covering[a] = scene.high[a, 2] - scene.low[a, 2] < s.covering_m * unit
            out += _both(instances, predicate, found)
        out += _overhead(scene, support)
        out += _attached(scene, {a for a, _, _, _ in (*inside, *supported)})
        out = [replace(r, confidence=round(r.confidence * sure_of_up, 4)) for r in out]
    out += _beside(scene, support, gravity_known)
    return sorted(out, key=lambda r: (r.subject, r.predicate, r.object))


def _both(instances: Sequence[InstanceGeometry], predicate: str, found: Found) -> list[Relation]:
    """Return a relation and its inverse."""
    a, b, confidence, margin = found
    x, y = instances[a].id, instances[b].id
    c, m = round(min(max(confidence, 0.0), 1.0), 4), round(margin, 5)
    return [Relation(x, predicate, y, c, m), Relation(y, INVERSE[predicate], x, c, m)]


# ---------------------------------------------------------------------------------------------- above, below, under


def _overhead(scene: RelationScene, support: set[tuple[int, int]]) -> list[Relation]:
    """above and below for instances apart in height, under for what stands beneath a surface of another."""
    s, unit = scene.s, scene.unit
    out: list[Relation] = []
    low, high = scene.low, scene.high
    meet = np.all(low[:, None, :2] <= high[None, :, :2], axis=2)
    pairs = meet & meet.T & np.isfinite(scene.box_gap) & (high[:, None, 2] > high[None, :, 2])
    pairs &= (low[:, None, 2] - high[None, :, 2] <= s.above_m * unit) & scene.in_room[:, None] & scene.in_room[None]
    noise = s.noise_m * unit
    for a, b in np.argwhere(pairs).tolist():
        found = None if (a, b) in support else scene.measure("over", a, b, _over)
        if found is None:
            continue
        share, covered, gap = found
        if gap < 2.0 * noise or gap > s.above_m * unit:
            continue
        sure = certainty(gap - 2.0 * noise, noise) * min(1.0, 0.5 + share / 2)
        if covered >= s.overhead and low[a, 2] < high[b, 2]:
            upper, lower = scene.instances[a].id, scene.instances[b].id
            out.append(Relation(lower, "under", upper, round(sure, 4), round(gap, 5)))
        elif share >= s.overhead and low[a, 2] >= low[b, 2]:
            out += _both(scene.instances, "above", (a, b, sure, gap))
    return out


def _over(scene: RelationScene, a: int, b: int) -> tuple[float, float, float] | None:
    """Return how far a is over b: (share of the smaller footprint where it is, share of the lower one's points
    that it covers, clearance there), None where it is nowhere.
    """
    s, upper, lower = scene.s, scene.plan(a), scene.plan(b)
    reach = max(s.over_m * scene.unit, s.over_spacings * max(upper.spacing, lower.spacing))
    covered = float((neighbours_of(lower.points[:, :2], upper.tree)[0][:, 0] < reach).mean())
    back, under = neighbours_of(upper.points[:, :2], lower.tree)
    hit = back[:, 0] < reach
    if not hit.any():
        return None
    bottom = np.quantile(upper.points[hit, 2], s.trim)
    gap = float(bottom - np.quantile(lower.points[under[hit, 0], 2], 1.0 - s.trim))
    return max(covered, float(hit.mean())), covered, gap


# ---------------------------------------------------------------------------------------------- attached, beside


def _attached(scene: RelationScene, held: set[int]) -> list[Relation]:
    """Return instances that hang on a wall: touching it, standing on nothing."""
    limit = scene.s.attached_m * scene.unit
    out = []
    for a, instance in enumerate(scene.instances):
        if a in held or instance.structure is not None:
            continue
        touched = wall_touched(scene, a)
        if touched is not None:
            gap, b = touched
            c = round(certainty(limit - gap, scene.s.noise_m * scene.unit), 4)
            out.append(Relation(instance.id, "attached_to", scene.instances[b].id, c, round(limit - gap, 5)))
    return out


def _beside(scene: RelationScene, support: set[tuple[int, int]], gravity_known: bool) -> list[Relation]:
    """next_to and near, from the gap between surfaces relative to the sizes of the two."""
    s, unit = scene.s, scene.unit
    noise = s.noise_m * unit
    mean = 0.5 * (scene.size[:, None] + scene.size[None])
    close = np.clip(0.5 * mean, s.next_to_m[0] * unit, s.next_to_m[1] * unit)
    reach = np.maximum(np.clip(0.5 * mean, s.near_m[0] * unit, s.near_m[1] * unit), close)
    in_reach = scene.box_gap <= reach + _SLACK_M * unit
    pairs = np.triu(scene.in_room[:, None] & scene.in_room[None] & in_reach, 1)
    out: list[Relation] = []
    for a, b in np.argwhere(pairs).tolist():
        if (a, b) in support:
            continue
        gap, near, beside = scene.gap(a, b), float(reach[a, b]), float(close[a, b])
        for predicate, bound in (("near", near), ("next_to", beside)):
            confidence = certainty(bound - gap, noise)
            if confidence < s.sure:
                break
            if predicate == "near" or not gravity_known or _side_by_side(scene, a, b):
                out += _both(scene.instances, predicate, (a, b, confidence, bound - gap))
    return out


def _side_by_side(scene: RelationScene, a: int, b: int) -> bool:
    """Return whether two instances share a good part of their heights, and neither is a rug."""
    if scene.covering[a] or scene.covering[b]:
        return False
    low = max(scene.foot[a], scene.foot[b])
    high = min(scene.high[a, 2], scene.high[b, 2])
    shorter = min(scene.high[a, 2] - scene.foot[a], scene.high[b, 2] - scene.foot[b])
    return bool(high - low >= scene.s.side_by_side * shorter - scene.s.noise_m * scene.unit)
