"""Ground truth of a world, in the terms of a scene graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import OrientedBox, quat_wxyz_from_rotation
from list3r.simulation.worlds.gaps import surface_gap
from list3r.simulation.worlds.objects import SimulatedObject
from list3r.simulation.worlds.world import SimulatedWorld

NEXT_TO_M = (0.1, 0.4)
"""Objects are next to each other up to half the mean of their longest edges, within these bounds, metres."""
NEAR_M = (0.15, 0.4)
"""The same for objects that are near each other, in any direction."""
SHARED_HEIGHT = 0.3
"""Least share of the shorter one's height that two objects side by side have in common."""


def world_truth(world: SimulatedWorld, seen: dict[int, dict[str, int]] | None = None) -> dict[str, Any]:
    """Return the content of `truth.json`: frame, instances with boxes, relations.

    `seen` maps the id of an object to counts of the walk: frames in which it shows, and its largest area in pixels.
    """
    return {
        "format": "list3r-simulated-truth",
        "version": 1,
        "seed": world.seed,
        "frame": {"up": [0, 0, 1], "units": "m", "metric": "metric", "gravity": "known"},
        "instances": [_instance(t, (seen or {}).get(t.id, {})) for t in world.objects],
        "relations": [{"subject": s, "predicate": p, "object": o} for s, p, o in true_relations(world)],
    }


def _instance(obj: SimulatedObject, seen: dict[str, int]) -> dict[str, Any]:
    box = obj.box()
    return {
        "id": obj.id,
        "label": obj.label,
        "structure": obj.structure is not None,
        "round": obj.is_round(),
        "box": {
            "center": rounded(box.center),
            "size": rounded(box.size),
            "quat_wxyz": rounded(quat_wxyz_from_rotation(box.rotation)),
        },
        "support": obj.support,
        "container": obj.container,
        "attached": obj.attached,
        "frames_seen": seen.get("frames", 0),
        "largest_px": seen.get("largest_px", 0),
    }


def true_relations(world: SimulatedWorld) -> list[tuple[int, str, int]]:
    """Triples (subject, predicate, object): `on`, `in`, `attached_to` by construction, `near` and `next_to` both ways.

    `near` is the gap between surfaces against the size of the two, among pairs where neither contains the other;
    `next_to` the same for pairs at shared heights. Rugs are next to nothing: objects that touch them are on them.
    """
    triples: list[tuple[int, str, int]] = []
    for obj in world.objects:
        if obj.container is not None:
            triples.append((obj.id, "in", obj.container))
        elif obj.support is not None:
            triples.append((obj.id, "on", obj.support))
        if obj.attached is not None:
            triples.append((obj.id, "attached_to", obj.attached))
    objects = [t for t in world.objects if t.structure is None]
    for k, a in enumerate(objects):
        for b in objects[:k]:
            for predicate in _close(a, b):
                triples += [(a.id, predicate, b.id), (b.id, predicate, a.id)]
    return sorted(triples)


def _close(a: SimulatedObject, b: SimulatedObject) -> list[str]:
    """Return which of near and next_to two objects are."""
    if a.id in (b.support, b.container) or b.id in (a.support, a.container):
        return []
    one, two = a.box(), b.box()
    half = 0.25 * float(one.size.max() + two.size.max())
    near, next_to = float(np.clip(half, *NEAR_M)), float(np.clip(half, *NEXT_TO_M))
    if footprint_gap(one, two) > near or (gap := surface_gap(a, b)) > near:
        return []
    rug = "rug" in (a.label, b.label)
    return ["near", "next_to"] if gap <= next_to and not rug and _share_heights(one, two) else ["near"]


def _share_heights(one: OrientedBox, two: OrientedBox) -> bool:
    shared = min(one.center[2] + one.size[2] / 2, two.center[2] + two.size[2] / 2)
    shared -= max(one.center[2] - one.size[2] / 2, two.center[2] - two.size[2] / 2)
    return bool(shared >= SHARED_HEIGHT * min(one.size[2], two.size[2]))


def footprint_gap(a: OrientedBox, b: OrientedBox) -> float:
    """Distance between the footprints of two upright boxes, metres, 0 where they overlap.

    The longest separation along the sides' normals of either box, which is exact unless corner faces corner.
    """
    corners = [box.corners()[::2, :2] for box in (a, b)]
    gaps = [0.0]
    for axis in [box.rotation[:2, k] for box in (a, b) for k in (0, 1)]:
        p, q = corners[0] @ axis, corners[1] @ axis
        gaps.append(float(max(q.min() - p.max(), p.min() - q.max())))
    return max(gaps)


def rounded(values: NDArray[np.float64]) -> list[float]:
    """Return values to six decimals, without negative zero."""
    return [round(float(v), 6) + 0.0 for v in values]
