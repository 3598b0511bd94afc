"""Find instances by a phrase: attributes, a noun and relations to other instances; see `grammar`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from list3r.memory.description.words import vocabulary
from list3r.memory.errors import OptionError
from list3r.memory.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.free_words import WordEncoder, like, named_by_vectors
from list3r.queries.grammar import SIZES, SUPERLATIVES, Clause, Phrase, parse
from list3r.queries.match import Match, Matches, checked_count, checked_instance
from list3r.queries.relations import VERTICAL, Place, noise_of, relations, unit_of, viewer_from
from list3r.queries.views.camera import camera_of_frame
from list3r.queries.views.gather import Gathered, gather
from list3r.queries.views.surfaces import distance_between
from list3r.queries.views.viewpoint import VIEWPOINT, between
from list3r.queries.words import STRUCTURE, not_borne

_BY_STRUCTURE_M = 0.4
"""Largest distance from a wall at which something is near it, metres: the memory stores `near` for things only."""
_MOST_OBJECTS = 40
"""Instances that others may be left of, or between: at most so many are considered."""
_EQUAL = 0.02
"""Difference of two scores below which two answers are equally good."""
_ALIKE = 0.1
"""Sizes that differ by less than this share are equally the biggest."""


class Found(Matches):
    """Ranked answers; `notes` name words without a match, unknown relations, and how many answers are equal."""

    def __init__(
        self, matches: Iterable[Match] = (), notes: Sequence[str] = (), unknown_words: Sequence[str] = ()
    ) -> None:
        super().__init__(matches, notes)
        self.unknown_words = tuple(dict.fromkeys(unknown_words))
        """Words that no instance of the memory has."""

    @property
    def ambiguous(self) -> bool:
        """Whether the second answer is as good as the first."""
        return len(self) > 1 and self[0].score - self[1].score < _EQUAL


_Pair = tuple[int, str, float, str]
"""Subject, predicate, confidence, and where it is seen from, in words."""


@dataclass(frozen=True)
class _Candidate:
    instance: Instance
    score: float
    reasons: tuple[str, ...] = ()


@dataclass
class _Search:
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


def find(
    store: Store, text: str, k: int = 5, *, viewpoint: Place | None = None, encoder: WordEncoder | None = None
) -> Found:
    """Find the instances that a text describes, the best first: "white mug on table", "chair next to 12".

    Every word must occur in the label, kind of structure, description or colour; small and large are relative to the
    other instances of the kind; every relation must hold. Without a match the answer is empty, never a guess: its
    `notes` name the words that no instance has and the relations that the memory cannot know. Left, right, front and
    behind are judged from `viewpoint` (see `relations.Place`), otherwise in the picture that shows the other instance
    best. With an `encoder` of a space that the memory holds, phrases with words that no instance has are compared by
    their vectors. The score is how well the words match times how sure the relations are. Raises `OptionError` for a
    text without sense and `UnknownIdError` for a number that was never an id.
    """
    k = checked_count(k)
    phrase = parse(text)
    if viewpoint is not None:
        viewer_from(store, viewpoint)
    gathered = gather(store, phrase)
    loaded = store.instances() if gathered is None else store.instances_of(sorted(gathered.ids))
    things = {i.id: i for i in loaded if i.state != "removed"}
    search = _Search(store, things, {n: _vocabulary(i) for n, i in things.items()}, encoder, viewpoint, gathered)
    search.notes += [] if gathered is None else gathered.notes
    found = sorted(_meaning(search, phrase), key=lambda c: (-c.score, -c.instance.confidence, c.instance.id))
    matches = [
        Match(c.instance, round(c.score, 4), None, None, "; ".join(c.reasons) or "any instance") for c in found[:k]
    ]
    out = Found(matches, search.notes, search.unknown)
    if out.ambiguous and len(found) > 1:
        equal = sum(c.score > found[0].score - _EQUAL for c in found)
        out.notes = (*out.notes, f"{equal} instances match equally well; add words to tell them apart")
    return out


# ---------------------------------------------------------------------------------------------- phrases


def _meaning(search: _Search, phrase: Phrase) -> list[_Candidate]:
    """Return what a phrase may mean: words, then relations, then size among what is left."""
    if phrase.instance_id is not None:
        i = checked_instance(search.store, phrase.instance_id)
        found = [_Candidate(i, 1.0, (f"#{i.id}",))]
        if not _bears(search, i.id, phrase.words):
            search.notes.append(f"#{i.id} is not named {' '.join(phrase.words)}")
            found = []
    else:
        found = _named(search, phrase)
    if phrase.size is not None:
        found = _sized(search, found, phrase)
    for clause in phrase.where:
        if not found:
            # The rest is searched all the same, so that all words without a match are named.
            _meaning(search, clause.object)
            if clause.other:
                _meaning(search, clause.other)
            continue
        found = _related(search, found, clause, phrase.text)
    if phrase.superlative is not None and found:
        found = _extreme(found, phrase.superlative)
    return found


def _vocabulary(i: Instance) -> dict[str, float]:
    """Return words that an instance bears, with how well each names it."""
    return vocabulary(i.label, i.structure, i.description, i.color_name)


def _named(search: _Search, phrase: Phrase) -> list[_Candidate]:
    unknown = _unknown(search, phrase.words)
    if unknown:
        by_vector = _by_vector(search, phrase)
        if by_vector is not None:
            return by_vector
        search.unknown += unknown
        named = search.things.values() if search.gathered is None else search.store.instances_of(search.gathered.sample)
        search.notes.append(not_borne(unknown, named))
        return []
    structure = not STRUCTURE.isdisjoint(phrase.words) or bool(
        phrase.words
        and not any(_bears(search, n, phrase.words) for n, i in search.things.items() if i.structure is None)
    )
    out = []
    for n, i in search.things.items():
        if (i.structure is None or structure) and _bears(search, n, phrase.words):
            score = float(np.mean([search.vocabulary[n][w] for w in phrase.words])) if phrase.words else 1.0
            reasons = (f"named {' '.join(phrase.words)}",) if phrase.words else ()
            out.append(_Candidate(i, score, reasons))
    if not out and len(phrase.words) > 1:
        search.notes.append("no instance matches all of the words " + ", ".join(repr(w) for w in phrase.words))
    return out


def _unknown(search: _Search, words: Sequence[str]) -> list[str]:
    """Return words that nothing bears."""
    if search.gathered is not None:
        known = search.store.known_words(words)
        return [w for w in words if w not in known]
    return [w for w in words if not any(w in v for v in search.vocabulary.values())]


def _bears(search: _Search, n: int, words: Sequence[str]) -> bool:
    return all(w in search.vocabulary[n] for w in words)


def _by_vector(search: _Search, phrase: Phrase) -> list[_Candidate] | None:
    """Return instances by the likeness of their vectors to the phrase; None where no vectors of the encoder's space are
    there."""
    if search.encoder is None:
        return None
    text = " ".join(phrase.words)
    try:
        cosine = named_by_vectors(search.store, search.encoder, text)
    except OptionError as error:  # the memory has come to a machine without the model's weights
        search.notes.append(f"free words cannot be compared: {error}")
        return None
    if cosine is None:
        return None
    if search.gathered is not None:
        _look_at_too(search, list(cosine))
    return [
        _Candidate(search.things[n], c, (like(text, c, search.encoder.space),))
        for n, c in cosine.items()
        if n in search.things and search.things[n].structure is None
    ]


def _look_at_too(search: _Search, ids: Sequence[int]) -> None:
    fresh = search.store.instances_of([n for n in ids if n not in search.things])
    for i in (i for i in fresh if i.state != "removed"):
        search.things[i.id], search.vocabulary[i.id] = i, _vocabulary(i)


# ---------------------------------------------------------------------------------------------- sizes


def _sized(search: _Search, found: list[_Candidate], phrase: Phrase) -> list[_Candidate]:
    """Return those of a size, relative to the others that fit the words, or to all things where those are fewer than
    four."""
    size = phrase.size
    assert size is not None
    edges = np.array([]) if search.gathered is None else search.gathered.sizes_of(search.store, phrase.words)
    if len(edges) == 0:
        among = [c.instance for c in found]
        if len(among) < 4:
            among = [i for i in search.things.values() if i.structure is None] or among
        edges = np.sort([_edge(i) for i in among])
    low, high = SIZES[size]
    out = []
    for c in found:
        rank = float(np.mean(edges < _edge(c.instance)) + 0.5 * np.mean(edges == _edge(c.instance)))
        said = search.vocabulary[c.instance.id].get(size, 0.0)
        fit = 1.0 - rank if high <= 0.5 else rank if low >= 0.5 else 1.0 - 2.0 * abs(rank - 0.5)
        if said > 0.0 or low <= rank <= high:
            score = max(said, 0.5 + 0.5 * fit)
            why = f"{size}: longest edge {_edge(c.instance):.2f}, {1.0 - rank:.0%} of the others are larger"
            out.append(_Candidate(c.instance, c.score * score, (*c.reasons, why)))
    return out


def _extreme(found: list[_Candidate], superlative: str) -> list[_Candidate]:
    """Return the largest or smallest, and what is practically as large."""
    kind = SUPERLATIVES[superlative]
    sizes = [_edge(c.instance) if abs(kind) == 1 else float(np.ptp(c.instance.aabb[:, 2])) for c in found]
    best = max(sizes) if kind > 0 else min(sizes)
    out = []
    for c, size in zip(found, sizes, strict=True):
        share = min(size, best) / max(size, best, 1e-12)
        if share >= 1.0 - _ALIKE:
            what = "longest edge" if abs(kind) == 1 else "height"
            out.append(_Candidate(c.instance, c.score * share, (*c.reasons, f"{superlative}: {what} {size:.2f}")))
    return out


def _edge(i: Instance) -> float:
    return float(np.max(i.box.size))


# ---------------------------------------------------------------------------------------------- relations


def _related(search: _Search, found: list[_Candidate], clause: Clause, text: str) -> list[_Candidate]:
    """Return those that stand in the relation to something that the clause's phrase means."""
    objects = _few(search, _meaning(search, clause.object), clause)
    others = _few(search, _meaning(search, clause.other), clause) if clause.other else []
    if clause.other:
        out = _between(search, found, objects, others)
    else:
        out = _standing(search, found, objects, clause.predicates)
    if not out and objects and (others or not clause.other):
        ends = clause.object.text + (f" and {clause.other.text}" if clause.other else "")
        search.notes.append(f"of {len(found)} instances that match {text!r} none is known to be {clause.said} {ends!r}")
    return out


def _few(search: _Search, objects: list[_Candidate], clause: Clause) -> list[_Candidate]:
    """Return no more than can be searched from each of them, the best first."""
    stored = not ({"between", *VIEWPOINT} & set(clause.predicates))
    if stored or len(objects) <= _MOST_OBJECTS:
        return objects
    search.notes.append(
        f"{len(objects)} instances match the phrase after {clause.said!r}; the best {_MOST_OBJECTS} were considered"
    )
    return sorted(objects, key=lambda c: (-c.score, -c.instance.confidence, c.instance.id))[:_MOST_OBJECTS]


def _standing(
    search: _Search, found: list[_Candidate], objects: list[_Candidate], predicates: Sequence[str]
) -> list[_Candidate]:
    subjects = {c.instance.id: c for c in found}
    best: dict[int, _Candidate] = {}
    together = _pairs_of_many(search, subjects, objects, predicates) if len(objects) > _MOST_OBJECTS else None
    for object in objects:
        pairs = _pairs(search, subjects, object, predicates) if together is None else together[object.instance.id]
        for subject, predicate, confidence, whence in pairs:
            c = subjects[subject]
            score = c.score * confidence * (0.5 + 0.5 * object.score)
            if subject not in best or score > best[subject].score:
                o = object.instance
                why = f"{predicate.replace('_', ' ')} #{o.id} {o.label or o.description} ({confidence:.2f}{whence})"
                inner = tuple(r for r in object.reasons if not r.startswith(("named", "#")))
                best[subject] = _Candidate(c.instance, score, (*c.reasons, why, *inner))
    return [best[n] for n in sorted(best)]


def _pairs_of_many(
    search: _Search, subjects: dict[int, _Candidate], objects: list[_Candidate], predicates: Sequence[str]
) -> dict[int, list[_Pair]] | None:
    """`_pairs` of many objects, in few questions to the store; None for relations that are not stored."""
    if set(predicates) & set(VIEWPOINT):
        return None
    out: dict[int, list[_Pair]] = {c.instance.id: [] for c in objects}
    from_objects = len(objects) <= len(subjects)
    rows = search.store.related(out if from_objects else subjects, predicates, as_object=from_objects)
    order = {p: n for n, p in enumerate(predicates)}
    for s, p, o, sure in sorted(rows, key=lambda r: (r[2], order[r[1]], -r[3], r[0])):
        if s in subjects and o in out and s != o:
            out[o].append((s, p, sure, ""))
    for predicate in predicates:
        held = relations(search.store, None, predicate, objects[0].instance.id)
        if held.state == "unknown" and predicate in VERTICAL:
            search.notes.append(f"{predicate.replace('_', ' ')}: unknown, {held.reason}")
    for c in objects if "near" in predicates else []:
        if c.instance.structure is not None:
            near = _near_structure(search, subjects, c.instance)
            out[c.instance.id] += [p for p in near if p[0] != c.instance.id]
    return out


def _pairs(
    search: _Search, subjects: dict[int, _Candidate], object: _Candidate, predicates: Sequence[str]
) -> list[_Pair]:
    """Return (subject, predicate, confidence, where it is seen from) of the subjects that stand so to one object."""
    o = object.instance
    out: list[tuple[int, str, float, str]] = []
    for predicate in predicates:
        place = _viewpoint(search, o) if predicate in VIEWPOINT else None
        if predicate in VIEWPOINT and place is None:
            search.notes.append(f"{predicate.replace('_', ' ')} depends on the viewpoint; name one")
            continue
        held = relations(search.store, None, predicate, o.id, viewpoint=place)
        if held.state == "unknown" and (predicate in VIEWPOINT or predicate in VERTICAL):
            search.notes.append(f"{predicate.replace('_', ' ')}: unknown, {held.reason}")
        whence = f", {held.reason.split(';')[0]}" if place is not None else ""
        out += [(r.subject, r.predicate, r.confidence, whence) for r in held if r.subject in subjects]
    if "near" in predicates and (o.structure is not None):
        out += _near_structure(search, subjects, o)
    return [p for p in out if p[0] != o.id]


def _near_structure(search: _Search, subjects: dict[int, _Candidate], o: Instance) -> list[tuple[int, str, float, str]]:
    """Return things near a wall, by the distance of surfaces: the memory keeps `near` of things only."""
    limit = _BY_STRUCTURE_M * unit_of(search.store)
    near = set(search.store.ids_in_box(o.aabb[0] - limit, o.aabb[1] + limit))
    out = []
    for n, c in subjects.items():
        if n in near and n != o.id and c.instance.component == o.component:
            gap = distance_between(search.store, c.instance, o)
            if gap <= limit:
                out.append((n, "near", 1.0 - 0.5 * gap / limit, f", {gap:.2f} away"))
    return out


def _viewpoint(search: _Search, o: Instance) -> Place | None:
    """Return from where left and right are told: as asked, else the picture in which the other thing is seen best."""
    if search.viewpoint is not None:
        return search.viewpoint
    if o.best_view is None:
        return None
    try:
        return camera_of_frame(search.store, o.best_view.frame_index, o.best_view.session_id)
    except OptionError:
        return None


def _between(
    search: _Search, found: list[_Candidate], ones: list[_Candidate], others: list[_Candidate]
) -> list[_Candidate]:
    """Return those that stand between one of the ones and one of the others, each with its best pair."""
    noise = noise_of(search.store)
    best: dict[int, _Candidate] = {}
    pairs = ((a, b) for a in ones for b in others if a.instance.id != b.instance.id)
    for a, b in pairs:
        ends = a.instance.id, b.instance.id
        box = np.stack([a.instance.aabb, b.instance.aabb])
        near = set(search.store.ids_in_box(box[:, 0].min(axis=0), box[:, 1].max(axis=0))) - set(ends)
        for c in (c for c in found if c.instance.id in near):
            r = between(c.instance, a.instance, b.instance, noise)
            score = 0.0 if r is None else c.score * r.confidence * (0.5 + 0.25 * (a.score + b.score))
            if r is not None and (c.instance.id not in best or score > best[c.instance.id].score):
                why = f"between #{ends[0]} and #{ends[1]} ({r.confidence:.2f})"
                best[c.instance.id] = _Candidate(c.instance, score, (*c.reasons, why))
    return [best[n] for n in sorted(best)]
