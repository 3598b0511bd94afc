"""Judge the relations of a phrase: which instances stand to others as it says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from list3r.memory.description.printable import shown_between
from list3r.memory.errors import OptionError
from list3r.memory.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.finding.free_words import WordEncoder
from list3r.queries.finding.grammar import Clause
from list3r.queries.relations import VERTICAL, Place, noise_of, relations, unit_of
from list3r.queries.views.camera import camera_of_frame
from list3r.queries.views.gather import Gathered
from list3r.queries.views.surfaces import distance_between
from list3r.queries.views.viewpoint import VIEWPOINT, between

_BY_STRUCTURE_M = 0.4
"""Largest distance from a wall at which something is near it, metres: the memory stores `near` for things only."""
_MOST_OBJECTS = 40
"""Instances that others may be left of, or between: at most this many are considered."""
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


def related(
    search: PhraseSearch,
    found: list[PhraseMatch],
    clause: Clause,
    ends: tuple[list[PhraseMatch], ...],
    text: str,
) -> list[PhraseMatch]:
    """Return those of `found` that stand in a clause's relation to its ends: the objects and, of `between`, the others.

    `text` is the phrase that `found` match, for notes.
    """
    objects, others = (_few(search, end, clause) for end in ends)
    if clause.other:
        out = _between(search, found, objects, others)
    else:
        out = _standing(search, found, objects, clause.predicates)
    if not out and objects and (others or not clause.other):
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
    if set(predicates) & set(VIEWPOINT):
        pairs = {c.instance.id: _seen_pairs(search, subjects, c.instance, predicates) for c in objects}
    else:
        pairs = _stored_pairs(search, subjects, objects, predicates)
    for object in objects:
        for subject, predicate, confidence, via in pairs[object.instance.id]:
            c = subjects[subject]
            score = c.score * confidence * (0.5 + 0.5 * object.score)
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
    for c in objects if "near" in predicates else []:
        if c.instance.structure is not None:
            out[c.instance.id] += _near_structure(search, subjects, c.instance)
    return out


def _seen_pairs(
    search: PhraseSearch, subjects: dict[int, PhraseMatch], o: Instance, predicates: Sequence[str]
) -> list[_Pair]:
    """Return which subjects stand so to one object, as seen from the viewpoint."""
    out: list[_Pair] = []
    place = _viewpoint(search, o)
    for predicate in predicates:
        if place is None:
            search.notes.append(f"{predicate.replace('_', ' ')} depends on the viewpoint; name one")
            continue
        held = relations(search.store, None, predicate, o.id, viewpoint=place)
        if held.state == "unknown":
            search.notes.append(f"{predicate.replace('_', ' ')}: unknown, {held.reason}")
        via = f", {held.reason.split(';')[0]}"
        out += [
            (r.subject, r.predicate, r.confidence, via) for r in held if r.subject in subjects and r.subject != o.id
        ]
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


def _viewpoint(search: PhraseSearch, o: Instance) -> Place | None:
    """Return the viewpoint of left and right: as asked, else the picture in which the other thing is seen best."""
    if search.viewpoint is not None:
        return search.viewpoint
    if o.best_view is None:
        return None
    try:
        return camera_of_frame(search.store, o.best_view.frame_index, o.best_view.session_id)
    except OptionError:
        return None


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
