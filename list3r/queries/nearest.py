"""Find what is nearest to a point or to an instance, and what words name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.errors import OptionError
from list3r.memory.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.find import meant
from list3r.queries.finding.free_words import WordEncoder, like, named_by_vectors
from list3r.queries.finding.grammar import parse
from list3r.queries.finding.words import STRUCTURE, not_borne, wanted_words, word_score
from list3r.queries.match import (
    FilterOptions,
    Filters,
    Match,
    Matches,
    checked_count,
    checked_instance,
    checked_length,
    checked_point,
)
from list3r.queries.views.best_first import NearestSearch, box_gaps, nearest_first
from list3r.queries.views.gather import is_large, sample
from list3r.queries.views.surfaces import STRAY, distance_between, distance_to_point, surface_of

_LOADED = 5_000
"""Instances that are looked at because of what they are called, in a memory that holds many."""
_NAMED = 100_000
"""Instances that may bear one word, at the most."""


def nearest(
    store: Store,
    *,
    point: ArrayLike | None = None,
    instance_id: int | None = None,
    words: str | None = None,
    k: int = 5,
    max_distance: float | None = None,
    encoder: WordEncoder | None = None,
    **options: Unpack[FilterOptions],
) -> Matches:
    """Find the k instances nearest to a `point` (world) or to an instance, by the distance between surfaces.

    With `words` only things whose label or description bears one of them; with words alone those that they name best,
    then the surest, without distances. The words must all be found where any thing bears them all. Words that say more
    than names (a relation, a size, an id: "small mug on the table") mean what they mean to `find`. Words that name a
    kind of structure ("floor", "wall") ask for structure too. Words that nothing bears are compared by the vectors of
    an `encoder` whose space the memory holds. `max_distance` bounds the distance between
    surfaces. What moves is taken where it was last seen; near an instance only what shares its component answers. For
    the filters see `Filters`. Raises `OptionError` for arguments that make no sense and `UnknownIdError` for an id that
    was never given.
    """
    k = checked_count(k)
    if point is not None and instance_id is not None:
        raise OptionError("give a point or an instance to be near to, not both")
    if point is None and instance_id is None and words is None:
        raise OptionError("give what to be near to: a point, an instance, or words")
    if max_distance is not None:
        if point is None and instance_id is None:
            raise OptionError("a largest distance needs a point or an instance to measure from")
        max_distance = checked_length(max_distance, "max_distance")
    options["structure"] = options.get("structure", False) or _names_structure(words)
    filters = Filters(**options)
    origin = None if instance_id is None else checked_instance(store, instance_id)
    place = None if point is None else checked_point(point, "point")
    if words is None:
        near = _near(store, origin, place, k, max_distance, filters)
        return Matches(_match(i, distance, "", origin, place) for distance, i in near)
    if is_large(store) and (origin is not None or place is not None) and _only_common(store, words):
        filters = replace(filters, label=" ".join([*([filters.label] if filters.label else []), words]))
        near = _near(store, origin, place, k, max_distance, filters)
        return Matches(_match(i, distance, f"named {words}", origin, place) for distance, i in near)
    notes: list[str] = []
    named = _called(store, words, origin, filters, encoder, notes)
    if origin is None and place is None:
        ranked = sorted(named, key=lambda n: (-n[1], -n[0].confidence, n[0].id))
        best = (Match(i, round(score, 4), None, None, reason) for i, score, reason in ranked[:k])
        return Matches(best, notes, len(ranked))
    bearing = [i for i, _, _ in named if origin is None or (i.id != origin.id and i.component == origin.component)]
    reasons = {i.id: reason for i, _, reason in named}
    found = _by_distance(bearing, _measure(store, origin, place), _aabb(origin, place), k, max_distance)
    return Matches((_match(i, distance, reasons[i.id], origin, place) for distance, i in found), notes)


def _called(
    store: Store,
    words: str,
    origin: Instance | None,
    filters: Filters,
    encoder: WordEncoder | None,
    notes: list[str],
) -> list[tuple[Instance, float, str]]:
    """Return what the words say, with how well and why: a phrase as `find` reads it, else things that bear them."""
    if _says_more_than_names(words):
        found, search = meant(store, parse(words), encoder=encoder)
        notes += search.notes
        return [(c.instance, c.score, "; ".join(c.reasons)) for c in found if filters.passes(c.instance)]
    others = [i for i in _bearers(store, words, filters, notes) if origin is None or i.id != origin.id]
    named = _named(others, words)
    if not named and encoder is not None:
        named = _alike(store, encoder, words, filters, notes)
    if not named and (unknown := [w for w in wanted_words(words) if w not in store.words.known([w])]):
        notes.append(not_borne(unknown, sample(store)))
    return named


def _says_more_than_names(words: str) -> bool:
    try:
        phrase = parse(words)
    except OptionError:  # such as "mug on": a name that ends in a relation
        return False
    return bool(phrase.where or phrase.size or phrase.superlative or phrase.instance_id is not None)


def _only_common(store: Store, words: str) -> bool:
    """Tell whether the words only name, and so many bear them that it is better to look around than at all of them."""
    if _says_more_than_names(words):
        return False
    return len(store.words.bearing(wanted_words(words), _LOADED + 1)) > _LOADED


def _bearers(store: Store, words: str, filters: Filters, notes: list[str]) -> list[Instance]:
    """Return what passes the filters: all; of a large memory those that bear the most of the words."""
    if not is_large(store):
        return filters.select(store.instances.all())
    parts = (
        (ids, start)
        for ids in store.words.bearing_most(wanted_words(words), _NAMED + 1)
        for start in range(0, len(ids), _LOADED)
    )
    for ids, start in parts:
        found = filters.select(store.instances.of(ids[start : start + _LOADED]))
        if not _named(found, words):
            continue
        if len(ids) > start + _LOADED:
            count = f"more than {_NAMED}" if len(ids) > _NAMED else f"{len(ids)}"
            notes.append(f"{count} instances match {words!r}; {start + _LOADED} of them were considered")
        return found
    return []


def _alike(
    store: Store, encoder: WordEncoder, words: str, filters: Filters, notes: list[str]
) -> list[tuple[Instance, float, str]]:
    """Return things whose vectors fit words that nothing bears."""
    try:
        cosine = named_by_vectors(store, encoder, words) or {}
    except OptionError as error:  # the memory has come to a machine without the model's weights
        notes.append(f"free words cannot be compared: {error}")
        return []
    alike = filters.select(store.instances.of(list(cosine)))
    return [(i, round(cosine[i.id], 4), like(words, cosine[i.id], encoder.space)) for i in alike]


def _near(
    store: Store,
    origin: Instance | None,
    place: NDArray[np.float64] | None,
    k: int,
    limit: float | None,
    filters: Filters,
) -> list[tuple[float, Instance]]:
    """Find the k nearest of all through the R*Tree."""
    search = NearestSearch(
        k,
        _measure(store, origin, place),
        filters,
        leave_out=None if origin is None else origin.id,
        component=filters.component if origin is None else origin.component,
        limit=limit,
        touch=0.0 if origin is None else surface_of(store, origin).spacing,
    )
    return nearest_first(store, _aabb(origin, place), search)


def _named(candidates: Sequence[Instance], words: str) -> list[tuple[Instance, float, str]]:
    """Return those that bear the words: all of them where some thing does, else as many as any thing does."""
    wanted = wanted_words(words)
    found = [(i, *word_score(i, wanted)) for i in candidates]
    most = max((len(hit) for _, _, hit in found), default=0)
    return [(i, score, _named_so(hit, wanted)) for i, score, hit in found if hit and len(hit) == most]


def _named_so(hit: Sequence[str], wanted: Sequence[str]) -> str:
    missing = [w for w in wanted if w not in hit]
    return f"named {' '.join(hit)}" + (f", not {' '.join(missing)}" if missing else "")


def _names_structure(words: str | None) -> bool:
    return words is not None and not STRUCTURE.isdisjoint(wanted_words(words))


def _by_distance(
    candidates: Sequence[Instance],
    measure: Callable[[Instance], float],
    aabb: NDArray[np.float64],
    k: int,
    limit: float | None,
) -> list[tuple[float, Instance]]:
    """Return the k nearest of some. Boxes bound the distance from below: only what can still win is measured."""
    if not candidates:
        return []
    gaps = box_gaps(np.array([i.aabb for i in candidates]), aabb)
    gaps -= STRAY * np.array([np.max(i.box.size) for i in candidates])
    found: list[tuple[float, int, Instance]] = []
    for n in np.argsort(gaps, kind="stable"):
        if len(found) >= k and gaps[n] > found[k - 1][0] + 1e-9:
            break
        distance = measure(candidates[n])
        if limit is None or distance <= limit:
            found = sorted([*found, (distance, candidates[n].id, candidates[n])], key=lambda f: f[:2])[:k]
    return [(distance, i) for distance, _, i in found]


def _aabb(origin: Instance | None, place: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the box of what is asked about. Shape (2, 3)."""
    if origin is not None:
        return origin.aabb
    assert place is not None
    return np.stack([place, place])


def _measure(store: Store, origin: Instance | None, place: NDArray[np.float64] | None) -> Callable[[Instance], float]:
    """Return the function that tells how far the surface of an instance is."""
    if origin is not None:
        known = origin
        return lambda i: distance_between(store, i, known)
    assert place is not None
    point = place
    return lambda i: distance_to_point(store, i, point)


def _match(
    i: Instance, surface: float, named: str, origin: Instance | None, place: NDArray[np.float64] | None
) -> Match:
    """Return an answer, with its distance in words."""
    if origin is not None:
        offset, whence = i.center - origin.center, f"from #{origin.id}"
    else:
        assert place is not None
        offset, whence = i.center - place, "from the point"
    center = math.sqrt(offset.dot(offset))
    reason = f"surface {surface:.2f}, centre {center:.2f} {whence}" + (f", {named}" if named else "")
    return Match(i, round(1.0 / (1.0 + surface), 4), surface, center, reason)
