"""Find what is nearest to a point or to an instance, and what words name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Instance
from list3r.memory.store.store import Store
from list3r.queries.finding.words import STRUCTURE, wanted_words
from list3r.queries.match import (
    FilterOptions,
    Filters,
    Match,
    Matches,
    checked_count,
    checked_instance,
    checked_length,
    checked_point,
    of_one_state,
)
from list3r.queries.views.best_first import NearestSearch, box_gaps, nearest_first
from list3r.queries.views.surfaces import STRAY, distance_between, distance_to_point, surface_of

if TYPE_CHECKING:
    from list3r.queries.finding.free_words import WordEncoder


@of_one_state
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

    With `words` only instances that they mean to `find`; with words alone the best of these, then the surest, without
    distances. Words that name a kind of structure ("floor", "wall") ask for structure too. `max_distance` bounds the
    distance between surfaces. What moves is taken where it was last seen; near an instance only what shares its
    component answers. For the filters see `Filters`. Raises `OptionError` for arguments that make no sense and
    `UnknownIdError` for an id that was never given.
    """
    k = checked_count(k)
    if point is not None and instance_id is not None:
        raise OptionError("give either a point or an instance to be near to")
    if point is None and instance_id is None and words is None:
        raise OptionError("give what to be near to: a point, an instance, or words")
    if max_distance is not None:
        if point is None and instance_id is None:
            raise OptionError("a largest distance needs a point or an instance to measure from")
        max_distance = checked_length(max_distance, "max_distance")
    asked = None
    if instance_id is not None:
        asked = _Origin.of_instance(store, checked_instance(store, instance_id))
    elif point is not None:
        asked = _Origin.of_point(store, checked_point(point, "point"))
    if words is None and asked is not None:
        near = _near(store, asked, k, max_distance, Filters.of(store, options))
        return Matches(asked.match(i, distance) for distance, i in near)
    assert words is not None
    from list3r.queries.find import named_by, only_common

    options["structure"] = options.get("structure", False) or not STRUCTURE.isdisjoint(wanted_words(words))
    filters = Filters.of(store, options)
    if asked is not None and only_common(store, words):
        filters = replace(filters, label=" ".join([*([filters.label] if filters.label else []), words]))
        near = _near(store, asked, k, max_distance, filters)
        return Matches(asked.match(i, distance, f"named {words}") for distance, i in near)
    notes: list[str] = []
    named = named_by(store, words, filters, encoder, notes)
    if asked is None:
        ranked = sorted(named, key=lambda n: (-n[1], -n[0].confidence, n[0].id))
        best = (Match(i, round(score, 4), None, None, reason) for i, score, reason in ranked[:k])
        return Matches(best, notes, len(ranked))
    bearing = [i for i, _, _ in named if i.id != asked.id and asked.component in (None, i.component)]
    reasons = {i.id: reason for i, _, reason in named}
    found = _by_distance(bearing, asked, k, max_distance)
    return Matches((asked.match(i, distance, reasons[i.id]) for distance, i in found), notes)


@dataclass(frozen=True)
class _Origin:
    """What answers are near to."""

    place: NDArray[np.float64]
    """World. Shape (3,)."""
    aabb: NDArray[np.float64]
    """Shape (2, 3)."""
    name: str
    measure: Callable[[Instance], float]
    """Returns how far the surface of an instance is."""
    touch: float = 0.0
    """What is nearer than this touches it."""
    id: int | None = None
    component: int | None = None
    """The only connected component that answers."""

    @staticmethod
    def of_instance(store: Store, i: Instance) -> _Origin:
        """Return an instance as origin."""
        touch = surface_of(store, i).spacing
        return _Origin(i.center, i.aabb, f"#{i.id}", lambda o: distance_between(store, o, i), touch, i.id, i.component)

    @staticmethod
    def of_point(store: Store, place: NDArray[np.float64]) -> _Origin:
        """Return a point as origin."""
        return _Origin(place, np.array([place, place]), "the point", lambda o: distance_to_point(store, o, place))

    def match(self, i: Instance, surface: float, named: str = "") -> Match:
        """Return an answer, with its distance in words."""
        offset = i.center - self.place
        reason = f"from {self.name}" + (f", {named}" if named else "")
        return Match(i, round(1.0 / (1.0 + surface), 4), surface, math.sqrt(offset.dot(offset)), reason)


def _near(store: Store, o: _Origin, k: int, limit: float | None, filters: Filters) -> list[tuple[float, Instance]]:
    """Find the k nearest of all through the R*Tree."""
    component = filters.component if o.component is None else o.component
    search = NearestSearch(k, o.measure, filters, o.id, component, limit, o.touch)
    return nearest_first(store, o.aabb, search)


def _by_distance(
    candidates: Sequence[Instance], asked: _Origin, k: int, limit: float | None
) -> list[tuple[float, Instance]]:
    """Return the k nearest of some. Boxes bound the distance from below: only what can still win is measured."""
    if not candidates:
        return []
    gaps = box_gaps(np.array([i.aabb for i in candidates]), asked.aabb)
    gaps -= STRAY * np.array([np.max(i.box.size) for i in candidates])
    found: list[tuple[float, int, Instance]] = []
    for n in np.argsort(gaps, kind="stable"):
        if len(found) >= k and gaps[n] > found[k - 1][0] + 1e-9:
            break
        distance = asked.measure(candidates[n])
        if limit is None or distance <= limit:
            found = sorted([*found, (distance, candidates[n].id, candidates[n])], key=lambda f: f[:2])[:k]
    return [(distance, i) for distance, _, i in found]
