"""Choose among instances by size, height, place and distance: "largest", "second from the left", "closest to"."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from list3r.memory.core.records import Instance
from list3r.queries.finding.grammar import Order, Phrase
from list3r.queries.finding.related import PhraseMatch, PhraseSearch, viewer_of
from list3r.queries.finding.tokens import SIZES
from list3r.queries.views.surfaces import distance_between

_ALIKE = 0.1
"""Sizes that differ by less than this share are equally the largest."""
_MOST_MEASURED = 60
"""Instances whose surfaces are measured from others, the nearest by their centres."""
_SIZE: dict[str, tuple[Callable[[Instance], float], int, str]] = {
    "largest": (lambda i: edge(i), -1, "longest edge"),
    "smallest": (lambda i: edge(i), 1, "longest edge"),
    "tallest": (lambda i: float(np.ptp(i.aabb[:, 2])), -1, "height"),
    "shortest": (lambda i: float(np.ptp(i.aabb[:, 2])), 1, "height"),
    "widest": (lambda i: float(np.max(i.box.size[:2])), -1, "width"),
    "narrowest": (lambda i: float(np.max(i.box.size[:2])), 1, "width"),
}
_PLACE: dict[str, tuple[Callable[[Instance], float], int, str]] = {
    "highest": (lambda i: float(i.aabb[1, 2]), -1, "top at height"),
    "lowest": (lambda i: float(i.aabb[0, 2]), 1, "bottom at height"),
}
_SIDES = {"leftmost": (0, 1), "rightmost": (0, -1), "foremost": (1, 1), "rearmost": (1, -1), "middle": (0, 1)}
"""Axis as seen, to the right or away, and the direction in which it is counted."""


def edge(i: Instance) -> float:
    """Return the longest edge of an instance."""
    return float(np.max(i.box.size))


def ordered(
    search: PhraseSearch, found: list[PhraseMatch], order: Order, to: Sequence[PhraseMatch]
) -> list[PhraseMatch]:
    """Return what an order chooses among instances; `to` are those that distance is measured from."""
    if order.by in _SIZE:
        measure, sign, what = _SIZE[order.by]
        ranked = sorted(((measure(c.instance), c) for c in found), key=lambda r: (sign * r[0], r[1].instance.id))
        return _alike(ranked, order, what)
    if order.by in _PLACE:
        measure, sign, what = _PLACE[order.by]
        ranked = sorted(((measure(c.instance), c) for c in found), key=lambda r: (sign * r[0], r[1].instance.id))
        return _chosen([(c, f"{order.by}: {what} {value:.2f}") for value, c in ranked], order.rank)
    if order.by in ("nearest", "farthest"):
        return _by_distance(search, found, order, to)
    return _by_side(search, found, order)


def _alike(ranked: list[tuple[float, PhraseMatch]], order: Order, what: str) -> list[PhraseMatch]:
    """Return the one of a rank and, for the first, what is practically as large."""
    chosen = _chosen([(c, f"{order.by}: {what} {size:.2f}") for size, c in ranked], order.rank)
    if order.rank != 1 or not ranked:
        return chosen
    best = ranked[0][0]
    shares = [(min(size, best) / max(size, best, 1e-12), size, c) for size, c in ranked]
    return [
        PhraseMatch(c.instance, c.score * share, (*c.reasons, f"{order.by}: {what} {size:.2f}"))
        for share, size, c in shares
        if share >= 1.0 - _ALIKE
    ]


def _chosen(ranked: list[tuple[PhraseMatch, str]], rank: int) -> list[PhraseMatch]:
    at = rank - 1 if rank > 0 else len(ranked) + rank
    return [PhraseMatch(c.instance, c.score, (*c.reasons, why)) for c, why in ranked[at : at + 1]] if at >= 0 else []


def _by_distance(
    search: PhraseSearch, found: list[PhraseMatch], order: Order, to: Sequence[PhraseMatch]
) -> list[PhraseMatch]:
    if order.to is not None and not to and not order.to.generic:
        return []
    if not to or (order.to is not None and order.to.generic):
        search.notes.append(f"{order.by} to what? name it, such as: chair closest to the door")
        return found
    ends = {c.instance.id for c in to}
    holding = search.store.relations.among(ends, ("on", "in", "attached_to"), as_object=False)
    ends |= {r.object for r in holding}
    own = [c for c in found if c.instance.id not in ends] or found
    away = np.array([min(float(np.linalg.norm(c.instance.center - o.instance.center)) for o in to) for c in own])
    sign = 1 if order.by == "nearest" else -1
    reach = np.array([edge(c.instance) for c in own])
    some = [own[n] for n in np.argsort(sign * away - reach, kind="stable")[:_MOST_MEASURED]]
    measured = []
    for c in some:
        gap, o = min(((distance_between(search.store, c.instance, o.instance), o) for o in to), key=lambda g: g[0])
        measured.append((gap, c, o.instance))
    measured.sort(key=lambda m: (sign * m[0], m[1].instance.id))
    why = [(c, f"{order.by}: {gap:.2f} from #{o.id} {o.label or o.description}") for gap, c, o in measured]
    return _chosen(why, order.rank)


def _by_side(search: PhraseSearch, found: list[PhraseMatch], order: Order) -> list[PhraseMatch]:
    """Count from the left, the right, the front or the back, as seen from the viewpoint."""
    viewer = viewer_of(search, found[0].instance) if found else None
    if viewer is None:
        return found
    centers = np.array([c.instance.center for c in found])
    sight = centers.mean(axis=0) - viewer.place
    ahead = sight - (sight @ viewer.up) * viewer.up
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
    right = np.cross(ahead, viewer.up)
    offset = centers - viewer.place
    axis, sign = _SIDES[order.by]
    value = np.arctan2(offset @ right, offset @ ahead) if axis == 0 else offset @ ahead
    ranked = [found[n] for n in np.argsort(sign * value, kind="stable")]
    rank = (len(ranked) + 1) // 2 if order.by == "middle" else order.rank
    return _chosen([(c, f"{order.by}, as seen from {viewer.name}") for c in ranked], rank)


def sized(search: PhraseSearch, found: list[PhraseMatch], phrase: Phrase) -> list[PhraseMatch]:
    """Return those of a size, relative to the others that fit the words, or to all things where those are fewer than
    four."""
    size = phrase.size
    assert size is not None
    edges = np.array([]) if search.gathered is None else search.gathered.sizes_of(phrase)
    if len(edges) == 0:
        among = [c.instance for c in found]
        if len(among) < 4:
            among = [i for i in search.things.values() if i.structure is None] or among
        edges = np.sort([edge(i) for i in among])
    low, high = SIZES[size]
    out = []
    for c in found:
        rank = float(np.mean(edges < edge(c.instance)) + 0.5 * np.mean(edges == edge(c.instance)))
        weight = search.vocabulary[c.instance.id].get(size, 0.0)
        fit = 1.0 - rank if high <= 0.5 else rank if low >= 0.5 else 1.0 - 2.0 * abs(rank - 0.5)
        if weight > 0.0 or low <= rank <= high:
            score = max(weight, 0.5 + 0.5 * fit)
            why = f"{size}: longest edge {edge(c.instance):.2f}, {1.0 - rank:.0%} of the others are larger"
            out.append(PhraseMatch(c.instance, c.score * score, (*c.reasons, why)))
    return out
