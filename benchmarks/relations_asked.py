"""Relations derived on demand, against the truth: by viewpoint, and between two objects.

The truth applies the definitions of `list3r/queries/viewpoint.py` to the true boxes and the true camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from list3r.memory.core.records import Instance, Relation
from list3r.memory.store.store import Store
from list3r.queries.relations import noise_of, viewer_from
from list3r.queries.views.viewpoint import Viewpoint, between, viewed
from list3r.simulation.dataset import WalkSettings
from list3r.simulation.worlds.objects import SimulatedObject

EVERY = 30
"""Frames from one asked viewpoint to the next."""
APART_M = 1.5
"""Between is not asked for objects with centres further apart."""
Counts = dict[str, int]


def asked(store: Store, settings: WalkSettings, truth_of: Mapping[int, int], near: set[tuple[int, int]]) -> Counts:
    """Counts of true, claimed and right answers. `near` holds the pairs of true ids that viewpoints are asked of."""
    objects = {t.id: t for t in settings.world().objects}
    found = {truth_of[i.id]: i for i in store.instances.all() if truth_of.get(i.id) in objects and i.structure is None}
    found = {k: i for k, i in found.items() if objects[k].structure is None}
    true = {k: _true(i, objects[k]) for k, i in found.items()}
    out = _from_viewpoints(store, settings, found, true, near)
    return out | _between(found, true, noise_of(store))


def _from_viewpoints(
    store: Store,
    settings: WalkSettings,
    found: Mapping[int, Instance],
    true: Mapping[int, Instance],
    near: set[tuple[int, int]],
) -> Counts:
    poses = settings.poses()[1]
    posed = {f.frame_index for f in store.frames.all() if f.state == "posed"}
    pairs = [(a, b) for a, b in combinations(sorted(found), 2) if (a, b) in near]
    want: set[tuple[object, ...]] = set()
    said: set[tuple[object, ...]] = set()
    for k in sorted(posed & set(range(0, len(poses), EVERY))):
        here = viewer_from(store, f"camera:{k}")
        there = Viewpoint(poses[k][:3, 3], np.array([0.0, 0.0, 1.0]), "truth")
        assert here is not None
        for a, b in pairs:
            answer = viewed(there, true[a], true[b], 0.0)
            if answer is None:
                continue
            want |= {(k, a, b, r.predicate) for r in answer}
            said |= {(k, a, b, r.predicate) for r in viewed(here, found[a], found[b], noise_of(store)) or []}
    return _counts("viewpoint", want, said)


def _between(found: Mapping[int, Instance], true: Mapping[int, Instance], noise: float) -> Counts:
    want: set[tuple[object, ...]] = set()
    said: set[tuple[object, ...]] = set()
    for a, b in combinations(sorted(found), 2):
        if np.linalg.norm(true[a].center - true[b].center) > APART_M:
            continue
        for c in found.keys() - {a, b}:
            want |= _named((c, a, b), [between(true[c], true[a], true[b], noise)])
            said |= _named((c, a, b), [between(found[c], found[a], found[b], noise)])
    return _counts("between", want, said)


def _named(key: tuple[int, ...], answers: Iterable[Relation | None]) -> set[tuple[object, ...]]:
    return {key for answer in answers if answer is not None}


def _counts(name: str, want: set[tuple[object, ...]], said: set[tuple[object, ...]]) -> Counts:
    return {f"{name}_true": len(want), f"{name}_claimed": len(said), f"{name}_correct": len(want & said)}


def _true(instance: Instance, obj: SimulatedObject) -> Instance:
    box = obj.box()
    corners = box.corners()
    low_high = np.stack([corners.min(axis=0), corners.max(axis=0)])
    return replace(instance, id=obj.id, center=box.center, box=box, aabb=low_high, position_sigma_m=None)
