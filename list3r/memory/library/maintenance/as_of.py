"""The memory as it was after an earlier session, for every question.

A connection of its own to the same file, in which temporary tables and views stand before those of the file: nothing
is written, what sessions saw later is not there, and what they moved is where it was. Sizes and words are those of
today. Relations among what has not changed since are those of the file; the others are found again.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from list3r.memory.core.geometry import Array
from list3r.memory.core.records import Instance, Relation
from list3r.memory.library.maintenance.history import world_at
from list3r.memory.library.maintenance.temporary_views import put_before, store_shown
from list3r.memory.library.relations import predicates
from list3r.memory.library.relations.instance_geometry import InstanceGeometry
from list3r.memory.library.rules import settings_of
from list3r.memory.library.world.gravity import sure_of_up
from list3r.memory.store.store import Store

_BY_SESSION = ("sessions", "chunks", "frames", "events")
_BY_CHUNK = ("keyframes", "local_instances", "supports", "placements", "bends", "votes")
_REACH_M = 2.0
"""How far from what has changed relations may have been others."""


def store_at(store: Store, session_id: int) -> Store:
    """Return a store to read, as it was after a session; close it like any other. Raises `OptionError` for no such
    session.
    """
    return store_shown(store.path, partial(_take_in, session_id=session_id))


def _take_in(past: Store, *, session_id: int) -> None:
    """Show the file as it is now, as far as it was known after a session."""
    then, now = world_at(past, session_id), {i.id: i for i in past.instances.all()}
    known = past.relations.all()
    vertical = past.facts.gravity != "unknown"
    _show(past, session_id, then)
    changed = {i.id for i in then if _has_changed(i, now.get(i.id))}
    relations = [*_kept(known, then, changed), *_found_anew(past, then, changed, vertical)]
    with past.connection.temporary():
        past.relations.replace(None, relations)


def _show(past: Store, session_id: int, instances: Sequence[Instance]) -> None:
    """Let a store read only what was known after a session, from now on."""
    put_before(past, instances, "relations")
    last = int(session_id)
    chunks = f"(SELECT chunk_id FROM main.chunks WHERE session_id <= {last})"
    ids = "(SELECT id FROM temp.instances)"
    views = {t: f"session_id <= {last}" for t in _BY_SESSION} | {t: f"chunk_id IN {chunks}" for t in _BY_CHUNK}
    views["edges"] = f"u IN {chunks} AND v IN {chunks}"
    views["observations"] = f"chunk_id IN {chunks} AND instance IN {ids}"
    views |= dict.fromkeys(("rooms", "room_instances", "doorways"), "0")  # outlines are those of today alone
    views["embeddings"] = views["detected_labels"] = f"instance IN {ids}"
    with past.connection.temporary():
        for table, condition in views.items():
            past.connection.execute(f"CREATE TEMP VIEW {table} AS SELECT * FROM main.{table} WHERE {condition}")


def _has_changed(then: Instance, now: Instance | None) -> bool:
    gone = now is not None and (now.state == "removed") != (then.state == "removed")
    return now is None or gone or not np.array_equal(then.center, now.center)


def _kept(known: Sequence[Relation], then: Sequence[Instance], changed: set[int]) -> list[Relation]:
    """Return relations among what was there then and has not changed since."""
    same = {i.id for i in then} - changed
    return [r for r in known if r.subject in same and r.object in same]


def _found_anew(past: Store, then: Sequence[Instance], changed: set[int], vertical: bool) -> list[Relation]:
    """Return relations of what has changed since."""
    out: list[Relation] = []
    first = min((c.component for c in past.chunks.all()), default=0)
    for component in sorted({i.component for i in then if i.id in changed}):
        here = [i for i in then if i.component == component and i.state != "removed" and not i.dynamic]
        moved = [i for i in here if i.id in changed]
        near = [i for i in here if any(_gap(i.aabb, m.aabb) <= _REACH_M for m in moved)]
        middle = np.mean([i.center for i in here], axis=0) if here else np.zeros(3)
        instances = [b for i in near if (b := _body(past, i, middle)) is not None]
        settings = settings_of(past, None).relations
        upright = vertical and component == first
        sure = sure_of_up(past)
        found = (
            predicates.relations(instances, gravity_known=upright, settings=settings, sure_of_up=sure) if moved else []
        )
        out += [r for r in found if r.subject in changed or r.object in changed]
    return out


def _gap(a: Array, b: Array) -> float:
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(a[0] - b[1], b[0] - a[1]))))


def _body(past: Store, instance: Instance, middle: Array) -> InstanceGeometry | None:
    """Return an instance as relations see it, from the surface that was known then."""
    points = past.surfaces.points(instance.id).astype(np.float64)
    slack = 1e-3 * float(np.linalg.norm(instance.aabb[1] - instance.aabb[0]))
    points = points[np.all((points >= instance.aabb[0] - slack) & (points <= instance.aabb[1] + slack), axis=1)]
    if len(points) == 0:
        return None
    points = points[:: max(1, len(points) // 2000)]
    normal = None
    if instance.structure is not None and len(points) > 3:
        axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
        normal = axis if (middle - points.mean(axis=0)) @ axis > 0 else -axis
    return InstanceGeometry(
        id=instance.id,
        points=points,
        rgb=np.zeros((len(points), 3), np.uint8),
        box=instance.box,
        aabb=instance.aabb,
        normal=normal,
        structure=instance.structure,
        component=instance.component,
        confidence=instance.confidence,
    )
