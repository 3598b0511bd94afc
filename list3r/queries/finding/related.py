"""Judge the relations of a phrase: which instances stand to others as it says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from list3r.memory.core.description.printable import shown_between
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.finding.free_words import WordEncoder
from list3r.queries.finding.grammar import Clause
from list3r.queries.relations import VERTICAL, Place, noise_of, relations, unit_of, viewer_from
from list3r.queries.views.camera import camera_of_frame
from list3r.queries.views.gather import Gathered
from list3r.queries.views.surfaces import distance_between
from list3r.queries.views.viewpoint import VIEWPOINT, Viewpoint, between

_BY_STRUCTURE_M = 0.4
"""Largest distance from a wall at which something is near it, metres: the memory stores `near` for things only."""
_MOST_OBJECTS = 40
"""Instances that others may be left of, or between: at most this many are considered."""
_FAR = 1000.0
"""Metres from which things are seen as on a plan."""
_ON_PLAN = "far away, as on a plan with x to the right"
_FADES = 0.1
"""Per metre: of two things to the left of another the nearer one is meant."""
_FURTHER = ("near", "in", "on")
_UNSURE = 0.8
"""Share of the score of what a word also means: "next to" near, "on the shelf" in it."""
_COMPARED: dict[str, Callable[[Instance, Instance], bool]] = {
    "larger": lambda a, b: float(np.max(a.box.size)) > float(np.max(b.box.size)),
    "smaller": lambda a, b: float(np.max(a.box.size)) < float(np.max(b.box.size)),
    "higher": lambda a, b: float(a.center[2]) > float(b.center[2]),
    "lower": lambda a, b: float(a.center[2]) < float(b.center[2]),
}
_Pair = tuple[int, str, float, str]
"""Subject, predicate, confidence, and where it is seen from or how far away it is, in words."""


@dataclass(frozen=True)
class PhraseMatch:
    instance: Instance
    score: float
    reasons: tuple[str, ...] = ()


@dataclass
class PhraseSearch:
    """State of one question."""

    store: Store
    things: dict[int, Instance]
    vocabulary: dict[int, dict[str, float]]
    encoder: WordEncoder | None
    viewpoint: Place | None
    gathered: Gathered | None
    """What of a large memory is in `things`; None where it is everything."""
    notes: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    mentioned: dict[int, float] = field(default_factory=dict)
    """Instances that any part of the question names, with how well."""
    undecided: bool = False
    """Whether the memory cannot know a relation that was asked for."""
    by_look: bool = False
    """Whether words that nothing bears were compared with how things look."""


def related(
    search: PhraseSearch,
    found: list[PhraseMatch],
    clause: Clause,
    ends: tuple[list[PhraseMatch], ...],
    text: str,
    *,
    silent: bool = False,
) -> list[PhraseMatch]:
    """Return those of `found` that stand in a clause's relation to its ends: the objects and, of `between`, the others.

    `text` is the phrase that `found` match, for notes, of which there are none where `silent`.
    """
    objects, others = (_few(search, end, clause) for end in ends)
    if clause.predicates == ("between",):
        others = others if clause.other else objects
        out = _between(search, found, objects, others)
    else:
        out = _standing(search, found, objects, clause.predicates)
    if not out and not silent and objects and (others or not clause.other):
        what = clause.object.text + (f" and {clause.other.text}" if clause.other else "")
        search.notes.append(f"{len(found)} instances match {text!r}, but none is known to be {clause.wording} {what!r}")
    return out


def _few(search: PhraseSearch, objects: list[PhraseMatch], clause: Clause) -> list[PhraseMatch]:
    """Return no more than can be searched from each of them, the best first."""
    stored = not ({"between", *VIEWPOINT} & set(clause.predicates))
    if stored or len(objects) <= _MOST_OBJECTS:
        return objects
    search.notes.append(
        f"{len(objects)} instances match the phrase after {clause.wording!r}; the best {_MOST_OBJECTS} were considered"
    )
    return sorted(objects, key=lambda c: (-c.score, -c.instance.confidence, c.instance.id))[:_MOST_OBJECTS]


def _standing(
    search: PhraseSearch, found: list[PhraseMatch], objects: list[PhraseMatch], predicates: Sequence[str]
) -> list[PhraseMatch]:
    subjects = {c.instance.id: c for c in found}
    best: dict[int, PhraseMatch] = {}
    if set(predicates) <= set(_COMPARED):
        pairs = {o.instance.id: _compared(found, o.instance, predicates) for o in objects}
    elif set(predicates) & set(VIEWPOINT):
        pairs = {c.instance.id: _seen_pairs(search, subjects, c.instance, predicates) for c in objects}
    else:
        pairs = _stored_pairs(search, subjects, objects, predicates)
    for object in objects:
        for subject, predicate, confidence, via in pairs[object.instance.id]:
            c = subjects[subject]
            further = predicate in _FURTHER and predicate != predicates[0]
            score = c.score * confidence * (0.5 + 0.5 * object.score) * (_UNSURE if further else 1.0)
            if subject not in best or score > best[subject].score:
                o = object.instance
                name = shown_between(o.label or o.description, ";")
                why = f"{predicate.replace('_', ' ')} #{o.id} {name} ({confidence:.2f}{via})"
                inner = tuple(r for r in object.reasons if not r.startswith(("named", "#")))
                best[subject] = PhraseMatch(c.instance, score, (*c.reasons, why, *inner))
    return [best[n] for n in sorted(best)]


def _stored_pairs(
    search: PhraseSearch,
    subjects: dict[int, PhraseMatch],
    objects: list[PhraseMatch],
    predicates: Sequence[str],
) -> dict[int, list[_Pair]]:
    """Return by object which subjects stand so to it, by the relations of the memory, in few questions to the store."""
    out: dict[int, list[_Pair]] = {c.instance.id: [] for c in objects}
    from_objects = len(objects) <= len(subjects)
    rows = search.store.relations.among(out if from_objects else subjects, predicates, as_object=from_objects)
    order = {p: n for n, p in enumerate(predicates)}
    for r in sorted(rows, key=lambda r: (r.object, order[r.predicate], -r.confidence, r.subject)):
        if r.subject in subjects and r.object in out and r.subject != r.object:
            out[r.object].append((r.subject, r.predicate, r.confidence, ""))
    for predicate in (p for p in predicates if objects and p in VERTICAL):
        held = relations(search.store, None, predicate, objects[0].instance.id)
        if held.state == "unknown":
            search.notes.append(f"{predicate.replace('_', ' ')}: unknown, {held.reason}")
            search.undecided = True
    for c in objects if "near" in predicates else []:
        if c.instance.structure is not None:
            out[c.instance.id] += _near_structure(search, subjects, c.instance)
    return out


def _compared(found: list[PhraseMatch], o: Instance, predicates: Sequence[str]) -> list[_Pair]:
    return [
        (c.instance.id, f"{p} than", 1.0, "")
        for c in found
        for p in predicates
        if c.instance.id != o.id and _COMPARED[p](c.instance, o)
    ]


def _seen_pairs(
    search: PhraseSearch, subjects: dict[int, PhraseMatch], o: Instance, predicates: Sequence[str]
) -> list[_Pair]:
    """Return which subjects stand so to one object, as seen from the viewpoint; what is farther away is less sure."""
    out: list[_Pair] = []
    place, unit = viewpoint_of(search, o), unit_of(search.store)
    for predicate in predicates:
        held = relations(search.store, None, predicate, o.id, viewpoint=place)
        if held.state == "unknown":
            search.notes.append(f"{predicate.replace('_', ' ')}: unknown, {held.reason}")
        via = f", {_seen_from(search, held.reason.split(';')[0])}"
        for r in (r for r in held if r.subject in subjects and r.subject != o.id):
            away = float(np.linalg.norm(search.things[r.subject].center - o.center)) / unit
            out.append((r.subject, r.predicate, r.confidence / (1.0 + _FADES * away), via))
    return out


def _near_structure(search: PhraseSearch, subjects: dict[int, PhraseMatch], o: Instance) -> list[_Pair]:
    """Return things near a wall, by the distance of surfaces: the memory keeps `near` of things only."""
    limit = _BY_STRUCTURE_M * unit_of(search.store)
    near = set(search.store.instances.ids_in_box(o.aabb[0] - limit, o.aabb[1] + limit))
    out = []
    for n, c in subjects.items():
        if n in near and n != o.id and c.instance.component == o.component:
            gap = distance_between(search.store, c.instance, o)
            if gap <= limit:
                out.append((n, "near", 1.0 - 0.5 * gap / limit, f", {gap:.2f} away"))
    return out


def viewpoint_of(search: PhraseSearch, o: Instance) -> Place:
    """Return the viewpoint of left and right: as asked, else the picture in which a thing is seen best, else as on a
    plan: far away on the side of small y."""
    if search.viewpoint is not None:
        return search.viewpoint
    if o.best_view is not None:
        try:
            return camera_of_frame(search.store, o.best_view.frame_index, o.best_view.session_id)
        except OptionError:
            pass
    search.notes.append(f"no viewpoint was given: left and right are as seen from {_ON_PLAN}; --from names another")
    x, y, z = o.center.tolist()
    return (x, y - _FAR * unit_of(search.store), z)


def viewer_of(search: PhraseSearch, o: Instance) -> Viewpoint | None:
    """Return who looks from the viewpoint; None, with a note, where up is not known."""
    viewer = viewer_from(search.store, viewpoint_of(search, o))
    if viewer is None:
        search.notes.append("gravity is unknown in this memory, so left and right are unknown too")
        return None
    return replace(viewer, name=_seen_from(search, viewer.name))


def _seen_from(search: PhraseSearch, reason: str) -> str:
    """Name the assumed viewpoint by what it is."""
    if search.viewpoint is not None or "the point" not in reason:
        return reason
    return reason[: reason.index("the point")] + _ON_PLAN


def _between(
    search: PhraseSearch, found: list[PhraseMatch], ones: list[PhraseMatch], others: list[PhraseMatch]
) -> list[PhraseMatch]:
    """Return those that stand between one of the ones and one of the others, each with its best pair."""
    noise = noise_of(search.store)
    best: dict[int, PhraseMatch] = {}
    pairs = ((a, b) for a in ones for b in others if a.instance.id != b.instance.id)
    for a, b in pairs:
        ends = a.instance.id, b.instance.id
        box = np.stack([a.instance.aabb, b.instance.aabb])
        near = set(search.store.instances.ids_in_box(box[:, 0].min(axis=0), box[:, 1].max(axis=0))) - set(ends)
        for c in (c for c in found if c.instance.id in near):
            r = between(c.instance, a.instance, b.instance, noise)
            score = 0.0 if r is None else c.score * r.confidence * (0.5 + 0.25 * (a.score + b.score))
            if r is not None and (c.instance.id not in best or score > best[c.instance.id].score):
                why = f"between #{ends[0]} and #{ends[1]} ({r.confidence:.2f})"
                best[c.instance.id] = PhraseMatch(c.instance, score, (*c.reasons, why))
    return [best[n] for n in sorted(best)]
