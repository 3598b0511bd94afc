"""Relations of a memory: stored ones, and those that hold from a viewpoint or between two instances."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from list3r.memory.core.errors import OptionError, check_choice, check_share
from list3r.memory.core.records import Instance, Relation
from list3r.memory.library.relations.predicates import INVERSE, PREDICATES
from list3r.memory.library.relations.settings import RelationSettings
from list3r.memory.library.world.world import WORLD
from list3r.memory.store.store import Store
from list3r.queries.answers import Rows
from list3r.queries.finding.words import is_named, no_such_words, same_kind, wanted_words
from list3r.queries.match import checked_instance, checked_point
from list3r.queries.views.camera import PosedCamera, camera_of_frame, last_camera
from list3r.queries.views.gather import is_large, sample
from list3r.queries.views.viewpoint import VIEWPOINT, BetweenRelation, Viewpoint, between, viewed

VERTICAL = frozenset(("on", "supports", "in", "contains", "above", "below", "under", "attached_to"))
"""Predicates that exist only where gravity is known or estimated."""
ALL_PREDICATES = (*(p for p in PREDICATES if p != "between"), *VIEWPOINT, "between")

_MOST_NAMED = 20_000
"""Instances that words may mean."""

Place = int | str | Sequence[float] | PosedCamera
"""Where to look from: an instance's id, "camera" (where it was last), "camera:FRAME", a point x, y, z, or a camera."""


class Relations(Rows[Relation]):
    """A list of relations with what can be said of the question as a whole."""

    def __init__(self, found: Iterable[Relation] = (), state: str = "known", reason: str = "") -> None:
        super().__init__(found)
        self.state = state
        """known, or unknown: then nothing in the list means that it is not known, not that it is not so."""
        self.reason = reason
        """Why it is unknown, or what was left out; empty where there is nothing to say."""


def relations(
    store: Store,
    subject: int | str | None = None,
    predicate: str | None = None,
    object: int | str | None = None,
    min_confidence: float = 0.0,
    *,
    viewpoint: Place | None = None,
    other: int | str | None = None,
) -> Relations:
    """Return the relations that match what is given, the surest first. Subject and object are ids, aliases, or words.

    With a `viewpoint` the four of `viewpoint.VIEWPOINT` are answered as well (or alone, if one is the predicate); if
    neither subject nor object is given, of things that the memory calls near each other. `between` needs `object` and
    `other`. In the answer `state` is unknown where the question cannot be answered: a vertical predicate, or the view
    from a point or a thing, without gravity. Raises `OptionError` for a predicate that does not exist or arguments that
    do not fit, `UnknownIdError` for an id that was never given.
    """
    if predicate is not None:
        check_choice("predicate", predicate, ALL_PREDICATES)
    check_share("min_confidence", min_confidence)
    if predicate in VIEWPOINT and viewpoint is None:
        raise OptionError(f"{predicate} depends on the viewpoint: name one (--from ID, camera, camera:FRAME or x,y,z)")
    if viewpoint is not None and predicate is not None and predicate not in VIEWPOINT:
        raise OptionError(f"{predicate} does not depend on the viewpoint; leave it out")
    if (predicate == "between") != (other is not None):
        raise OptionError("between, and only between, takes two instances: object and other (--object A --and B)")
    notes: list[str] = []
    subjects, objects = _ids(store, subject, notes), _ids(store, object, notes)
    if predicate == "between":
        found = _between(store, subjects, objects, _ids(store, other, notes))
    elif viewpoint is None:
        found = _stored(store, subjects, predicate, objects)
    else:
        found = _viewed(store, subjects, predicate, objects, viewpoint)
        if predicate is None:
            found += _stored(store, subjects, None, objects)
    kept = sorted(
        (r for r in found if r.confidence >= min_confidence),
        key=lambda r: (-r.confidence, r.subject, r.predicate, r.object),
    )
    if store.facts.gravity == "assumed" and any(r.predicate in VERTICAL for r in kept):
        deviation = store.facts.gravity_deviation_deg or 0.0
        notes.append(f"up is assumed by how the camera was held, give or take {deviation:.0f} degrees")
    return Relations(kept, found.state, "; ".join([*([found.reason] if found.reason else []), *notes]))


def relations_of(store: Store, instance_id: int) -> list[Relation]:
    """Return the stored relations of an instance, each once: of two inverse ones that in which it is the subject."""
    own = store.relations.all(instance_id, None, None)
    stored = {(r.predicate, r.object) for r in own}
    others = store.relations.all(None, None, instance_id)
    return [*own, *(r for r in others if (INVERSE.get(r.predicate), r.subject) not in stored)]


def viewer_from(store: Store, viewpoint: Place) -> Viewpoint | None:
    """Return who looks from a place, see `Place`; None where up is not known. Raises `OptionError` and
    `UnknownIdError`."""
    upright = store.facts.gravity != "unknown"
    up = np.array([0.0, 0.0, 1.0])
    where = _parse_place(store, viewpoint) if isinstance(viewpoint, str) else viewpoint
    if isinstance(where, PosedCamera):
        name = "the camera" if where.frame is None else f"frame {where.frame.frame_index}"
        return Viewpoint(where.place, up if upright else where.up, name, None, where.component)
    if isinstance(where, int | np.integer):
        i = checked_instance(store, int(where))
        return Viewpoint(i.center, up, f"#{i.id}", i.id, i.component) if upright else None
    place = checked_point(where, "viewpoint")
    return Viewpoint(place, up, "the point " + ", ".join(f"{x:g}" for x in place)) if upright else None


def _parse_place(store: Store, text: str) -> int | PosedCamera | list[float]:
    if text == "camera":
        return last_camera(store)
    if match := re.fullmatch(r"camera:([0-9]{1,18})", text):
        return camera_of_frame(store, int(match[1]))
    if re.fullmatch(r"#?[0-9]{1,30}", text):
        return int(text.removeprefix("#"))
    try:
        return [float(x) for x in text.split(",")]
    except ValueError:
        raise OptionError(f"viewpoint {text!r}: an id, camera, camera:FRAME, or a point such as 0,0,1.5") from None


def _ids(store: Store, what: int | str | None, notes: list[str]) -> list[int] | None:
    """Return the ids that a number or words mean; None for whatever."""
    if what is None:
        return None
    if isinstance(what, str) and not re.fullmatch(r"#?[0-9]{1,30}", what):
        wanted = set(wanted_words(what))
        if is_large(store):
            found = store.words.bearing(sorted(wanted), _MOST_NAMED + 1)[0].tolist()
            found = found or store.words.bearing(sorted(map(same_kind, wanted)), _MOST_NAMED + 1)[0].tolist()
            if len(found) > _MOST_NAMED:
                notes.append(f"more than {_MOST_NAMED} instances match {what!r}; {_MOST_NAMED} of them were considered")
            found = sorted(found[:_MOST_NAMED])
        else:
            found = [i.id for i in store.instances.all() if is_named(i, what)]
        if not found and (unknown := sorted(wanted - store.words.known(wanted))):
            notes.append(no_such_words(unknown, sample(store)))
        return found
    return [checked_instance(store, int(what.removeprefix("#")) if isinstance(what, str) else what).id]


def _stored(store: Store, subjects: list[int] | None, predicate: str | None, objects: list[int] | None) -> Relations:
    if subjects is not None and len(subjects) == 1:
        found = [r for s in subjects for r in store.relations.all(s, predicate, None)]
    elif objects is not None:
        found = [r for o in objects for r in store.relations.all(None, predicate, o)]
    else:
        found = store.relations.all(None, predicate, None)
    allowed = None if subjects is None else set(subjects), None if objects is None else set(objects)
    found = [
        r
        for r in found
        if (allowed[0] is None or r.subject in allowed[0]) and (allowed[1] is None or r.object in allowed[1])
    ]
    if store.facts.gravity == "unknown":
        why = "gravity is unknown in this memory, so on, in, above and under are unknown too"
        if predicate in VERTICAL and not found:
            return Relations([], "unknown", why)
        if predicate is None:
            return Relations(found, "known", why)
    return Relations(found)


def _viewed(
    store: Store, subjects: list[int] | None, predicate: str | None, objects: list[int] | None, viewpoint: Place
) -> Relations:
    viewer = viewer_from(store, viewpoint)
    if viewer is None:
        return Relations(
            [],
            "unknown",
            "gravity is unknown in this memory, so left and right are unknown too; use a camera as the viewpoint",
        )
    things = {i.id: i for i in store.instances.all()}
    if subjects is None and objects is None:
        pairs = sorted({(r.subject, r.object) for p in ("near", "next_to") for r in store.relations.all(None, p, None)})
    else:
        everything = [i.id for i in things.values() if i.structure is None]
        pairs = (
            [(s, o) for s in subjects or everything for o in objects or everything]
            if [] not in (subjects, objects)
            else []
        )
    out, untold = [], 0
    noise = noise_of(store)
    for s, o in pairs:
        if s == o or viewer.instance_id in (s, o) or s not in things or o not in things:
            continue
        found = viewed(viewer, things[s], things[o], noise)
        untold += found is None
        out += [r for r in found or [] if predicate in (None, r.predicate)]
    reason = f"as seen from {viewer.name}"
    if untold:
        reason += f"; {untold} pairs cannot be judged from there"
    return Relations(out, "unknown" if untold and not out else "known", reason)


def _between(store: Store, subjects: list[int] | None, ones: list[int] | None, others: list[int] | None) -> Relations:
    if ones is None or others is None:
        raise OptionError("between takes two instances: give both object and other (--object A --and B)")
    noise = noise_of(store)
    things = {i.id: i for i in store.instances.all()}
    asked = [i for i in things.values() if (i.structure is None if subjects is None else i.id in set(subjects))]
    found = [
        r
        for a in ones
        for b in others
        if a != b
        for i in _near_line(store, things[a], things[b], asked)
        if (r := between(i, things[a], things[b], noise)) is not None
    ]
    apart = [(a, b) for a in ones for b in others if things[a].component != things[b].component]
    if apart and not found:
        return Relations([], "unknown", "the two are in different connected components")
    unique: dict[tuple[int, frozenset[int]], BetweenRelation] = {}
    for r in found:
        unique.setdefault((r.subject, frozenset((r.object, r.other))), r)
    return Relations(unique.values())


def _near_line(store: Store, a: Instance, b: Instance, asked: list[Instance]) -> list[Instance]:
    near = store.instances.ids_in_box(np.minimum(a.aabb[0], b.aabb[0]), np.maximum(a.aabb[1], b.aabb[1]))
    return [i for i in asked if i.id in {*near} - {a.id, b.id}]


def noise_of(store: Store) -> float:
    """Return the standard deviation of a position: the one of the stored relations, in world units."""
    return RelationSettings().noise_m * unit_of(store)


def unit_of(store: Store) -> float:
    """Return what a metre is in world units: 1 if the memory is metric, else as stored relations were derived with."""
    if store.facts.scale_kind != "relative":
        return 1.0
    world = store.facts[WORLD]
    return 1.0 if world is None else world.unit
