"""What of the instances is structure, and how they stand to each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Relation
from list3r.memory.library.grouping import Group, chunks_of
from list3r.memory.library.instances import DerivedInstance
from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.relations.predicates import relations
from list3r.memory.library.relations.scene import PairMeasures
from list3r.memory.library.relations.structure import classify_structure, flagged_only, is_level
from list3r.memory.library.scene import Scene
from list3r.memory.library.world.floor import floor_near

_SLACK_M = 0.05
_REACH_M = 0.85
"""Beyond it nothing stands on, in or beside an instance; above one, see `RelationSettings.above_m`."""
_RINGS = 3
"""Whether two instances are related is decided by what holds them, and by what holds that."""
_TOGETHER, _PLACE_M = 256, 8.0
"""Most instances whose relations are found at once, and the edge of the places by which those are chosen."""


class Neighbourhood:
    """The instances by where they are."""

    def __init__(self, instances: Iterable[InstanceGeometry]) -> None:
        self.of = {b.id: b for b in instances}
        """By id."""
        self._ids = np.array([*self.of], np.int64)
        self._boxes = np.array([b.aabb for b in self.of.values()]).reshape(-1, 2, 3)

    def near(self, box: Array, reach: Array) -> list[InstanceGeometry]:
        """Return the instances whose boxes come within `reach` of a box, along each axis."""
        meet = (self._boxes[:, 0] <= box[1] + reach) & (self._boxes[:, 1] >= box[0] - reach)
        return [self.of[n] for n in self._ids[meet.all(axis=1)].tolist()]


def with_structure(
    scene: Scene, instances: Mapping[int, DerivedInstance], members: Mapping[int, Group]
) -> dict[int, DerivedInstance]:
    """Return the instances with what of them is floor, wall, ceiling and the like told; by what stands near each."""
    around = Neighbourhood(i.geometry for i in instances.values() if not i.dynamic)
    out = {}
    for n, found in instances.items():
        kind = None if found.dynamic else _kind(scene, found.geometry, around, members[n])
        out[n] = replace(found, geometry=replace(found.geometry, structure=kind))
    return out


def _kind(scene: Scene, geometry: InstanceGeometry, around: Neighbourhood, members: Group) -> str | None:
    world, s = scene.world, scene.settings.structure
    if not world.stands(geometry.component) or geometry.normal is None:
        return flagged_only([geometry])[0]
    reach = np.full(3, (s.near_m + _SLACK_M) * world.unit)
    still = [b for b in around.near(geometry.aabb, reach) if b.component == geometry.component]
    cameras = scene.cameras_of(chunks_of([members]))
    eyes = float(np.quantile(cameras[:, 2], s.eye_level)) if len(cameras) else np.inf
    floor = None
    if world.floor_seen and is_level(geometry, s):
        low = replace(scene.settings.gravity, floor_low_cameras=s.low_cameras)
        floor = floor_near(still, cameras, world.unit, low)
    return classify_structure([geometry], floor, lambda _: eyes, world.unit, s, still)[0]


def relate(scene: Scene, instances: Iterable[DerivedInstance]) -> list[Relation]:
    """Return the relations of instances that are there and stand still, in order.

    A table of all pairs takes memory by the square of the instances, so many are looked at place by place, each among
    what is near.
    """
    unit, s = scene.world.unit, scene.settings.relations
    known = Neighbourhood(sorted((i.geometry for i in instances if i.resting), key=lambda b: b.id))
    order = sorted(known.of.values(), key=lambda b: (*np.floor(b.aabb.mean(axis=0) / (_PLACE_M * unit)), b.id))
    reach = (np.array([_REACH_M, _REACH_M, max(_REACH_M, s.above_m)]) + _SLACK_M) * unit
    out, measured = dict[tuple[int, str, int], Relation](), PairMeasures()
    for first in range(0, len(order), _TOGETHER):
        subjects = {b.id for b in order[first : first + _TOGETHER]}
        there = _within_rings(known, subjects, reach)
        for component in sorted({b.component for b in there}):
            inside = [b for b in there if b.component == component]
            vertical = scene.world.stands(component)
            sure = scene.world.sure_of_up
            found = relations(inside, gravity_known=vertical, unit=unit, settings=s, measured=measured, sure_of_up=sure)
            told = (r for r in found if r.subject in subjects or r.object in subjects)
            out |= {(r.subject, r.predicate, r.object): r for r in told}
    return [out[key] for key in sorted(out)]


def _within_rings(known: Neighbourhood, subjects: set[int], reach: Array) -> list[InstanceGeometry]:
    """Return some instances, what is near them, what is near that, and so on, in order."""
    scene, ring = set(subjects), set(subjects)
    for _ in range(_RINGS):
        holding = (known.of[n] for n in ring if n in subjects or known.of[n].structure is None)
        ring = {b.id for a in holding for b in known.near(a.aabb, reach)} - scene
        scene |= ring
    return [known.of[n] for n in sorted(scene)]
