"""What is nearest to a point or to a thing, and what do words name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.errors import OptionError
from list3r.memory.records import Instance
from list3r.memory.store import Store
from list3r.queries.match import Filters, Match, checked_count, checked_length, checked_point
from list3r.queries.surfaces import distance_between, distance_to_point
from list3r.queries.words import STRUCTURE, wanted_words, word_score


def nearest(
    store: Store,
    *,
    point: ArrayLike | None = None,
    instance_id: int | None = None,
    words: str | None = None,
    k: int = 5,
    max_distance: float | None = None,
    min_confidence: float = 0.0,
    structure: bool = False,
    state: str | None = None,
) -> list[Match]:
    """The k things nearest to a `point` (world) or to an instance, by the distance between surfaces.

    With `words` only things whose label or description bears one of them; with words alone those that they name best
    (most words, then confidence), without distances. The words must all be found where any thing bears them all. Words
    that name a kind of structure ("floor", "wall") ask for structure too. `max_distance` bounds the distance between
    surfaces. Raises `OptionError` for arguments that make no sense and `UnknownIdError` for an id that was never given.
    """
    k = checked_count(k)
    if point is not None and instance_id is not None:
        raise OptionError("give a point or an instance to be near to, not both")
    if point is None and instance_id is None and words is None:
        raise OptionError("say what to be near to: a point, an instance, or words that name a thing")
    if max_distance is not None:
        if point is None and instance_id is None:
            raise OptionError("a largest distance needs a point or an instance to measure from")
        max_distance = checked_length(max_distance, "max_distance")
    filters = Filters(structure or _names_structure(words), min_confidence, state)
    origin = None if instance_id is None else store.instance(instance_id)
    candidates = [i for i in filters.select(store.instances()) if origin is None or i.id != origin.id]
    named = _named(candidates, words) if words is not None else [(i, 1.0, "") for i in candidates]
    if origin is not None:
        candidates = [i for i, _, _ in named if i.component == origin.component]
        return _by_distance(store, _reasons(named), candidates, k, max_distance, origin)
    if point is not None:
        place = checked_point(point, "point")
        return _by_distance(store, _reasons(named), [i for i, _, _ in named], k, max_distance, place)
    ranked = sorted(named, key=lambda n: (-n[1], -n[0].confidence, n[0].id))
    return [Match(i, round(score, 4), None, None, reason) for i, score, reason in ranked[:k]]


def _named(candidates: Sequence[Instance], words: str) -> list[tuple[Instance, float, str]]:
    """Those that bear the words: all of them where some thing does, else as many as any thing does."""
    wanted = wanted_words(words)
    found = [(i, *word_score(i, wanted)) for i in candidates]
    most = max((len(hit) for _, _, hit in found), default=0)
    return [(i, score, _named_so(hit, wanted)) for i, score, hit in found if hit and len(hit) == most]


def _named_so(hit: Sequence[str], wanted: Sequence[str]) -> str:
    missing = [w for w in wanted if w not in hit]
    return f"named {' '.join(hit)}" + (f", not {' '.join(missing)}" if missing else "")


def _names_structure(words: str | None) -> bool:
    return words is not None and not STRUCTURE.isdisjoint(wanted_words(words))


def _reasons(named: Sequence[tuple[Instance, float, str]]) -> dict[int, str]:
    return {i.id: reason for i, _, reason in named}


def _by_distance(
    store: Store,
    reasons: dict[int, str],
    candidates: Sequence[Instance],
    k: int,
    limit: float | None,
    origin: Instance | NDArray[np.float64],
) -> list[Match]:
    """The k nearest. Boxes bound the distance from below, so only what can still win has its surface looked at."""
    bound = [(_box_distance(i, origin), n) for n, i in enumerate(candidates)]
    found: list[tuple[float, int, Match]] = []
    for least, n in sorted(bound):
        full = len(found) >= k and least > found[k - 1][0] + 1e-9
        if full or (limit is not None and least > limit + _slack(candidates[n])):
            if full:
                break
            continue
        match = _measure(store, candidates[n], origin, reasons)
        assert match.distance_m is not None
        if limit is None or match.distance_m <= limit:
            found.append((match.distance_m, candidates[n].id, match))
            found.sort(key=lambda f: f[:2])
    return [m for _, _, m in found[:k]]


def _measure(store: Store, i: Instance, origin: Instance | NDArray[np.float64], reasons: dict[int, str]) -> Match:
    if isinstance(origin, Instance):
        surface, center = distance_between(store, i, origin), float(np.linalg.norm(i.center - origin.center))
        whence = f"from #{origin.id}"
    else:
        surface, center = distance_to_point(store, i, origin), float(np.linalg.norm(i.center - origin))
        whence = "from the point"
    named = f", {reasons[i.id]}" if reasons[i.id] else ""
    reason = f"surface {surface:.2f}, centre {center:.2f} {whence}{named}"
    return Match(i, round(1.0 / (1.0 + surface), 4), surface, center, reason)


def _slack(instance: Instance) -> float:
    """How far surface points may lie outside the trimmed box."""
    return 0.02 * float(np.max(instance.box.size)) + 1e-9


def _box_distance(instance: Instance, origin: Instance | NDArray[np.float64]) -> float:
    low, high = (origin.aabb[0], origin.aabb[1]) if isinstance(origin, Instance) else (origin, origin)
    extra = _slack(origin) if isinstance(origin, Instance) else 0.0
    gap = np.maximum(0.0, np.maximum(low - instance.aabb[1], instance.aabb[0] - high))
    return max(0.0, float(np.linalg.norm(gap)) - 2.0 * (_slack(instance) + extra))
