"""Changes of a world between two walks: objects are moved, removed and added."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from list3r.memory.core.errors import OptionError
from list3r.simulation.worlds.layout import SMALL_KINDS, Placer
from list3r.simulation.worlds.objects import SimulatedObject
from list3r.simulation.worlds.truth import footprint_gap
from list3r.simulation.worlds.world import SimulatedWorld

_TOPS = ("table", "desk", "side table", "cabinet")


@dataclass(frozen=True)
class Change:
    """One change. Objects keep their ids; an added one gets an id that the world never had."""

    kind: str
    """moved, removed or added."""
    obj: int | None = None
    """Id of the object that is moved or removed."""
    target: int | None = None
    """Id of the table or the like that it is moved to or added on."""
    label: str = "mug"
    """Kind of an added object."""
    seed: int = 0
    """Seed of the place and appearance of an added object."""

    def __post_init__(self) -> None:
        if self.kind not in ("moved", "removed", "added"):
            raise OptionError(f"change {self.kind!r}: it must be moved, removed or added")
        if self.kind == "added" and self.label not in SMALL_KINDS:
            raise OptionError(f"cannot add {self.label!r}: one of {', '.join(SMALL_KINDS)}")


def random_changes(
    world: SimulatedWorld, seed: int, moved: int = 2, removed: int = 1, added: int = 1
) -> tuple[Change, ...]:
    """Changes to small objects on tables, drawn from a seed; no object is changed twice."""
    rng = np.random.default_rng([seed, 5])
    tops = [t.id for t in world.objects if t.label in _TOPS]
    filled = {t.container for t in world.objects if t.container is not None}
    small = [t for t in world.objects if t.support in tops and t.label in SMALL_KINDS and t.id not in filled]
    if moved + removed > len(small):
        raise OptionError(f"{moved + removed} changes asked for, but only {len(small)} small objects are on tables")
    chosen = [small[k] for k in rng.permutation(len(small))[: moved + removed]]
    numbers = iter(int(n) for n in rng.integers(1 << 30, size=moved + added))
    changes = [Change("removed", obj.id) for obj in chosen[moved:]]
    world = apply_changes(world, tuple(changes))
    wishes = [Change("moved", obj.id, seed=next(numbers)) for obj in chosen[:moved]]
    wishes += [
        Change("added", label=SMALL_KINDS[rng.integers(len(SMALL_KINDS))], seed=next(numbers)) for _ in range(added)
    ]
    for wish in wishes:
        came_from = None if wish.obj is None else world.object_of(wish.obj).support
        order = [tops[k] for k in rng.permutation(len(tops)) if tops[k] != came_from]
        change = _first_with_room(world, wish, order)
        world = apply_changes(world, (change,))
        changes.append(change)
    return tuple(changes)


def _first_with_room(world: SimulatedWorld, wish: Change, targets: list[int]) -> Change:
    for target in targets[:-1]:
        try:
            apply_changes(world, (replace(wish, target=target),))
        except OptionError:
            continue
        return replace(wish, target=target)
    return replace(wish, target=targets[-1])


def apply_changes(world: SimulatedWorld, changes: tuple[Change, ...]) -> SimulatedWorld:
    """The world after the changes. Raises `OptionError` for an unknown id or a target without room."""
    for change in changes:
        world = replace(world, objects=_changed(world, change))
    return world


def _changed(world: SimulatedWorld, change: Change) -> tuple[SimulatedObject, ...]:
    known = {t.id: t for t in world.objects}
    for object_id in (change.obj, change.target):
        if object_id is not None and object_id not in known:
            raise OptionError(f"no object {object_id} in the world: its ids go from 1 to {max(known)}")
    if change.kind == "added":
        parts, _ = Placer(np.random.default_rng([change.seed, 6])).small(change.label)
        new = SimulatedObject(max(known) + 1, change.label, parts, (0.0, 0.0, 0.0))
        return (*world.objects, _put(world, new, known[_asked(change.target, "target")], change.seed))
    obj = known[_asked(change.obj, "thing")]
    with_it = {obj.id} | {t.id for t in world.objects if obj.id in (t.support, t.container)}
    if change.kind == "removed":
        return tuple(t for t in world.objects if t.id not in with_it)
    placed = _put(world, obj, known[_asked(change.target, "target")], change.seed)
    shift = np.array(placed.position) - np.array(obj.position)
    out = []
    for t in world.objects:
        x, y, z = (float(v) for v in np.array(t.position) + shift)
        out.append(placed if t.id == obj.id else replace(t, position=(x, y, z)) if t.id in with_it else t)
    return tuple(out)


def _asked(object_id: int | None, name: str) -> int:
    if object_id is None:
        raise OptionError(f"this change needs the id of its {name}")
    return object_id


def _put(world: SimulatedWorld, obj: SimulatedObject, target: SimulatedObject, seed: int) -> SimulatedObject:
    """The object at a free place on top of the target."""
    rng = np.random.default_rng([seed, 7])
    box = target.box()
    top = float(box.center[2] + box.size[2] / 2)
    neighbours = [t.box() for t in world.objects if t.support == target.id and t.id != obj.id]
    for _ in range(1000):
        offset = target.rotation()[:2, :2] @ rng.uniform(-box.size[:2] / 2, box.size[:2] / 2)
        at = (target.position[0] + float(offset[0]), target.position[1] + float(offset[1]), top)
        placed = replace(obj, position=at, yaw=float(rng.uniform(0, 2 * np.pi)), support=target.id, container=None)
        corners = np.abs((placed.box().corners() - box.center) @ box.rotation)[:, :2]
        if np.all(corners < box.size[:2] / 2 - 0.01) and all(
            footprint_gap(placed.box(), other) > 0.03 for other in neighbours
        ):
            return placed
    raise OptionError(f"no room for {obj.label} {obj.id} on {target.label} {target.id}: choose another target")
